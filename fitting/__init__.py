"""Fits of underwater light to water constituents: the inverse side of oceaninv."""

# fmt: off
# isort: off
from fitting.bulk.fit_bulk import fit_bulk
from fitting.bulk.media import AbstractMedium, Milk, NaturalWater, Populations
from fitting.core import former_names  # noqa: F401
from fitting.core.likelihood_regions import joint_region
from fitting.core.parameters import Identity, Log, Logit, Parameter
from fitting.core.result import Fit, Quantity
from fitting.core.sampling import NUTS, sample
from fitting.images.photograph_file import Photograph, read_photograph
from fitting.images.range_file import read_range
from fitting.observations.bulk import (Bulk)
from fitting.observations.profile import (Profile)
from fitting.observations.photo import Background, Board, Chart, Photo, Pixels
from fitting.photo.assumptions import assumptions
from fitting.photo.fit_photo import (fit_photo, fit_photos)
from fitting.photo.design import (design)
from fitting.profile.constituents.from_kd_and_r import fit_apparent
from fitting.profile.fit_profile import fit_profile
from fitting.profile.fit_profiles import ProfileFits, fit_profiles, stream_profiles
from fitting.profile.kd.smooth_kd import SmoothKd, smooth_kd
import fitting.report.picture  # noqa: F401  # it draws `Fit.report`
from oceaninv import __version__  # noqa: F401

__all__ = [
    "NUTS", "AbstractMedium", "Background", "Board", "Bulk", "Chart", "Fit", "Identity", "Log",
    "Logit", "Milk", "NaturalWater", "Parameter", "Photo", "Photograph", "Pixels",
    "Populations", "Profile", "ProfileFits", "Quantity", "SmoothKd", "assumptions", "design",
    "fit_apparent", "fit_bulk", "fit_photo", "fit_photos", "fit_profile", "fit_profiles",
    "joint_region", "read_photograph", "read_range", "sample", "smooth_kd", "stream_profiles"]
