"""Predicted values of photographs of charts, open water and reefs: the model of a photo fit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import oceaninv as oi
from fitting.observations.photo import WAVELENGTH, Photo, Pixels
from fitting.photo._band_derivatives import downward, open_radiance, ring_transmission
from fitting.photo._lamp import lamplit
from fitting.photo.surroundings import RINGS, spectra_of, surroundings_of
from fitting.water_model.unknowns import water_iops
from oceaninv.transport.base import AbstractTransport
from oceaninv.water.phase import FournierForand

# Range classes of pixels: within one, the range is taken as its mean.
_CLASSES = 24
# Natural reflectance: mean, relative spread in brightness and (correlated over 100 nm) in colour.
_ALBEDO, _BRIGHTNESS, _COLOUR, _SMOOTH = 0.2, 0.5, 0.25, 100.0
# Radius over range of a surface of its own in a view of things: one of 200 in 0.6 sr.
_SURFACE = 0.03
# Metres, to which lamplight comes back from open water.
_FAR = 1e6
# The band nearest to 550 nm.
_MIDDLE = int(np.argmin(np.abs(WAVELENGTH - 550.0)))
# Shares of the two shapes of particles, of bb/b 0.004 and 0.05, at bb/b 0.014.
_SHARES = (0.783, 0.217)
# Irradiance on a face that looks down, relative to Ed.
_FROM_BELOW = 0.03
# Metres below a chart to which the fading of light with depth is taken.
_STEP = 0.5
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
    """The numbers of one photograph as arrays, one row per reading: patches, then open water.

    - `reflectance`, `cover`: of the rings about each patch, see `Surroundings`.
    - `below`: (patch,) m that a patch lies below its board's middle; `place`: (patch, 2) where it
      lies across and down, from -1 to 1 on the board.
    - `chart`: (patch,) the chart of each patch.
    - `radius`: (chart, ring) m; `distance`: (chart,) m.
    - `facing`: (chart, 2) the components of the line of sight to a chart towards the sun's azimuth
      and down; `side`: the diffuse light on an upright face relative to that of even light.
    - `direction`: lines of sight into open water; `blend`: (reading, ray) weights by which each
      reading's own is interpolated between them; `middle`: (chart, ray) those of boards' middles.
    - `grid`: how many zeniths and azimuths the first lines of sight, those to charts, have.
    - `level`: (chart,) whether the view is horizontal: the open water behind such a chart is as
      bright as before it.
    """

    values: Float[Array, "reading channel"]
    sigma: Float[Array, "reading channel"]
    mask: Bool[Array, "reading channel"]
    reflectance: Float[Array, "patch ring wl"]
    cover: Float[Array, "patch ring"]
    below: Float[Array, " patch"]
    place: Float[Array, "patch 2"]
    chart: tuple[int, ...] = eqx.field(static=True)
    radius: Float[Array, "chart ring"]
    distance: Float[Array, " chart"]
    facing: Float[Array, "chart 2"]
    side: Float[Array, ""]
    direction: Float[Array, "ray 3"]
    blend: Float[Array, "reading ray"]
    middle: Float[Array, "chart ray"]
    grid: tuple[int, int] = eqx.field(static=True)
    level: tuple[bool, ...] = eqx.field(static=True)
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
    values, sigma, chart = [np.zeros((0, 3))], [np.zeros((0, 3))], []
    reflectance, cover = [np.zeros((0, RINGS, len(WAVELENGTH)))], [np.zeros((0, RINGS))]
    radius, below, angles = [np.zeros((0, RINGS))], [np.zeros(0)], [np.zeros((0, 2))]
    places = [np.zeros((0, 2))]
    for k, one in enumerate(photo.charts):
        spectra = spectra_of(one.reflectance)
        if spectra.shape[1] != len(WAVELENGTH):
            raise ValueError(
                f"reflectance of chart {one.name!r} must be given at the {len(WAVELENGTH)} "
                f"wavelengths of fitting.photo.fit_photo.WAVELENGTH, not at {spectra.shape[1]}."
            )
        around = surroundings_of(one)
        values.append(one.values)
        sigma.append(one.sigma)
        reflectance.append(around.reflectance)
        cover.append(around.cover)
        radius.append(around.radius[None])
        across, down = np.degrees(np.arctan(around.place.T / one.distance))
        # A chart at the zenith or nadir has no upper edge.
        upright = max(np.sin(np.radians(one.zenith)), 0.1)
        side = across / upright if photo.sun_side_known else np.zeros(len(across))
        angles.append(np.stack([one.zenith + down, side], axis=1))
        below.append(around.place[:, 1] * np.sin(np.radians(one.zenith)))
        widest = np.abs(around.place).max(axis=0, initial=0.0)
        places.append(around.place / np.where(widest > 0, widest, 1.0))
        chart += [k] * len(one.values)
    centres = np.array([[one.zenith, 0.0] for one in photo.charts]).reshape(-1, 2)
    others = [[z, 0.0] for background in photo.backgrounds for z in background.zenith]
    for background in photo.backgrounds:
        values.append(background.values)
        sigma.append(background.sigma)
    data, spread = np.concatenate(values), np.concatenate(sigma)
    mask = np.isfinite(data) & (data > 0) & np.isfinite(spread) & (spread > 0)
    to_patches = np.concatenate(angles)
    nodes, weights, grid = _interpolation(np.concatenate([to_patches, centres]))
    ahead = np.unique(np.asarray(others, dtype=float).reshape(-1, 2), axis=0)
    lines = np.concatenate([nodes, ahead])
    blend = np.zeros((len(data), len(lines)))
    blend[: len(to_patches), : len(nodes)] = weights[: len(to_patches)]
    for i, line in enumerate(others):
        blend[len(to_patches) + i, len(nodes) + np.flatnonzero((ahead == line).all(1))[0]] = 1.0
    middle = np.zeros((len(centres), len(lines)))
    middle[:, : len(nodes)] = weights[len(to_patches) :]
    towards = np.array([_direction(one.zenith, photo.azimuth) for one in photo.charts])
    towards = towards.reshape(-1, 3)
    ways = [_direction(zenith, photo.azimuth + side) for zenith, side in lines]
    return Readings(
        jnp.asarray(np.where(mask, data, 1.0)),
        jnp.asarray(np.where(mask, spread, 1.0)),
        jnp.asarray(mask),
        jnp.asarray(np.concatenate(reflectance)),
        jnp.asarray(np.concatenate(cover)),
        jnp.asarray(np.concatenate(below)),
        jnp.asarray(np.concatenate(places)),
        tuple(chart),
        jnp.asarray(np.concatenate(radius)),
        jnp.asarray(np.asarray([one.distance for one in photo.charts], dtype=float)),
        jnp.asarray(towards[:, ::2]),
        jnp.asarray(_light_from_the_side(photo.azimuth)),
        jnp.asarray(np.asarray(ways, dtype=float).reshape(-1, 3)),
        jnp.asarray(blend),
        jnp.asarray(middle),
        grid,
        tuple(bool(abs(fall) < 1e-9) for fall in towards[:, 2]),
        photo.response,
        None if photo.exposure is None else jnp.asarray(photo.exposure),
        None if photo.pixels is None else _classes(photo.pixels, photo.azimuth),
        photo.lamp,
    )


def _light_from_the_side(azimuth: float) -> float:
    """Diffuse irradiance on an upright face that looks at the camera, relative to a quarter of the
    diffuse scalar irradiance.

    That of the integral of `PlaneParallel`'s radiance over the face's hemisphere at 550 nm, for
    clear, coastal and turbid water at 5 m: 1.1-1.5 across the sun, 0.6-0.7 away from it, 1.0-1.6
    towards it, where the diffuse light counts that of the sun's scaled forward peak apart.
    """
    away = abs((azimuth + 180.0) % 360.0 - 180.0)
    return float(np.interp(away, [0.0, 90.0, 180.0], [0.63, 1.35, 1.4]))


# Directions closer together than this (degrees) count as one.
_SAME = 0.2


def _interpolation(angles: Float[np.ndarray, "line 2"]):
    """(node, 2) directions between which those asked for are interpolated, (line, node) weights,
    and the numbers of zeniths and azimuths: parabolas over their range, one node where it is 0.

    The radiance of open water changes by several per cent over the width of a near chart.
    """
    if len(angles) == 0:
        return np.zeros((0, 2)), np.zeros((0, 0)), (0, 0)
    places, weights = [], []
    for column in angles.T:
        low, high = column.min(), column.max()
        if high - low < _SAME:
            places.append(np.array([(low + high) / 2]))
            weights.append(np.ones((len(column), 1)))
            continue
        t = (column - low) / (high - low)
        places.append(np.array([low, (low + high) / 2, high]))
        weights.append(np.stack([(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)], axis=1))
    nodes = np.array([[z, a] for z in places[0] for a in places[1]])
    blend = np.einsum("lz,la->lza", *weights).reshape(len(angles), -1)
    return nodes, blend, (len(places[0]), len(places[1]))


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

    values = G (I + M) W [ v (L - sum_j D_j f_j L') + sum_j D_j rho_j q Ed/pi ], with G the channel
    gains, M an optional matrix of cross-talk, L the radiance of open water at the camera in the
    direction of the patch and L' that which arrives at the chart from behind, v the relative model
    error of both, D_j the share of the light of ring j about the patch that arrives
    (`oceaninv.disc_transmission`), f_j the share of the ring that lies on the board and rho_j its
    mean reflectance.  q Ed is the irradiance on a chart that faces the camera, see
    `_light_on_charts`, times `chart_<photograph>_<chart>` and, of its diffuse part, the colour
    (diffuse scalar irradiance / Ed) ^ `side_light_<photograph>`.  It changes linearly over the
    boards by `light_across_<photograph>` and `light_down_<photograph>`, beside its fading with
    depth.  The change of L over the directions to the patches is that of the transport times
    `gradient_down_<photograph>` and `gradient_across_<photograph>`.  By lamplight see
    `fitting.photo._lamp.lamplit`.
    """
    lit = light_up(values, readings, sunlight, photo)
    return predict_lit(lit, values, readings, transport, photo)


def predict_lit(lit: Lit, values, readings: Readings, transport, photo: int):
    if not len(readings.blend):
        return readings.values
    count = len(readings.level)
    distance = _distances(values, readings, photo)
    if readings.lamp:
        return _lamplit_readings(lit, values, readings, distance, photo)
    if count == 0:
        ahead = open_radiance(
            lit.scene,
            jnp.broadcast_to(lit.depth, readings.direction.shape[:1]),
            readings.direction,
            transport,
        )
        return readings.blend @ (ahead @ lit.response.T * lit.veil[None, :]) @ lit.output.T
    one = jnp.ones((), distance.dtype)
    size = values.get("board_size", one)
    rings = ring_transmission(
        _with_one_peak(lit.water), distance, readings.radius, values.get("peak_width", one), size
    )
    depth = jnp.maximum(lit.depth + distance * readings.facing[:, 1], 0.0)
    ahead, behind = _open_water(lit, readings, transport, depth)
    ahead = _scaled_gradients(values, readings, ahead, photo)
    light = downward(lit.scene, jnp.concatenate([depth, depth + _STEP]), transport)
    # A search may pass through water so opaque that no light is left at the chart.
    light = jnp.maximum(light, jnp.finfo(light.dtype).tiny)
    logs = jnp.log(light)
    fading = (logs[0, :count] - logs[0, count:]) / _STEP
    exponent = values.get(f"side_light_{photo}", jnp.zeros_like(one))
    arriving = _light_on_charts(readings, lit, light[:, :count], exponent)
    arriving = arriving * _shares(values, count, photo)[:, None] / jnp.pi
    # Contracted with the response first: patches are many, lines of sight and rings few.
    response = lit.response
    water = readings.blend @ (ahead @ response.T * lit.veil[None, :])
    own = jnp.einsum("jkw,kw,cw->kjwc", rings, arriving, response)
    hiding = jnp.einsum("jkw,kw,cw->kjcw", rings, behind, response * lit.veil[:, None])
    seen = []
    for k in range(count):
        rows = slice(readings.chart.index(k), readings.chart.index(k) + readings.chart.count(k))
        bright, hidden = _patches(readings, rows, own[k], hiding[k], ahead)
        # Light fades with depth over the board: to first order, as it is much smaller than 1/Kd.
        faded = (own[k] * fading[k][None, :, None], hiding[k] * fading[k][None, None, :])
        bright_slope, hidden_slope = _patches(readings, rows, *faded, ahead)
        below = (size * readings.below[rows])[:, None]
        uneven = jnp.ones_like(below)
        for i, name in enumerate(("across", "down")):
            if f"light_{name}_{photo}" in values:
                uneven += values[f"light_{name}_{photo}"] * readings.place[rows, i : i + 1]
        seen.append(uneven * (bright - below * bright_slope) - (hidden - below * hidden_slope))
    water = water.at[: len(readings.chart)].add(jnp.concatenate(seen))
    return water @ lit.output.T


def _with_one_peak(water: oi.IOPs) -> oi.IOPs:
    """The water with particles of one bb/b, 0.014, between those of algae and of others.

    What a board's image tells of the forward peak is left to `peak_width`: it says nothing about
    scattering backwards, though both shapes that particles are mixed of differ in either.
    """
    rows = [i for i, phase in enumerate(water.phases) if isinstance(phase, FournierForand)]
    if len(rows) != 2:
        return water
    pair = jnp.asarray(rows)
    shares = jnp.asarray(_SHARES, water.b_components.dtype)
    total = jnp.sum(water.b_components[pair], axis=0)
    b = water.b_components.at[pair].set(shares[:, None] * total[None, :])
    return eqx.tree_at(lambda water: water.b_components, water, b)


def _scaled_gradients(values, readings: Readings, ahead, photo: int):
    """Open water ahead, its change over the directions to the charts scaled by what the closed form
    may be wrong by: up and down, and to the sides."""
    if f"gradient_down_{photo}" not in values:
        return ahead
    zeniths, sides = readings.grid
    near = ahead[: zeniths * sides].reshape(zeniths, sides, -1)
    column = near[:, sides // 2][:, None]
    before = (readings.middle[0] @ ahead)[None, None, :]
    down, across = (values[f"gradient_{way}_{photo}"] for way in ("down", "across"))
    near = before + down * (column - before) + across * (near - column)
    return jnp.concatenate([near.reshape(zeniths * sides, -1), ahead[zeniths * sides :]])


def _light_on_charts(readings: Readings, lit: Lit, light, exponent):
    """(chart, wl) irradiance on charts that face the camera: the sun's, where they see it, and
    diffuse light from the side, from above or from below.

    An upright face gets `side` / 4 of the diffuse scalar irradiance, a level one all of the diffuse
    downward, one that looks down 3 % of Ed; between them in the shares sin^2 and cos^2.
    """
    down, around, sun = light
    mu0 = lit.scene.beam()[0]
    ahead, level = readings.facing[:, 0], readings.facing[:, 1]
    facing = jnp.maximum(level * mu0 - ahead * jnp.sqrt(1.0 - mu0**2), 0.0)[:, None]
    vertical = (level**2)[:, None]
    above = jnp.where(level[:, None] > 0, down - mu0 * sun, _FROM_BELOW * down)
    diffuse = (1.0 - vertical) * readings.side / 4.0 * around + vertical * above
    colour = jnp.log(around) - jnp.log(down)
    return facing * sun + diffuse * jnp.exp(exponent * (colour - colour[:, _MIDDLE, None]))


def _patches(readings: Readings, rows: slice, own, hiding, ahead):
    """(patch, channel) light of a board, and the open water that it hides.

    `own`: (ring, wl, channel) light of white rings; `hiding`: (ring, channel, wl) share of open
    water of each ring; `ahead`: (ray, wl) open water.
    """
    count = len(readings.reflectance[rows])
    hidden = jnp.einsum("jcw,nw->jnc", hiding, ahead)
    cover = readings.cover[rows][:, :, None] * readings.blend[rows][:, None, :]
    bright = readings.reflectance[rows].reshape(count, -1) @ own.reshape(-1, own.shape[-1])
    return bright, cover.reshape(count, -1) @ hidden.reshape(-1, own.shape[-1])


def _shares(values, count: int, photo: int):
    return jnp.stack([values[f"chart_{photo}_{k}"] for k in range(count)])


def _lamplit_readings(lit: Lit, values, readings: Readings, distance, photo: int):
    """(reading, channel) by a lamp's light, which has been scattered once at most."""
    far = jnp.full((1,), _FAR, distance.dtype)
    light = (lit.scene.light.direct, jnp.concatenate([distance, far]))
    white, veil = lamplit(lit.water, *light, values["overlap_distance"])
    count, patches = len(readings.level), len(readings.chart)
    ends = jnp.asarray([*readings.chart, *[count] * (len(readings.blend) - patches)])
    signal = (veil @ lit.response.T * lit.veil[None, :])[ends]
    if count:
        arriving = white[:count] * _shares(values, count, photo)[:, None]
        own = readings.reflectance[:, 0] * arriving[jnp.asarray(readings.chart)]
        signal = signal.at[:patches].add(own @ lit.response.T)
    return signal @ lit.output.T


def _open_water(lit: Lit, readings: Readings, transport, chart_depth):
    """(ray, wl) open water before the camera, and (chart, wl) that behind each chart relative to
    that before the camera, in the direction of the board's middle."""
    direction = readings.direction
    depth = jnp.broadcast_to(lit.depth, direction.shape[:1])
    slanted = [k for k, level in enumerate(readings.level) if not level]
    if not slanted:
        ahead = open_radiance(lit.scene, depth, direction, transport)
        return ahead, jnp.ones((len(readings.level), ahead.shape[1]), ahead.dtype)
    pick = jnp.asarray(slanted)
    # The line of sight that is nearest to the board's middle serves for the ratio.
    line = direction[jnp.argmax(readings.middle[pick], axis=1)]
    both = open_radiance(
        lit.scene,
        jnp.concatenate([depth, jnp.broadcast_to(lit.depth, pick.shape), chart_depth[pick]]),
        jnp.concatenate([direction, line, line]),
        transport,
    )
    ahead, here, there = jnp.split(both, [len(direction), len(direction) + len(slanted)])
    ratio = jnp.ones((len(readings.level), ahead.shape[1]), ahead.dtype)
    tiny = jnp.finfo(both.dtype).tiny
    logs = (jnp.log(jnp.maximum(light, tiny)) for light in (there, here))
    return ahead, ratio.at[pick].set(jnp.exp(next(logs) - next(logs)))


def _distances(values, readings: Readings, photo: int):
    one = jnp.ones((), readings.distance.dtype)
    factors = [values.get(f"range_{photo}_{k}", one) for k in range(len(readings.level))]
    return readings.distance * jnp.stack(factors) if factors else readings.distance


def predict_pixels(lit: Lit, values, pixels: PixelClasses, transport, photo: int):
    """(class, channel) mean values of pixels, and (class, channel, term) their variation.

    The things fill the view: their mean brightness is lost with c - b_forward.  Their differences
    are lost like those of surfaces with the radius `_SURFACE` times the range.
    """
    dtype = lit.depth.dtype
    depth = jnp.maximum(lit.depth + pixels.distance * pixels.direction[2], 0.0)
    depths = jnp.concatenate([lit.depth[None], depth])
    direction = jnp.broadcast_to(pixels.direction, (len(depths), 3))
    water = open_radiance(lit.scene, depths, direction, transport)
    discs = _SURFACE * pixels.distance
    part = oi.disc_transmission(
        lit.water, pixels.distance, discs[:, None], values.get("peak_width", 1.0)
    )[:, 0]
    lost = lit.water.a + lit.water.bb
    whole = jnp.exp(-lost[None, :] * pixels.distance[:, None])
    veil = (water[:1] - whole * water[1:]) @ lit.response.T * lit.veil[None, :]
    down = downward(lit.scene, depth, transport)[0] / jnp.pi
    basis = jnp.asarray(_BASIS, dtype)
    scores = jnp.stack([values[f"albedo_{photo}_{k}"] for k in range(ALBEDO_TERMS)])
    mean = _ALBEDO + basis @ scores
    camera = lit.output @ lit.response
    vary = jnp.einsum("cw,rw,wk->rck", camera, down * part, basis)
    return veil @ lit.output.T + (down * whole * mean[None, :]) @ camera.T, vary


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
