"""Predicted values of photographs of charts, open water and reefs: the model of a photo fit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import oceaninv as oi
from fitting.observations.photo import WAVELENGTH, Photo, Pixels
from fitting.photo._band_derivatives import downward, path_radiance
from fitting.photo._lamp import lamplit
from fitting.water_model.unknowns import water_iops
from oceaninv.transport.base import AbstractTransport

_FAR = 1e6
# Range classes of pixels: within one, the range is taken as its mean.
_CLASSES = 24
# Natural reflectance: mean, relative spread in brightness and (correlated over 100 nm) in colour.
_ALBEDO, _BRIGHTNESS, _COLOUR, _SMOOTH = 0.2, 0.5, 0.25, 100.0
ALBEDO_TERMS = 4


class PixelClasses(eqx.Module):
    """Summary of pixels of unknown reflectance: for equal range and noise, these statistics are
    sufficient under Gaussian reflectance.

    - `count`: independent surfaces in each class of range; `mean`, `root`: mean of their values
      and a square root of their scatter; `noise`: variance of a value.
    """

    count: Float[Array, " class"]
    mean: Float[Array, "class channel"]
    root: Float[Array, "class channel channel"]
    noise: Float[Array, "class channel"]
    distance: Float[Array, " class"]
    direction: Float[Array, "3"]


class Readings(eqx.Module):
    """The numbers of one photograph as arrays, one row per reading (patch or background).

    `ray`: index of each reading's line of sight; readings of background have reflectance 0.
    """

    values: Float[Array, "reading channel"]
    sigma: Float[Array, "reading channel"]
    mask: Bool[Array, "reading channel"]
    reflectance: Float[Array, "reading wl"]
    ray: tuple[int, ...] = eqx.field(static=True)
    direction: Float[Array, "ray 3"]
    distance: Float[Array, " ray"]
    is_chart: tuple[bool, ...] = eqx.field(static=True)
    response: oi.spectrum.Response | None
    exposure: Float[Array, ""] | None
    pixels: PixelClasses | None
    lamp: bool = eqx.field(static=True, default=False)


def _direction(zenith: float, azimuth: float) -> list[float]:
    tilt, turn = np.radians(zenith), np.radians(azimuth)
    across = np.sin(tilt)
    return [across * np.cos(turn), across * np.sin(turn), -np.cos(tilt)]


def readings_of(photo: Photo) -> Readings:
    """The arrays of one photograph; ValueError when a chart is on other wavelengths."""
    values, sigma = [np.zeros((0, 3))], [np.zeros((0, 3))]
    reflectance, ray = [np.zeros((0, len(WAVELENGTH)))], []
    directions, distance, is_chart = [], [], []

    def add_ray(zenith, length, chart):
        directions.append(_direction(zenith, photo.azimuth))
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
                f"wavelengths of fitting.photo.fit_photo.WAVELENGTH, not at {spectra.shape[1]}."
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
    return Readings(
        jnp.asarray(np.where(mask, data, 1.0)),
        jnp.asarray(np.where(mask, spread, 1.0)),
        jnp.asarray(mask),
        jnp.asarray(np.concatenate(reflectance)),
        tuple(ray),
        jnp.asarray(np.asarray(directions, dtype=float).reshape(-1, 3)),
        jnp.asarray(np.asarray(distance, dtype=float)),
        tuple(is_chart),
        photo.response,
        None if photo.exposure is None else jnp.asarray(photo.exposure),
        None if photo.pixels is None else _classes(photo.pixels, photo.azimuth),
        photo.lamp,
    )


def _classes(pixels: Pixels, azimuth: float) -> PixelClasses:
    order = np.argsort(pixels.distance, kind="stable")
    parts = np.array_split(order, min(_CLASSES, max(len(order) // 8, 1)))
    rows = []
    for part in parts:
        seen, noise = pixels.values[part], pixels.sigma[part]
        scatter = np.cov(seen.T, bias=True)
        eigenvalues, axes = np.linalg.eigh(scatter)
        root = axes * np.sqrt(np.maximum(eigenvalues, 0.0))
        share = len(part) / len(order) * pixels.surfaces
        rows.append((share, seen.mean(0), root, np.mean(noise**2, axis=0),
                     pixels.distance[part].mean()))  # fmt: skip
    columns = [jnp.asarray(np.stack(column)) for column in zip(*rows, strict=True)]
    count, mean, root, noise, distance = columns
    direction = jnp.asarray(_direction(pixels.zenith, azimuth))
    return PixelClasses(count, mean, root, noise, distance, direction)


def _albedo_basis() -> np.ndarray:
    """(wl, term) directions in which natural reflectance varies, one standard deviation long."""
    apart = (WAVELENGTH[:, None] - WAVELENGTH[None, :]) / _SMOOTH
    covariance = _ALBEDO**2 * (_BRIGHTNESS**2 + _COLOUR**2 * np.exp(-0.5 * apart**2))
    eigenvalues, axes = np.linalg.eigh(covariance)
    # Signs by the largest entry: eigenvectors have none of their own.
    axes = axes * np.sign(axes[np.argmax(np.abs(axes), axis=0), np.arange(len(axes))])
    return (axes * np.sqrt(np.maximum(eigenvalues, 0.0)))[:, : -ALBEDO_TERMS - 1 : -1]


_BASIS = _albedo_basis()


class Lit(eqx.Module):
    """The scene of one photograph at given parameter values."""

    water: oi.IOPs
    scene: oi.Scene
    depth: Float[Array, ""]
    response: Float[Array, "channel wl"]
    output: Float[Array, "channel channel"]
    veil: Float[Array, " channel"]


def light_up(values, readings: Readings, sunlight, photo: int) -> Lit:
    """Water, light, response (shifted) and output matrix (gains and cross-talk)."""
    dtype = sunlight.dtype
    grid = jnp.asarray((WAVELENGTH - 550.0) / 100.0, dtype)
    sun = sunlight * jnp.exp(values["sunlight_tilt"] * grid)
    water = water_iops(values, WAVELENGTH)
    zenith = jnp.minimum(values["solar_zenith"], 89.0)
    scene = oi.Scene(water, oi.Light(zenith, sun), oi.FlatSurface())
    response = readings.response
    if response is None:
        scores = jnp.stack([values[f"response_{i}"] for i in (1, 2, 3)])
        response = oi.spectrum.generic_camera(scores)
    weights = response.weights(WAVELENGTH)
    if "response_shift" in values:
        weights = _shifted(response, values["response_shift"])
    gains = gains_of(values, readings, photo)
    output = jnp.diag(gains)
    if "mix_RG" in values:
        one = jnp.ones((), dtype)
        rows = [jnp.stack([one if i == j else values[f"mix_{i}{j}"] for j in "RGB"]) for i in "RGB"]
        output = gains[:, None] * jnp.stack(rows)
    veil = jnp.stack([values[f"veil_{c}"] for c in "RGB"])
    return Lit(water, scene, values[f"depth_{photo}"], weights, output, veil)


def gains_of(values, readings: Readings, photo: int) -> Float[Array, " channel"]:
    """Gains of one photograph: its own, or those of the camera at its known exposure."""
    if readings.exposure is None:
        return jnp.stack([values[f"gain_{photo}_{c}"] for c in "RGB"])
    shared = jnp.stack([values[f"gain_{c}"] for c in "RGB"])
    return shared * readings.exposure * values[f"exposure_{photo}"]


def _shifted(response: oi.spectrum.Response, shift) -> Float[Array, "channel wl"]:
    """Weights of the response moved by `shift` nm to the red, to first order."""
    samples = np.asarray(response.samples)
    slope = jnp.asarray(np.gradient(np.eye(len(samples)), samples, axis=1), response.values.dtype)
    moved = response.values - shift * (response.values @ slope)
    return oi.spectrum.Response(moved, samples, response.channels).weights(WAVELENGTH)


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
    A the path radiance and v its relative model error.  By lamplight see
    `fitting.photo._lamp.lamplit`.
    """
    lit = light_up(values, readings, sunlight, photo)
    return predict_lit(lit, values, readings, transport, photo)


def predict_lit(lit: Lit, values, readings: Readings, transport, photo: int):
    if not readings.ray:
        return readings.values
    dtype = lit.depth.dtype
    count = sum(readings.is_chart)
    distance = _distances(values, readings, photo)
    direction = readings.direction
    white = veil = jnp.zeros((0, 0), dtype)
    if readings.lamp:
        white, veil = lamplit(
            lit.water, lit.scene.light.direct, distance, values["overlap_distance"]
        )
    else:
        veil = path_radiance(lit.scene, lit.depth, direction, distance, transport)
    signal = (veil @ lit.response.T * lit.veil[None, :])[jnp.asarray(readings.ray)]
    if count:
        share = jnp.stack([values[f"chart_{photo}_{k}"] for k in range(count)])
        if readings.lamp:
            arriving = jnp.pi * white[:count] * share[:, None]
        else:
            chart_depth = jnp.maximum(lit.depth + distance[:count] * direction[:count, 2], 0.0)
            down = downward(lit.scene, chart_depth, transport)
            through = jnp.exp(-lit.water.c[None, :] * distance[:count, None])
            arriving = down * share[:, None] * through
        patches = [i for i, r in enumerate(readings.ray) if r < count]
        owner = jnp.asarray([readings.ray[i] for i in patches])
        seen = readings.reflectance[: len(patches)] / jnp.pi * arriving[owner]
        signal = signal.at[: len(patches)].add(seen @ lit.response.T)
    return signal @ lit.output.T


def _distances(values, readings: Readings, photo: int):
    factors = [
        values.get(f"range_{photo}_{k}", jnp.ones((), readings.distance.dtype))
        for k in range(len(readings.is_chart))
    ]
    return readings.distance * jnp.stack(factors)


def predict_pixels(lit: Lit, values, pixels: PixelClasses, transport, photo: int):
    """(class, channel) mean values of pixels, and (class, channel, term) their variation."""
    dtype = lit.depth.dtype
    direction = jnp.broadcast_to(pixels.direction, (pixels.distance.shape[0], 3))
    veil = path_radiance(lit.scene, lit.depth, direction, pixels.distance, transport)
    veil = veil @ lit.response.T * lit.veil[None, :]
    depth = jnp.maximum(lit.depth + pixels.distance * pixels.direction[2], 0.0)
    down = downward(lit.scene, depth, transport) / jnp.pi
    arriving = down * jnp.exp(-lit.water.c[None, :] * pixels.distance[:, None])
    basis = jnp.asarray(_BASIS, dtype)
    scores = jnp.stack([values[f"albedo_{photo}_{k}"] for k in range(ALBEDO_TERMS)])
    mean = _ALBEDO + basis @ scores
    camera = lit.output @ lit.response
    vary = jnp.einsum("cw,rw,wk->rck", camera, arriving, basis)
    return veil @ lit.output.T + (arriving * mean[None, :]) @ camera.T, vary


def pixel_residual(lit: Lit, values, pixels: PixelClasses, transport, photo: int):
    """Residuals whose halved square is -ln of the likelihood of the pixels, reflectances
    integrated out, up to a constant.

    Each pixel's reflectance is the scene's mean plus Gaussian terms; given range, its value is
    then Gaussian with covariance S = H H^T + noise, H linear in the terms.  -2 ln L of a class is
    count (tr S^-1 (scatter + (mean - m)(mean - m)^T) + ln det S); the determinant keeps a fit from
    explaining the pixels by a bright scene without water.  Its residual is the root of the
    difference from the determinant of the noise alone.
    """
    expected, vary = predict_pixels(lit, values, pixels, transport, photo)
    noise = jax.vmap(jnp.diag)(pixels.noise)
    root = jnp.linalg.cholesky(vary @ jnp.swapaxes(vary, 1, 2) + noise)
    off = jnp.concatenate([pixels.root, (pixels.mean - expected)[:, :, None]], axis=2)
    white = jax.vmap(lambda r, o: jax.scipy.linalg.solve_triangular(r, o, lower=True))(root, off)
    weight = jnp.sqrt(pixels.count)
    logdet = 2.0 * jnp.sum(jnp.log(jnp.diagonal(root, axis1=1, axis2=2)), axis=1)
    excess = logdet - jnp.sum(jnp.log(pixels.noise), axis=1)
    return jnp.concatenate(
        [
            (white * weight[:, None, None]).reshape(-1),
            weight * jnp.sqrt(jnp.maximum(excess, 1e-12)),
        ]
    )
