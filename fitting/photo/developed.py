"""Photographs whose colours a raw developer has mixed: found by their charts' greys."""

import copy
from collections.abc import Sequence

import numpy as np

from fitting.core.result import Fit
from fitting.observations.photo import Photo
from fitting.photo.fit_photo import fit_photo

# Reduced chi-square above which readings and model disagree.
MISFIT = 3.0
# Of the mean: spectra of grey patches vary by .66 at most (DGK), of coloured ones by .93 and more.
_EVEN = 0.8
_LEAST_GREYS = 3


def only_greys(photo: Photo) -> Photo | None:
    """The photograph with the grey patches of its charts alone; None where these are all, or
    where some chart has fewer than three."""
    charts, coloured = [], False
    for chart in photo.charts:
        spectra = chart.reflectance
        grey = np.ones(len(spectra), bool)
        if spectra.ndim == 2:
            grey = np.ptp(spectra, axis=1) <= _EVEN * spectra.mean(axis=1)
        if grey.sum() < _LEAST_GREYS:
            return None
        coloured |= not grey.all()
        charts.append(chart.only(grey))
    if not coloured:
        return None
    made = copy.copy(photo)
    made.charts = tuple(charts)
    return made


def fit_checked(photos: Sequence[Photo], *, matrix: bool = False, **options) -> tuple[Fit, str]:
    """`fit_photo` of readings whose greys and colours may contradict each other.

    Greys say how each channel goes with light, whatever a developer mixed; colours say how it
    mixed them.  Where the fit of all patches has a reduced chi-square above 3 and that of the
    greys alone has not, a 3 x 3 matrix is freed; where that does not help, the greys alone count.

    **Returns** the fit, and a sentence on what was done, empty where nothing had to be.
    """
    fit = fit_photo(photos, matrix=matrix, **options)
    greys = [only_greys(photo) for photo in photos]
    if matrix or _misfit(fit) <= MISFIT or any(photo is None for photo in greys):
        return fit, ""
    of_greys = fit_photo([photo for photo in greys if photo is not None], **options)
    if not _misfit(of_greys) <= MISFIT:
        return fit, ""
    freed = fit_photo(photos, matrix=True, **options)
    what = f"greys and colours contradict each other (reduced chi-square {_misfit(fit):.1f}"
    if _misfit(freed) <= MISFIT:
        return freed, f"{what}; {_misfit(freed):.1f} with a free 3 x 3 matrix, which was fitted)"
    return of_greys, f"{what}, whatever 3 x 3 matrix mixed them): only the greys were fitted"


def _misfit(fit: Fit) -> float:
    """Reduced chi-square of the readings, before their noise was scaled."""
    return (fit.noise_factor or 1.0) ** 2
