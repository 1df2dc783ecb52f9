"""Constituents of many casts at a time, from their samples."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from fitting.core.diagnostics import Status
from fitting.core.parameters import Parameter, Parameters
from fitting.core.result import Fit, Predictive
from fitting.profile.constituents.batched_search import (
    Spectra,
    Water,
    solve_waters,
)
from fitting.profile.constituents.reduced_data import spectra_of
from fitting.profile.kd.band_fit import BandFit
from fitting.profile.kd.cast import Cast
from fitting.water_model.quantities import quantities_of
from fitting.water_model.unknowns import (
    modelled_bands,
    phytoplankton_range,
    water_unknowns,
)
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
        profile = cast.window.profile
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
            bands = modelled_bands(casts[i].window.profile.wavelength)
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


def described_fit(
    found: WaterFit, wavelength, predictive: Predictive, metadata: dict, dof=None
) -> Fit:
    """A search that has ended as a `Fit` with the quantities of its water."""
    water = found.water
    cov = np.asarray(water.covariance)
    quantities, sensitivity = quantities_of(water.values, water.slopes, found.parameters, cov)
    return Fit(
        found.parameters,
        np.asarray(water.x),
        cov,
        quantities,
        wavelength,
        Status(int(water.code)),
        predictive,
        metadata | {"transport": found.transport},
        dof,
        sensitivity=sensitivity,
    )


def water_fit(cast: Cast, bands: BandFit, found: WaterFit) -> Fit:
    """The fit of a cast's constituents as a `Fit`; observations are light less darkness, over
    the changes of the light above."""
    profile, n = cast.window.profile, cast.window.rows
    seen, wavelength = found.spectra, cast.window.profile.wavelength[found.bands]
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
    return described_fit(found, wavelength, predictive, metadata)
