"""The `Fit` of Kd, and what all fits of a cast report."""

from collections.abc import Mapping

import numpy as np

from fitting.core.diagnostics import Status
from fitting.core.parameters import Parameter, Parameters
from fitting.core.result import Fit, Predictive, Quantity
from fitting.observations.profile import Profile
from fitting.profile.kd.band_fit import LEAST_LN_KD, BandFit, thickness
from fitting.profile.kd.cast import Cast, FitWindow, bands_with_light
from fitting.profile.kd.noise_statistics import runs_p, whitened
from fitting.profile.kd.par_depths import light_of_bands, light_of_sensor, light_quantities
from fitting.profile.kd.reflectances import cast_quantities, upward_notes
from fitting.profile.kd.ways import ways_of


def band_model(profile: Profile, x: np.ndarray, interfaces: np.ndarray) -> np.ndarray:
    """(depth, wl) what band fits `x` (wl, 1 + layer) say that the sensor reads."""
    path = thickness(profile.depth, interfaces)
    light = np.exp(x[None, :, 0] - path @ np.exp(x[:, 1:]).T)
    return profile.dark + (light if profile.reference is None else profile.reference * light)


def used_samples(window: FitWindow, bands: BandFit) -> np.ndarray:
    """(depth, wl) the samples of the window that were not outliers."""
    used = np.zeros_like(window.mask)
    used[: window.rows] = bands.used[:, : window.rows].T
    return used & window.mask


def metadata_of(cast: Cast, bands: BandFit) -> dict:
    window, profile = cast.window, cast.window.profile
    used = used_samples(window, bands)
    counts = dict(profile.counts)
    counts["missing, zero or negative"] = profile.masked
    counts["outliers"] = int((window.mask & ~used).sum())
    metadata = {
        "source": profile.source,
        "kd_definition": cast.definition,
        "depths_used": [int(n) for n in window.mask.sum(axis=0)],
        "deepest_used_m": [float(profile.depth[m].max()) for m in window.mask.T],
        "masked_values": profile.masked,
        "left_out": {reason: count for reason, count in counts.items() if count},
        "dark_level": profile.dark.tolist(),
        "surface_reference": "none" if profile.reference is None else "slow changes divided out",
        "self_shading_and_immersion": "not applied",
        "relative_noise": ([float(s) for s in bands.noise] if profile.sigma is None else "given"),
        "noise_correlated_over_m": [float(s) for s in bands.length],
        "ways_down_and_up": len(ways_of(window)),
    }
    if profile.station:
        metadata["station"] = dict(profile.station)
    if profile.tilt is not None:
        metadata["largest_tilt_degrees"] = float(np.nanmax(profile.tilt))
    return metadata


def _kd_parameters(wavelength: np.ndarray, x: np.ndarray) -> Parameters:
    """Ed0 of all bands, then Kd of all bands in the first layer, and so on downwards."""
    layers = range(1, x.shape[1])
    parameters = [
        Parameter(f"Ed0_{wl:g}", float(e), None, unit="W m-2 nm-1", nuisance=True, kind="Ed0",
                  wavelength=float(wl))
        for wl, e in zip(wavelength, np.exp(x[:, 0]), strict=True)
    ]  # fmt: skip
    for layer in layers:
        ending = f"_{layer}" if len(layers) > 1 else ""
        place = {"kind": "Kd", "layer": layer if ending else None}
        parameters += [
            Parameter(f"Kd_{wl:g}{ending}", float(k), unit="m-1", wavelength=float(wl), **place)
            for wl, k in zip(wavelength, np.exp(x[:, layer]), strict=True)
        ]
    return Parameters(parameters)


def light_depths(cast: Cast, bands: BandFit) -> tuple[dict[str, Quantity], dict]:
    """PAR below the surface and the depths of 10 and 1 % of it, where the data allow, and notes."""
    sensor = light_of_sensor(cast.window.profile)
    light = sensor or light_of_bands(cast.window, bands, bands_with_light(cast.window))
    if light is None:
        return {}, {}
    unit = "umol m-2 s-1" if sensor is None else cast.window.profile.PAR_unit
    return light_quantities(light, sensor is not None, unit)


def check_light_falls(cast: Cast, bands: BandFit) -> None:
    """ValueError where no band's Kd is known to a factor of some e: this is no profile of light."""
    sd = np.sqrt(np.diagonal(bands.covariance, axis1=1, axis2=2)[:, 1:])
    if not np.any(np.isfinite(sd) & (sd < 1.0) & (np.asarray(bands.x)[:, 1:] > LEAST_LN_KD + 1.0)):
        depth = cast.window.profile.depth[cast.window.mask.any(axis=1)]
        raise ValueError(
            f"the light of no band falls with depth in the {len(depth)} usable samples from "
            f"{depth.min():.3g} to {depth.max():.3g} m: shade, a covered sensor or one depth "
            "alone; give a range of depths (--from, --to) in which it does."
        )


def kd_fit(cast: Cast, fits: Mapping[str, BandFit]) -> Fit:
    """The fit of Kd, and of K of upward light where there is any, as a `Fit`."""
    window, bands = cast.window, fits["Ed"]
    profile, mask, interfaces = window.profile, window.mask, window.interfaces
    x, cov = np.asarray(bands.x), np.asarray(bands.covariance)
    n, unknowns = x.shape
    parameters = _kd_parameters(profile.wavelength, x)
    full = np.zeros((unknowns * n, unknowns * n))
    order = np.arange(n)
    for i in range(unknowns):
        for j in range(unknowns):
            full[order + i * n, order + j * n] = cov[:, i, j]
    bright = bands_with_light(window)
    dof = None if profile.sigma is not None else np.tile(bands.dof, unknowns)
    quantities = cast_quantities(cast, fits)
    depths, notes = light_depths(cast, bands)
    model = band_model(profile, x, interfaces)
    metadata = metadata_of(cast, bands) | notes
    metadata |= upward_notes(cast)
    metadata["interfaces_m"] = interfaces.tolist()
    metadata["bands_without_light_nm"] = profile.wavelength[~bright].tolist()
    failed = bands.code != Status.CONVERGED
    metadata["bands_not_converged_nm"] = profile.wavelength[failed].tolist()
    predictive = predictive_of(profile, mask, bands, model)
    left = (predictive.observed - model) / predictive.sd
    left = np.where(used_samples(window, bands), left, np.nan)
    white = whitened(left, profile.depth, np.nan_to_num(bands.length))
    # Noise may be independent or waves of the length found: the test rejects what is neither.
    metadata["runs_test_p"] = [
        max(map(runs_p, columns)) for columns in zip(left.T, white.T, strict=True)
    ]
    return Fit(
        parameters,
        x.T.reshape(-1),
        full,
        quantities | depths,
        profile.wavelength,
        Status(int(bands.code[bright].max(initial=Status.CONVERGED))),
        predictive,
        metadata,
        dof,
    )


def noise_sd(profile: Profile, bands: BandFit, model: np.ndarray) -> np.ndarray:
    if profile.sigma is not None:
        return profile.sigma
    return np.hypot(bands.noise * (model - profile.dark), profile.floor)


def predictive_of(profile, mask, bands, model) -> Predictive:
    observed = np.where(mask, profile.Ed, np.nan)
    return Predictive(
        observed,
        model,
        noise_sd(profile, bands, model),
        ("depth", "wavelength"),
        "W m-2 nm-1",
        {"depth": profile.depth},
    )
