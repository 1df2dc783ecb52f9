"""Fits of underwater light to water constituents: the inverse side of oceaninv."""

from fitting.observations import Background, Chart, Photo, Profile
from fitting.parameters import Identity, Log, Logit, Parameter
from fitting.photo import fit_photo
from fitting.posterior import Fit, Quantity
from fitting.profile import fit_profile

__all__ = [
    "Background",
    "Chart",
    "Fit",
    "Identity",
    "Log",
    "Logit",
    "Parameter",
    "Photo",
    "Profile",
    "Quantity",
    "fit_photo",
    "fit_profile",
]
