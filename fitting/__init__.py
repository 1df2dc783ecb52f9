"""Fits of underwater light to water constituents: the inverse side of oceaninv."""

from fitting.apparent import fit_apparent
from fitting.assumptions import assumptions
from fitting.bulk import fit_bulk
from fitting.contents import AbstractContents, Milk, NaturalWater, Populations
from fitting.observations import Bulk, Profile
from fitting.parameters import Identity, Log, Logit, Parameter
from fitting.photo import design, fit_photo, fit_photos
from fitting.photographs import Photograph, read_photograph, read_range
from fitting.posterior import Fit, Quantity
from fitting.profile import fit_profile
from fitting.profiles import ProfileFits, fit_profiles, stream_profiles
from fitting.readings import Background, Chart, Photo, Pixels
from fitting.regions import joint_region
from fitting.sampling import NUTS, sample
from fitting.smooth import SmoothKd, smooth_kd

__all__ = [
    "NUTS",
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
    "Photograph",
    "Pixels",
    "Populations",
    "Profile",
    "ProfileFits",
    "Quantity",
    "SmoothKd",
    "assumptions",
    "design",
    "fit_apparent",
    "fit_bulk",
    "fit_photo",
    "fit_photos",
    "fit_profile",
    "fit_profiles",
    "joint_region",
    "read_photograph",
    "read_range",
    "sample",
    "smooth_kd",
    "stream_profiles",
]
