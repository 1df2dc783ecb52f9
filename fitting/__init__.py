"""Fits of underwater light to water constituents: the inverse side of oceaninv."""

from fitting.bulk import fit_bulk
from fitting.contents import AbstractContents, Milk, NaturalWater, Populations
from fitting.observations import Background, Bulk, Chart, Photo, Profile
from fitting.parameters import Identity, Log, Logit, Parameter
from fitting.photo import fit_photo
from fitting.posterior import Fit, Quantity
from fitting.profile import fit_profile

__all__ = [
    "AbstractContents",
    "Background",
    "Bulk",
    "Chart",
    "Fit",
    "Identity",
    "Log",
    "Logit",
    "Milk",
    "NaturalWater",
    "Parameter",
    "Photo",
    "Populations",
    "Profile",
    "Quantity",
    "fit_bulk",
    "fit_photo",
    "fit_profile",
]
