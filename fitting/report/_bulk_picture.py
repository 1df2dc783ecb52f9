"""Panels of the picture of a fit of measured a, b or c."""

import numpy as np

from fitting.core.result import Fit

_COLOURS = {"a": "tab:green", "b": "tab:blue", "c": "0.35"}


def draw_coefficients(data, residuals, fit: Fit) -> None:
    """Measured spectra on the fitted ones with their 95 % bands, and model over measured."""
    seen = fit.posterior_predictive
    wavelength = fit.wavelength
    for i, name in enumerate(seen.coords["coefficient"]):
        colour, quantity = _COLOURS[str(name)], fit.quantities[str(name)]
        low, high = quantity.interval(0.95, fit.dof)
        data.fill_between(wavelength, low, high, color=colour, alpha=0.2, lw=0)
        data.plot(wavelength, quantity.value, "-", lw=1.2, color=colour, label=str(name))
        data.errorbar(wavelength, seen.observed[i], seen.sd[i], fmt="o", ms=4, color=colour)
        off = 100.0 * (seen.predicted[i] / seen.observed[i] - 1.0)
        spread = 100.0 * seen.sd[i] / seen.observed[i]
        residuals.errorbar(wavelength, off, spread, fmt="o-", ms=4, lw=0.8, color=colour)
    data.set(xlabel="wavelength (nm)", ylabel="coefficient (m⁻¹)", yscale="log")
    data.set_title("measured (dots) and fitted (lines)", fontsize=10)
    data.legend(frameon=False, fontsize=9)
    residuals.axhline(0.0, lw=0.8, color="0.5")
    largest = 1.2 * np.nanmax(np.abs(residuals.get_ylim()))
    residuals.set(xlabel="wavelength (nm)", ylabel="fitted over measured - 1 (%)")
    residuals.set_ylim(-largest, largest)
    residuals.set_title("residuals with one standard deviation", fontsize=10)
