"""Refractive indices and sizes of Frisvad, Christensen & Jensen (2007), ACM TOG 26(3):60.

Imaginary parts are those of appendix C (375-775 nm in steps of 25 nm, linear in between), where an
entry printed without an exponent inherits the one above; real parts are of sections 4.1-4.3.
`milk_host` is water with riboflavin; mineral and algae are the paper's example spectra.
"""

import numpy as np

from oceaninv.foundation.tables import check_wavelength

_COLUMNS = ("water", "brine", "milk_fat", "milk_host", "mineral", "algae", "ice")
_REAL = {
    "water": 1.33,
    "brine": 1.34,
    "milk_fat": 1.46,
    "milk_host": 1.33,
    "mineral": 1.58,
    "algae": 1.41,
    "ice": 1.31,
}

# wavelength (nm), then the imaginary part of each column
_TABLE = np.array(
    [
        [375, 3.39e-10, 4.59e-10, 4e-6, 2.93e-7, 2.12e-3, 1.84e-4, 2.42e-11],
        [400, 2.11e-10, 3.38e-10, 6.4e-6, 2.60e-7, 1.66e-3, 1.96e-4, 2.37e-11],
        [425, 1.62e-10, 2.23e-10, 8.6e-6, 3.36e-7, 1.30e-3, 2.89e-4, 3.52e-11],
        [450, 3.30e-10, 3.05e-10, 1.1e-5, 4.10e-7, 1.01e-3, 3.11e-4, 9.24e-11],
        [475, 4.51e-10, 4.04e-10, 1.1e-5, 3.33e-7, 7.84e-4, 2.79e-4, 2.38e-10],
        [500, 8.12e-10, 7.76e-10, 1.0e-5, 1.08e-7, 6.07e-4, 2.14e-4, 5.89e-10],
        [525, 1.74e-9, 1.69e-9, 4.7e-6, 5.64e-8, 4.59e-4, 1.26e-4, 1.24e-9],
        [550, 2.47e-9, 2.42e-9, 4.6e-6, 6.02e-8, 3.61e-4, 8.19e-5, 2.29e-9],
        [575, 3.53e-9, 3.48e-9, 4.7e-6, 7.91e-8, 2.77e-4, 5.57e-5, 3.80e-9],
        [600, 1.06e-8, 1.05e-8, 4.9e-6, 7.95e-8, 2.13e-4, 6.03e-5, 5.73e-9],
        [625, 1.41e-8, 1.40e-8, 5.0e-6, 8.58e-8, 1.63e-4, 7.86e-5, 9.50e-9],
        [650, 1.76e-8, 1.76e-8, 5.0e-6, 9.32e-8, 1.25e-4, 1.00e-4, 1.43e-8],
        [675, 2.41e-8, 2.40e-8, 5.1e-6, 7.37e-8, 9.52e-5, 2.53e-4, 1.99e-8],
        [700, 3.48e-8, 3.44e-8, 5.2e-6, 1.14e-7, 7.26e-5, 3.91e-5, 2.90e-8],
        [725, 8.59e-8, 8.51e-8, 5.2e-6, 1.33e-7, 5.53e-5, 3.91e-5, 4.17e-8],
        [750, 1.47e-7, 1.47e-7, 5.2e-6, 2.20e-7, 4.20e-5, 3.91e-5, 5.87e-8],
        [775, 1.49e-7, 1.49e-7, 5.2e-6, 2.35e-7, 3.19e-5, 3.91e-5, 9.37e-8],
    ]
)


def index(substance: str, wavelength) -> np.ndarray:
    """Complex index n + ik at concrete wavelengths (nm).  Raises ValueError outside 375-775 nm."""
    wavelength = check_wavelength(wavelength)
    knots = _TABLE[:, 0]
    if wavelength[0] < knots[0] or wavelength[-1] > knots[-1]:
        raise ValueError(
            f"wavelength must be within {knots[0]:g}-{knots[-1]:g} nm, where the indices of "
            f"Frisvad et al. (2007) are given; it runs from {wavelength[0]:g} to "
            f"{wavelength[-1]:g} nm."
        )
    column = _TABLE[:, 1 + _COLUMNS.index(substance)]
    return _REAL[substance] + 1j * np.interp(wavelength, knots, column)
