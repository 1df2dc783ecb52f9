"""Constituents from what casts say, many at a time: from samples, or from Kd and R themselves."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from fitting.core.least_squares import sentence
from fitting.core.parameters import (
    Parameter,
    Parameters,
    absorption_shapes,
    modelled_bands,
    phytoplankton_range,
    shape_nuisances,
    water_unknowns,
)
from fitting.core.result import Fit, Predictive, Quantity
from fitting.profile.constituents.batched_search import (
    Spectra,
    Water,
    nodes_and_basis,
    solve_waters,
)
from fitting.profile.kd.band_fit import BandFit
from fitting.profile.kd.reflectances import Cast, reflected, spectra_of
from fitting.water_model.quantities import quantities_of
from oceaninv.foundation.tables import check_wavelength
from oceaninv.transport.base import AbstractTransport


@dataclasses.dataclass(frozen=True)
class WaterFit:
    """A search for constituents: its unknowns, what it saw, where it ended, and which bands (wl,)
    of the cast it saw."""

    parameters: Parameters
    spectra: Spectra
    water: Water
    transport: str
    bands: np.ndarray


def fit_waters(
    casts: Mapping[int, Cast],
    fits: Mapping[int, Mapping[str, BandFit]],
    transport: AbstractTransport,
    priors: dict[str, Parameter] | None = None,
) -> tuple[dict[int, WaterFit], dict[int, str]]:
    """Constituents of casts by index, those of one shape together; a sentence where none."""
    failures: dict[int, str] = {}
    groups: dict[tuple, list[int]] = {}
    spectra, unknowns = {}, {}
    for i, cast in casts.items():
        profile = cast.job.profile
        bands = modelled_bands(profile.wavelength)
        try:
            unmodelled_notes(profile.wavelength, bands)
        except ValueError as error:
            failures[i] = f"{profile.source}: {error}"
            continue
        spectra[i] = _of_bands(spectra_of(cast, fits[i], transport), bands)
        unknowns[i] = Parameters(water_unknowns(profile.solar_zenith)).replace(priors or {})
        beam = tuple(profile.beam_wavelength.tolist())
        grid = tuple(profile.wavelength[bands].tolist())
        shape = (grid, spectra[i].light.shape[0], beam)
        groups.setdefault(shape, []).append(i)
    found = {}
    for (grid, _, beam), members in groups.items():
        part = [spectra[i] for i in members]
        waters = solve_waters([unknowns[i] for i in members], grid, transport, part, beam)
        for i, water in zip(members, waters, strict=True):
            bands = modelled_bands(casts[i].job.profile.wavelength)
            found[i] = WaterFit(unknowns[i], spectra[i], water, type(transport).__name__, bands)
    return found, failures


def _of_bands(data: Spectra, bands: np.ndarray) -> Spectra:
    """What the search sees of some of a cast's bands."""
    if bands.all():
        return data
    names = ("light", "sd", "used", "start", "reflectance", "weight")
    return dataclasses.replace(data, **{n: getattr(data, n)[..., bands] for n in names})


def unmodelled_notes(wavelength: np.ndarray, bands: np.ndarray) -> dict:
    """Metadata on the bands (nm) that no table covers; ValueError where none is left."""
    low, high = phytoplankton_range()
    if not bands.any():
        named = ", ".join(f"{band:g}" for band in wavelength)
        raise ValueError(
            f"constituents need a band of {low:g}-{high:g} nm, where phytoplankton absorption is "
            f"tabulated; the bands are {named} nm.  Kd alone can be fitted."
        )
    outside = wavelength[~bands].tolist()
    return {} if not outside else {"bands_not_modelled_nm": outside}


# Of Kd to begin with, and worth how many degrees of freedom; those of Student's t; rounds.
_KD_ERROR, _WORTH, _TAILS, _REWEIGHTINGS = 0.05, 4.0, 4.0, 3
# What all bands of a measured Kd have wrong together, relative.
_LEVEL = 0.1


def _fit(found: WaterFit, wavelength, predictive: Predictive, metadata: dict, dof=None) -> Fit:
    water = found.water
    cov = np.asarray(water.covariance)
    quantities, leaning = quantities_of(water.values, water.slopes, found.parameters, cov)
    return Fit(
        found.parameters,
        np.asarray(water.x),
        cov,
        quantities,
        wavelength,
        sentence(water.code),
        predictive,
        metadata | {"transport": found.transport},
        dof,
        sensitivity=leaning,
    )


def water_fit(cast: Cast, bands: BandFit, found: WaterFit) -> Fit:
    """The fit of a cast's constituents as a `Fit`; observations are light less darkness, over
    the changes of the light above."""
    profile, n = cast.job.profile, cast.job.rows
    seen, wavelength = found.spectra, cast.job.profile.wavelength[found.bands]
    predictive = Predictive(
        np.where(seen.used, seen.light, np.nan)[:n],
        np.where(seen.used, found.water.model, np.nan)[:n],
        np.asarray(seen.sd)[:n],
        ("depth", "wavelength"),
        "W m-2 nm-1",
        {"depth": profile.depth[:n]},
    )
    metadata = {
        "source": profile.source,
        "kd_definition": cast.definition,
        "depths_used": [int(count) for count in np.asarray(seen.used).sum(axis=0)],
        "relative_noise": "given"
        if profile.sigma is not None
        else bands.noise[found.bands].tolist(),
        "reflectance_used_nm": wavelength[np.asarray(seen.weight) > 0].tolist(),
        "a_used_nm": profile.beam_wavelength[np.asarray(seen.beam_weight)[0] > 0].tolist(),
        "c_used_nm": profile.beam_wavelength[np.asarray(seen.beam_weight)[1] > 0].tolist(),
    }
    metadata |= unmodelled_notes(profile.wavelength, found.bands)
    return _fit(found, wavelength, predictive, metadata)


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
      departures of the spectrum of absorption (`fitting.core.parameters.absorption_shapes`):
      without
      them a few bands claim to tell chlorophyll, CDOM and detritus of any sea apart, and err.
      What all bands of a Kd have wrong together (`closure`: waves over the metres that it is the
      mean of, tilt, metres other than those to 1/Kd) is free within 10 %; the red, where water
      itself absorbs, fixes most of it.

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
        Parameters(_any_sea(None if np.isnan(sun) else float(sun))).replace(priors or {})
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
        fits.append(_fit(one, wavelength, predictive, notes, dof[i]))
    return fits


def _any_sea(solar_zenith: float | None) -> list[Parameter]:
    """Unknowns of a water of which nothing is known, not even the kind of sea."""
    spreads = {p.name: 2.0 * p.spread for p in shape_nuisances() if p.spread}
    spreads["closure"] = _LEVEL
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
