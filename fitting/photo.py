"""Photographs of charts and open water to constituents."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import oceaninv as oi
from fitting._programs import kept
from fitting.observations import Photo
from fitting.parameters import (
    Identity,
    Log,
    Parameter,
    Parameters,
    Prior,
    constituents,
    shape_nuisances,
    water_iops,
)
from fitting.posterior import Fit, Predictive
from fitting.quantities import quantities_of, water_quantities
from fitting.solve import Optimum, covariance, least_squares, sentence, value_and_jacobian
from oceaninv.transport.base import AbstractTransport

WAVELENGTH = oi.spectrum.bands(16)
_FAR = 1e6


class Readings(eqx.Module):
    """The numbers of one photograph as arrays, one row per reading (patch or background).

    `ray` says along which line of sight a reading lies; background readings reflect nothing.
    """

    values: Float[Array, "reading channel"]
    sigma: Float[Array, "reading channel"]
    mask: Bool[Array, "reading channel"]
    reflectance: Float[Array, "reading wl"]
    ray: tuple[int, ...] = eqx.field(static=True)
    direction: Float[np.ndarray, "ray 3"]
    distance: Float[np.ndarray, " ray"]
    is_chart: tuple[bool, ...] = eqx.field(static=True)
    weights: Float[Array, "channel wl"] | None


def _readings(photo: Photo) -> Readings:
    values, sigma, reflectance, ray, directions, distance, is_chart = [], [], [], [], [], [], []

    def add_ray(zenith, length, chart):
        tilt, turn = np.radians(zenith), np.radians(photo.azimuth)
        across = np.sin(tilt)
        directions.append([across * np.cos(turn), across * np.sin(turn), -np.cos(tilt)])
        distance.append(length)
        is_chart.append(chart)
        return len(directions) - 1

    for chart in photo.charts:
        index = add_ray(chart.zenith, chart.distance, True)
        spectra = chart.reflectance
        if spectra.ndim == 1:
            spectra = np.broadcast_to(spectra[:, None], (len(spectra), len(WAVELENGTH)))
        if spectra.shape[1] != len(WAVELENGTH):
            raise ValueError(
                f"reflectance of chart {chart.name!r} must be given at the {len(WAVELENGTH)} "
                f"wavelengths of fitting.photo.WAVELENGTH, not at {spectra.shape[1]}."
            )
        values.append(chart.values)
        sigma.append(chart.sigma)
        reflectance.append(spectra)
        ray += [index] * len(chart.values)
    for background in photo.backgrounds:
        for row, spread, zenith in zip(
            background.values, background.sigma, background.zenith, strict=True
        ):
            ray.append(add_ray(zenith, _FAR, False))
            values.append(row[None])
            sigma.append(spread[None])
            reflectance.append(np.zeros((1, len(WAVELENGTH))))
    data, spread = np.concatenate(values), np.concatenate(sigma)
    mask = np.isfinite(data) & (data > 0) & np.isfinite(spread) & (spread > 0)
    weights = None if photo.response is None else jnp.asarray(photo.response.weights(WAVELENGTH))
    return Readings(
        jnp.asarray(np.where(mask, data, 1.0)),
        jnp.asarray(np.where(mask, spread, 1.0)),
        jnp.asarray(mask),
        jnp.asarray(np.concatenate(reflectance)),
        tuple(ray),
        np.asarray(directions),
        np.asarray(distance),
        tuple(is_chart),
        weights,
    )


def predict(
    values: dict[str, Float[Array, ""]],
    readings: Readings,
    transport: AbstractTransport,
    sunlight: Float[Array, " wl"],
    photo: int = 0,
) -> Float[Array, "reading channel"]:
    """Camera values of every reading of one photograph.

    values = G (I + M) [ W (rho q Ed/pi e^(-c P)) + v W A ], with G the channel gains, M an
    optional matrix of cross-talk, q the irradiance on the chart relative to Ed at its depth,
    A the path radiance and v its closure error.
    """
    dtype = sunlight.dtype
    grid = jnp.asarray((WAVELENGTH - 550.0) / 100.0, dtype)
    sun = sunlight * jnp.exp(values["sunlight_tilt"] * grid)
    water = water_iops(values, WAVELENGTH)
    zenith = jnp.minimum(values["solar_zenith"], 89.0)
    scene = oi.Scene(water, oi.Light(zenith, sun), oi.FlatSurface())
    depth = values[f"depth_{photo}"]
    direction = jnp.asarray(readings.direction, dtype)
    distance = jnp.asarray(readings.distance, dtype)
    rays = oi.Rays(
        jnp.stack([jnp.zeros((), dtype), jnp.zeros((), dtype), depth]), direction, distance
    )
    veil = transport.radiance(scene, rays, None).value
    count = sum(readings.is_chart)
    chart_depth = jnp.maximum(depth + distance[:count] * direction[:count, 2], 0.0)
    response = readings.weights
    if response is None:
        scores = jnp.stack([values[f"response_{i}"] for i in (1, 2, 3)])
        response = oi.spectrum.generic_camera(scores).weights(WAVELENGTH)
    channels = [values[f"veil_{c}"] for c in "RGB"]
    signal = (veil @ response.T * jnp.stack(channels)[None, :])[jnp.asarray(readings.ray)]
    if count:
        lit = transport.irradiance(scene, chart_depth, None).Ed.value
        share = jnp.stack([values[f"chart_{photo}_{k}"] for k in range(count)])
        arriving = lit * share[:, None] * jnp.exp(-water.c[None, :] * distance[:count, None])
        patches = [i for i, r in enumerate(readings.ray) if r < count]
        owner = jnp.asarray([readings.ray[i] for i in patches])
        seen = readings.reflectance[: len(patches)] / jnp.pi * arriving[owner]
        signal = signal.at[: len(patches)].add(seen @ response.T)
    gains = jnp.stack([values[f"gain_{photo}_{c}"] for c in "RGB"])
    if "mix_RG" in values:
        mix = jnp.stack(
            [
                jnp.stack([jnp.ones((), dtype) if i == j else values[f"mix_{i}{j}"] for j in "RGB"])
                for i in "RGB"
            ]
        )
        signal = signal @ mix.T
    return signal * gains[None, :]


def _unknowns(photos: Sequence[Photo], matrix: bool) -> Parameters:
    sun = float(np.mean([photo.solar_zenith for photo in photos]))
    unknowns = [
        *constituents(),
        *shape_nuisances(),
        Parameter("solar_zenith", max(sun, 1.0), 0.1, Log(), "degree", True),
        Parameter("sunlight_tilt", 0.0, 0.05, Identity(), "1", True),
        # What the closed form gets wrong in Kd.
        Parameter("closure", 0.0, 0.02, Identity(), "1", True),
        # The error of the closed-form path radiance, per channel.
        *(Parameter(f"veil_{c}", 1.0, 0.06, nuisance=True) for c in "RGB"),
    ]
    if any(photo.response is None for photo in photos):
        unknowns += [
            Parameter(f"response_{i}", 0.0, 1.0, Identity(), nuisance=True) for i in (1, 2, 3)
        ]
    if matrix:
        unknowns += [
            Parameter(f"mix_{i}{j}", 0.0, 0.3, Identity(), nuisance=True)
            for i in "RGB"
            for j in "RGB"
            if i != j
        ]
    for p, photo in enumerate(photos):
        unknowns.append(
            Parameter(f"depth_{p}", photo.depth, photo.depth_sd, Log(), "m", nuisance=True)
        )
        unknowns += [Parameter(f"gain_{p}_{c}", 1.0, None, nuisance=True) for c in "RGB"]
        unknowns += [
            Parameter(f"chart_{p}_{k}", 1.0, 1.0, nuisance=True) for k in range(len(photo.charts))
        ]
    return Parameters(unknowns)


@eqx.filter_jit
def _predict_all(parameters, readings, transport, sunlight, x):
    values = parameters.values(x)
    return tuple(predict(values, one, transport, sunlight, p) for p, one in enumerate(readings))


def _start_gains(parameters: Parameters, readings, transport, sunlight) -> Parameters:
    """Centre the gains where the model at the priors' centres is as bright as the readings."""
    centre = parameters.prior().centre
    at_centre = _predict_all(parameters.layout(), readings, transport, sunlight, centre)
    changes = {}
    for p, (one, model) in enumerate(zip(readings, at_centre, strict=True)):
        ratio = np.where(np.asarray(one.mask), np.asarray(one.values) / np.asarray(model), np.nan)
        for i, c in enumerate("RGB"):
            column = ratio[:, i]
            if np.all(np.isnan(column)):
                raise ValueError(f"photograph {p} has no usable reading in channel {c}.")
            name = f"gain_{p}_{c}"
            changes[name] = Parameter(name, float(np.nanmedian(column)), None, nuisance=True)
    return parameters.replace(changes)


def photo_residual(parameters: Parameters, readings, transport, sunlight, prior=None):
    """The function of (x, values of each photograph) whose square a photo fit minimises.

    `prior`: the numbers of the priors; those of `parameters` unless given.
    """
    prior = parameters.prior() if prior is None else prior

    def residual(x, observed):
        model = _predict_all(parameters.layout(), readings, transport, sunlight, x)
        parts = [
            jnp.where(one.mask, (data - seen) / one.sigma, 0.0).reshape(-1)
            for one, data, seen in zip(readings, observed, model, strict=True)
        ]
        return jnp.concatenate([*parts, prior.residual(x)])

    return residual


def search(
    layout: Parameters,
    prior: Prior,
    readings: tuple[Readings, ...],
    transport: AbstractTransport,
    sunlight: Float[Array, " wl"],
    start: Float[Array, " unknown"],
) -> Optimum:
    """The optimum of a photo fit.  Pure: jit and vmap it.

    Searches first as if the readings were ten times as uncertain: from the priors' centres, exact
    readings can drive the first steps into opaque water, from where nothing leads back.
    """
    observed = tuple(one.values for one in readings)

    def stage(x, widen):
        blurred = eqx.tree_at(
            lambda all_: [one.sigma for one in all_],
            readings,
            [widen * one.sigma for one in readings],
        )
        residual = photo_residual(layout, blurred, transport, sunlight, prior)
        optimum = least_squares(residual, x, observed, prior.scale)
        return optimum.x, optimum

    _, stages = jax.lax.scan(stage, start, jnp.asarray([10.0, 1.0], start.dtype))
    return jax.tree.map(lambda leaf: leaf[-1], stages)


@kept
def _solve(layout: Parameters, prior: Prior, readings, transport, sunlight):
    optimum = search(layout, prior, readings, transport, sunlight, prior.centre)

    def outcome(x):
        return water_quantities(layout.values(x), WAVELENGTH, transport)

    quantities, slopes = value_and_jacobian(outcome, optimum.x)
    return optimum, covariance(optimum.jacobian), quantities, slopes


def _fitted(readings, residual: np.ndarray) -> np.ndarray:
    """(reading, channel) fitted values of all photographs, NaN where the reading is masked."""
    parts, at = [], 0
    for one in readings:
        size = one.values.size
        misfit = residual[at : at + size].reshape(one.values.shape)
        fitted = np.asarray(one.values) - misfit * np.asarray(one.sigma)
        parts.append(np.where(np.asarray(one.mask), fitted, np.nan))
        at += size
    return np.concatenate(parts)


def prepare(photos: Sequence[Photo], transport, priors=None, matrix: bool = False, sunlight=None):
    """Unknowns, readings and sunlight of a photo fit: what `photo_residual` takes."""
    if sunlight is None:
        sunlight = oi.spectrum.daylight(WAVELENGTH)
    sunlight = jnp.asarray(sunlight, dtype=float)
    readings = tuple(_readings(photo) for photo in photos)
    parameters = _unknowns(photos, matrix).replace(priors or {})
    return _start_gains(parameters, readings, transport, sunlight), readings, sunlight


def fit_photo(
    photos: Photo | Sequence[Photo],
    *,
    transport: AbstractTransport | None = None,
    priors: dict[str, Parameter] | None = None,
    matrix: bool = False,
    sunlight: Float[np.ndarray, " wl"] | None = None,
) -> Fit:
    """Fit one or many photographs of one water.

    **Arguments:**

    - `photos`: readings of charts and of open water, see `Photo`.
    - `transport`: `oceaninv.TwoStream()` unless given.
    - `priors`: parameters to exchange by name, for instance a known CDOM.
    - `matrix`: whether the camera's channels may be mixed by an unknown 3 x 3 matrix (frames from
      a raw developer) instead of unknown gains alone.
    - `sunlight`: (16,) relative spectrum above the surface at `fitting.photo.WAVELENGTH`; CIE D65
      unless given.

    **Returns** a `Fit`.  Exposure, white balance, the light on each chart, the shape of the
    water's optical properties and the error of the closed form are free nuisances with priors, so
    that the intervals of the quantities (Kd, c, bb, a_cdm) and constituents hold what is known.
    """
    photos = [photos] if isinstance(photos, Photo) else list(photos)
    transport = oi.TwoStream() if transport is None else transport
    parameters, readings, spectrum = prepare(photos, transport, priors, matrix, sunlight)
    optimum, cov, values, slopes = _solve(
        parameters.layout(), parameters.prior(), readings, transport, spectrum
    )
    cov = np.asarray(cov)
    observed = np.concatenate(
        [np.where(np.asarray(one.mask), np.asarray(one.values), np.nan) for one in readings]
    )
    predictive = Predictive(
        observed,
        _fitted(readings, np.asarray(optimum.residual)),
        np.concatenate([np.asarray(one.sigma) for one in readings]),
        ("reading", "channel"),
        "1",
    )
    quantities, sensitivity = quantities_of(values, slopes, parameters, cov)
    return Fit(
        parameters,
        np.asarray(optimum.x),
        cov,
        quantities,
        WAVELENGTH,
        sentence(optimum.code),
        predictive,
        {
            "source": "; ".join(photo.source for photo in photos),
            "transport": type(transport).__name__,
            "kd_definition": "mean from the surface to the depth of 10 % light",
            "masked_values": sum(photo.masked for photo in photos),
            "readings": int(sum(int(one.mask.sum()) for one in readings)),
            "reduced_chi2": float(np.sum(np.asarray(optimum.residual) ** 2))
            / max(int(sum(int(one.mask.sum()) for one in readings)), 1),
        },
        sensitivity=sensitivity,
    )
