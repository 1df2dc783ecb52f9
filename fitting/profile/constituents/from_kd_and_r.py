"""Constituents from measured Kd and R, of many stations at a time."""

import dataclasses

import numpy as np

from fitting.core.parameters import Parameter, Parameters
from fitting.core.result import Fit, Predictive, Quantity
from fitting.profile.constituents.batched_search import (
    Spectra,
    Water,
    nodes_and_basis,
    solve_waters,
)
from fitting.profile.constituents.fit_waters import WaterFit, described_fit
from fitting.profile.constituents.reduced_data import reflected
from fitting.water_model.unknowns import (
    absorption_shapes,
    shape_nuisances,
    water_unknowns,
)
from oceaninv.foundation.argument_names import names_checked
from oceaninv.foundation.double_precision import in_double_precision
from oceaninv.foundation.tables import check_wavelength
from oceaninv.transport.base import AbstractTransport

# Of Kd to begin with, and worth how many degrees of freedom; those of Student's t; rounds.
_KD_ERROR, _WORTH, _TAILS, _REWEIGHTINGS = 0.05, 4.0, 4.0, 3
# What all bands of a measured Kd have wrong together, relative.
_LEVEL = 0.1


@names_checked
@in_double_precision
def fit_apparent(
    wavelength,
    Kd,
    R=None,
    *,
    transport: AbstractTransport,
    Kd_sd: float | None = None,
    R_sd: float = 0.05,
    solar_zenith=None,
    priors: dict[str, Parameter] | None = None,
) -> list[Fit]:
    """Constituents of waters whose Kd, and perhaps R = Eu/Ed at 0-, were measured.

    **Arguments:**

    - `wavelength`: (wl,) nm.
    - `Kd`, `R`: (station, wl) 1/m, as the mean from the surface to the depth 1/Kd, and 1; NaN
      where absent.
    - `Kd_sd`, `R_sd`: their relative standard deviations; what the transport gets wrong in R
      comes in addition.  A `Kd_sd` of None estimates a factor on both at every station, from what
      the fit leaves over: 5 % to begin with, Student's t with four degrees of freedom for single
      bad bands.
    - `solar_zenith`: (station,) degrees in air, NaN or None where unknown.
    - `transport`, `priors`: as for `fit_profile`, with nuisances of shape twice as wide, and free
      departures of the spectrum of absorption (`fitting.water_model.unknowns.absorption_shapes`):
      without them a few bands claim to tell chlorophyll, CDOM and detritus of any sea apart, and
      err.  The error that all bands of a Kd have in common (`kd_model_error`: waves over the metres
      that it is the mean of, tilt, metres other than those to 1/Kd) is free within 10 %; the red,
      where water itself absorbs, determines most of it.

    **Returns** a `Fit` per station, as `fit_profile` with a transport.

    Raises ValueError where shapes differ or a station holds no positive Kd.
    """
    wavelength, Kd = check_wavelength(wavelength), np.asarray(Kd, dtype=np.float64)
    if Kd.ndim != 2 or Kd.shape[1] != len(wavelength):
        raise ValueError(f"Kd must have shape (station, {len(wavelength)}), not {Kd.shape}.")
    ratio = np.full_like(Kd, np.nan) if R is None else np.asarray(R, dtype=np.float64)
    if ratio.shape != Kd.shape:
        raise ValueError(f"R must have the shape of Kd, {Kd.shape}, not {ratio.shape}.")
    if not np.all((Kd > 0).any(axis=1)):
        raise ValueError(f"station {int(np.argmin((Kd > 0).any(axis=1)))} holds no positive Kd.")
    suns = np.full(len(Kd), np.nan) if solar_zenith is None else np.asarray(solar_zenith, float)
    unknowns = [
        Parameters(_widened_priors(None if np.isnan(sun) else float(sun))).replace(priors or {})
        for sun in suns
    ]
    sd = _KD_ERROR if Kd_sd is None else Kd_sd
    exact = [_spectra(kd, r, sd, R_sd, transport) for kd, r in zip(Kd, ratio, strict=True)]
    grid, spectra = tuple(wavelength.tolist()), exact
    scale, dof = np.ones(len(Kd)), [None] * len(Kd)
    waters = solve_waters(unknowns, grid, transport, spectra)
    for _ in range(_REWEIGHTINGS if Kd_sd is None else 0):
        rows = zip(Kd, exact, waters, unknowns, scale, strict=True)
        spectra, scale, dof = map(list, zip(*(_weighed(*row, sd) for row in rows), strict=True))
        waters = solve_waters(unknowns, grid, transport, spectra)
    fits = []
    for i, water in enumerate(waters):
        every = np.ones(len(wavelength), bool)
        one = WaterFit(unknowns[i], spectra[i], water, type(transport).__name__, every)
        seen, noise = np.where(Kd[i] > 0, Kd[i], np.nan), float(sd * scale[i])
        predicted = _predicted(Kd[i], water)
        predictive = Predictive(seen, predicted, noise * seen, ("wavelength",), "m-1")
        notes = {"source": f"station {i}", "relative_noise": "given" if Kd_sd else noise}
        fits.append(described_fit(one, wavelength, predictive, notes, dof[i]))
    return fits


def _widened_priors(solar_zenith: float | None) -> list[Parameter]:
    """Unknowns of a water of which nothing is known, not even the kind of sea."""
    spreads = {p.name: 2.0 * p.spread for p in shape_nuisances() if p.spread}
    spreads["kd_model_error"] = _LEVEL
    return [
        dataclasses.replace(p, spread=spreads.get(p.name, p.spread))
        for p in (*water_unknowns(solar_zenith), *absorption_shapes())
    ]


def _predicted(kd: np.ndarray, water: Water) -> np.ndarray:
    """(wl,) the model's Kd to the depths 1/Kd, NaN where Kd is absent."""
    model = np.asarray(water.model)
    return np.log(model[0] / np.diagonal(model[1:])) * np.where(kd > 0, kd, np.nan)


def _weighed(kd, exact: Spectra, water: Water, unknowns: Parameters, scale: float, sd: float):
    """The station with each band weighed by how well it fits; the factor on its errors, and the
    degrees of freedom of that.

    Expectation and maximisation for Student's t (Lange, Little & Taylor 1989, J. Am. Stat. Assoc.
    84:881).  Unknowns count as far as the data, not their priors, fix them.
    """
    weight = np.asarray(exact.weight)
    of_kd = (_predicted(kd, water) / kd - 1.0) / sd
    of_r = np.where(weight > 0, (water.reflected - exact.reflectance) * weight, np.nan)
    misfit = np.stack([of_kd, of_r])
    trust = (_TAILS + 1.0) / (_TAILS + (misfit / scale) ** 2)
    known = [0.0 if p.spread is None else p.spread**-2 for p in unknowns]
    fixed = len(known) - float(np.diag(water.covariance) @ known)
    dof = _WORTH + max(float(np.isfinite(misfit).sum()) - fixed, 0.0)
    scale = float(np.sqrt((_WORTH + np.nansum(trust * misfit**2)) / dof))
    root = np.sqrt(np.where(np.isfinite(trust), trust, 1.0)) / scale
    weighed = dataclasses.replace(exact, sd=exact.sd / root[0], weight=weight * root[1])
    return weighed, scale, dof


def _spectra(kd, ratio, kd_sd: float, r_sd: float, transport) -> Spectra:
    """Two samples a band: at the surface and at 1/Kd, the error of ln of their ratio that of Kd."""
    good = kd > 0
    depth = np.concatenate([[0.0], np.where(good, 1.0 / np.where(good, kd, 1.0), 0.0)])
    used = np.concatenate([good[None], np.diag(good)])
    light = np.where(used, np.where(np.arange(len(depth))[:, None] > 0, np.exp(-1.0), 1.0), 1.0)
    nodes, basis = nodes_and_basis(depth, float(depth.max()))
    error = Quantity(ratio, np.full_like(ratio, r_sd), "1", "R")
    ln_r, weight = reflected(error, len(kd), transport)
    sd = light * kd_sd / np.sqrt(2.0)
    nothing = np.zeros((2, 0))
    return Spectra(nodes, basis, light, sd, used, light, ln_r, weight, nothing, nothing)
