"""What a search for constituents sees of a cast: a few numbers per band."""

from collections.abc import Mapping

import numpy as np

from fitting.core.result import Quantity
from fitting.observations.profile import Profile
from fitting.profile.constituents.batched_search import Spectra, nodes_and_basis
from fitting.profile.kd.band_fit import BandFit, thickness
from fitting.profile.kd.cast import Cast, light_of, padded_length
from fitting.profile.kd.reflectances import cast_quantities
from fitting.profile.kd.ways import sample_deviations

# What readings of AC-9 and AC-S are worth: calibration, scattered light; relative, and 1/m.
_BEAM_RELATIVE, _BEAM_FLOOR = 0.03, 0.005


# Relative errors of R by closed forms (their docstrings); of exact models, those of the scene.
_REFLECTANCE_ERROR = {"TwoStream": 0.1, "FourStream": 0.05}


def spectra_of(cast: Cast, fits: Mapping[str, BandFit], transport) -> Spectra:
    """What a fit of constituents sees of a cast: readings of Ed, and R where Eu was measured."""
    window, fit = cast.window, fits["Ed"]
    profile, n = window.profile, window.rows
    depth = profile.depth[:n]
    reference = 1.0 if profile.reference is None else profile.reference[:n]
    path = thickness(depth, window.interfaces)
    start = np.exp(np.clip(fit.x[None, :, 0] - path @ np.exp(fit.x[:, 1:]).T, -300.0, 300.0))
    if profile.sigma is None:
        sd = np.hypot(fit.noise * start, profile.floor / reference)
    else:
        sd = profile.sigma[:n] / reference
    used = fit.used[:, :n].T & window.mask[:n] & (np.asarray(fit.code) == 0)[None, :]
    sd = sd * sample_deviations(depth, profile.segment[:n], used, sd / start, fit)
    nodes, basis = nodes_and_basis(depth, float(depth.max()))

    def pad(array, fill):
        widths = [(0, padded_length(n) - n)] + [(0, 0)] * (array.ndim - 1)
        return np.pad(array, widths, constant_values=fill)

    ln_r, weight = reflected(
        cast_quantities(cast, fits).get("R"), len(profile.wavelength), transport
    )
    light = np.where(used, light_of(profile)[:n], 1.0)
    beam, beam_weight = beam_of(profile, used)
    return Spectra(
        nodes,
        pad(basis, 0.0),
        pad(light, 1.0),
        pad(np.where(used, sd, 1.0), 1.0),
        pad(used, False),
        pad(np.where(used, start, 1.0), 1.0),
        ln_r,
        weight,
        beam,
        beam_weight,
    )


def beam_of(profile: Profile, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2, beam) a and c without pure water's, means over the water whose light is used, and one
    over their deviations: what readings are worth, and the error of a mean over depth."""
    inside = profile.depth <= profile.depth[: len(used)][used.any(axis=1)].max(initial=0.0)
    values, weights = [], []
    for table in (profile.a, profile.c):
        if table is None:
            table = np.full((len(profile.depth), len(profile.beam_wavelength)), np.nan)
        seen = np.isfinite(table) & inside[:, None]
        count = seen.sum(axis=0)
        number = np.maximum(count, 1)
        mean = np.where(seen, table, 0.0).sum(axis=0) / number
        apart = np.where(seen, (table - mean) ** 2, 0.0).sum(axis=0)
        variance = apart / np.maximum(count - 1, 1) / number
        sd = np.sqrt(variance + (_BEAM_RELATIVE * mean) ** 2 + _BEAM_FLOOR**2)
        values.append(mean)
        weights.append(np.where(count > 0, 1.0 / sd, 0.0))
    return np.stack(values), np.stack(weights)


def reflected(R: Quantity | None, bands: int, transport) -> tuple[np.ndarray, np.ndarray]:
    """(wl,) ln R and one over its deviation, which holds what the transport gets wrong."""
    if R is None:
        return np.zeros(bands), np.zeros(bands)
    known = np.isfinite(R.value) & np.isfinite(R.sd) & (R.value > 0)
    error = _REFLECTANCE_ERROR.get(type(transport).__name__, 0.02)
    sd = np.where(known, np.hypot(R.sd, error), 1.0)
    return np.log(np.where(known, R.value, 1.0)), np.where(known, 1.0 / sd, 0.0)
