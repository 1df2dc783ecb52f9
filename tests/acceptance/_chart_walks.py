"""Random walks to a colour chart in the water: how `_walked_charts` computes its readings.

Let L be the light of the water without the board, and D what the board changes.  D has no source
in the water; the surface and the floor reflect it like any light; on the board it is the light that
leaves the board minus L in the same direction.  So a reading is L at the eye plus the mean, over
walks from the eye, of

    weight x (reflectance x E/pi - L at the hit, as seen from the eye's side without the board)

summed over the hits of a walk, where E is the irradiance on the board by L.  At a hit the walk goes
on from the board, weighted by its reflectance, as D changes the irradiance too.

L is that of `PlaneParallel`.  Its radiance in clear water waves by 1 % with the viewing angle;
polynomials through some hundred directions average this out.  E is counted by walks from the
sun.  All walks are drawn at the middle band and weighted at every band.  They need numba
(pip install "oceaninv[bench]").
"""

import functools
import math
from typing import NamedTuple

import jax.numpy as jnp
import numba
import numpy as np

import oceaninv as oi
from fitting.observations.photo import WAVELENGTH
from tests.acceptance._walked_charts import BLACK, FLOOR_BELOW, SUN, Board, Setting, water
from tests.reference.regenerate_image_forming import (
    angle_table,
    henyey_greenstein,
    junge,
    tabulated,
)

INNER = 40.0  # degrees about the board's axis within which L has a polynomial of its own
E_ERROR = 4e-3  # relative standard error of the irradiance on a board
_BANDS = len(WAVELENGTH)


def sand() -> np.ndarray:
    """(wl,) 0.3 at 550 nm, rising to the red."""
    return 0.3 + 0.1 * (WAVELENGTH - 550.0) / 150.0


def scene_of(setting: Setting) -> oi.Scene:
    """The scene without the board."""
    sunlight = jnp.asarray(oi.spectrum.daylight(WAVELENGTH))
    floor = None
    if setting.around == "sand":
        floor = oi.Floor(setting.depth + FLOOR_BELOW, jnp.asarray(sand()))
    return oi.Scene(water(setting), oi.Light(jnp.asarray(SUN), sunlight), oi.FlatSurface(), floor)


def diffuse(scene: oi.Scene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(ray, wl) radiance without the board; in portions of one size, one compiled program."""
    origins, directions = np.broadcast_arrays(origins, directions)
    count, portion = len(directions), 256
    found = []
    for first in range(0, count, portion):
        pick = np.minimum(np.arange(first, first + portion), count - 1)
        rays = oi.Rays(jnp.asarray(origins[pick]), jnp.asarray(directions[pick]))
        found.append(np.asarray(oi.radiance(scene, rays, oi.PlaneParallel(16)).value))
    return np.concatenate(found)[:count]


class Light(NamedTuple):
    """The light without the board, at depths `middle` + t `scale`: ln L is a polynomial in the x
    and z components of the direction of look and in t, `inner` near the board's axis and `outer`
    elsewhere; ln E on facets that face the camera, one in t.  Below the horizon
    over a floor, ln L has another polynomial times exp(-c length to the floor).

    `inner_powers`, `outer_powers`: (term, 3); coefficients (term, wl)."""

    middle: float
    scale: float
    inner_powers: np.ndarray
    inner: np.ndarray
    outer_powers: np.ndarray
    outer: np.ndarray
    on_board: np.ndarray
    floor: float
    c: np.ndarray
    floor_powers: np.ndarray
    inner_floor: np.ndarray
    outer_floor: np.ndarray
    residual: np.ndarray  # (wl,) rms of ln L within the inner cone
    irradiance_error: np.ndarray  # (wl,) relative standard error of E

    def radiance(self, depth, directions: np.ndarray) -> np.ndarray:
        """(n, wl) within the inner cone."""
        t = (np.broadcast_to(depth, len(directions)) - self.middle) / self.scale
        plain = _terms(self.inner_powers, directions, t) @ self.inner
        through = _through(self.floor, self.c, depth, directions)
        return np.exp(
            plain + through * (_terms(self.floor_powers, directions, t) @ self.inner_floor)
        )

    def irradiance(self, depth: np.ndarray) -> np.ndarray:
        """(n, wl) on a facet that faces the camera."""
        t = (depth - self.middle) / self.scale
        return np.exp(np.stack([t**k for k in range(len(self.on_board))], axis=1) @ self.on_board)


def _powers(degree: int, with_depth: int, depth_degree: int) -> np.ndarray:
    return np.array(
        [
            (i, j, k)
            for k in range(depth_degree + 1)
            for i in range(degree + 1)
            for j in range(degree + 1)
            if i + j <= (degree if k == 0 else with_depth)
        ]
    )


def _terms(powers, directions, t):
    x, z = directions[:, 0], directions[:, 2]
    return np.stack([x**i * z**j * t**k for i, j, k in powers], axis=1)


def _through(floor, c, depth, directions):
    """(n, wl) exp(-c length) to the floor, 0 at and above the horizon."""
    z = directions[:, 2]
    length = np.where(z > 0, (floor - depth) / np.where(z > 0, z, 1.0), np.inf)
    return np.exp(-length[:, None] * c)


def _fitted(powers, floor_powers, floor, c, directions, depth, t, logs):
    """Coefficients (term, wl) of both polynomials, and the residuals."""
    plain, below = _terms(powers, directions, t), _terms(floor_powers, directions, t)
    through = _through(floor, c, depth, directions)
    found, off = [], []
    for band in range(_BANDS):
        terms = np.concatenate([plain, below * through[:, band, None]], axis=1)
        found.append(np.linalg.lstsq(terms, logs[:, band], rcond=1e-8)[0])
        off.append(terms @ found[-1] - logs[:, band])
    found = np.stack(found, axis=1)
    return found[: len(powers)], found[len(powers) :], np.stack(off, axis=1)


@functools.cache
def light_of(water_name: str, peak: str, at: float, around: str) -> Light:
    """`Light` over the depths of a board at the depth `at`; the other arguments as in `Setting`."""
    setting = Setting(water_name, peak, depth=at, around=around)
    scene = scene_of(setting)
    medium = medium_of(water(setting))
    rng = np.random.default_rng(3)
    depths, depth_degree, with_depth = at + np.array([-0.15, 0.15]), 1, 2
    middle, scale = float(np.mean(depths)), float(np.ptp(depths) / 2)
    towards = _towards_the_sun(scene)
    # Directions of look on the side away from the camera; both sides see the same light.
    radius = math.sin(math.radians(INNER + 5)) * np.sqrt(rng.random(256))
    turn = 2 * math.pi * rng.random(256)
    x, z = radius * np.cos(turn), radius * np.sin(turn)
    near = np.stack([x, np.sqrt(1 - x**2 - z**2), z], axis=1)
    far = rng.normal(size=(4096, 3))
    far /= np.linalg.norm(far, axis=1)[:, None]
    far[:, 1] = np.abs(far[:, 1])
    far = far[far @ towards < math.cos(math.radians(15))][:256]
    at_near, at_far = (np.resize(depths, len(v)) for v in (near, far))

    def radiance(directions, depth):
        origins = np.stack([0 * depth, 0 * depth, depth], axis=1)
        return np.log(diffuse(scene, origins, directions))

    seen_near, seen_far = radiance(near, at_near), radiance(far, at_far)
    inner_powers, outer_powers = (_powers(n, with_depth, depth_degree) for n in (5, 8))
    floor, c = (np.inf if scene.floor is None else float(scene.floor.depth)), medium.c
    floor_powers = _powers(3, 0, 0)
    inner, inner_floor, off = _fitted(
        inner_powers, floor_powers, floor, c, near, at_near, (at_near - middle) / scale, seen_near
    )
    every, at_every = np.concatenate([near, far]), np.concatenate([at_near, at_far])
    logs, t = np.concatenate([seen_near, seen_far]), (at_every - middle) / scale
    outer, outer_floor, _ = _fitted(outer_powers, floor_powers, floor, c, every, at_every, t, logs)
    boards, spread = irradiances(setting, scene, medium, depths)
    t = (depths - middle) / scale
    degree = min(len(depths) - 1, 4)
    on_board = np.polynomial.polynomial.polyfit(t, np.log(boards), degree)
    return Light(
        middle,
        scale,
        inner_powers,
        inner,
        outer_powers,
        outer,
        on_board,
        floor,
        c,
        floor_powers,
        inner_floor,
        outer_floor,
        np.sqrt(np.mean(off**2, axis=0)),
        spread.max(axis=0),
    )


def _towards_the_sun(scene: oi.Scene) -> np.ndarray:
    cosine = float(scene.beam()[0])
    return np.array([math.sqrt(1 - cosine**2), 0.0, -cosine])


class Medium(NamedTuple):
    """The water as walks need it: the scattering coefficient `b` that is drawn from, c (wl,), the
    table of angles, and for each of its bins the factor of every band (bin, wl)."""

    b: float
    c: np.ndarray
    angles: np.ndarray
    factor: np.ndarray


def _cumulative(phase, theta):
    if isinstance(phase, oi.phase.FournierForand):
        return junge(theta, float(phase.slope))
    if isinstance(phase, oi.phase.Tabulated):
        return tabulated(theta, phase)
    if isinstance(phase, oi.phase.HenyeyGreenstein):
        return henyey_greenstein(theta, float(phase.g))
    k, fall = float(phase.k), 2 * np.sin(theta / 2) ** 2
    # 1 - cos^3 = fall (3 - 3 fall + fall^2), without cancellation.
    return 1.5 * fall * (1 + k * (3 - 3 * fall + fall**2) / 3) / (3 + k)


def medium_of(iops: oi.IOPs) -> Medium:
    """Drawn from the middle band."""
    rows = np.asarray(iops.b_components)
    middle = rows[:, rows.shape[1] // 2]
    whole = float(middle.sum())

    def mixture(theta):
        parts = (_cumulative(phase, theta) for phase in iops.phases)
        return sum(w / whole * part for w, part in zip(middle, parts, strict=True))

    angles = angle_table(mixture)
    upto = np.stack([_cumulative(phase, angles[1:]) for phase in iops.phases])
    shares = np.diff(upto, axis=1, prepend=0.0)
    factor = (rows.T @ shares) / (middle @ shares)
    return Medium(whole, np.asarray(iops.c), angles, factor.T.copy())


@numba.njit(cache=False)
def _turned(d, theta, azimuth, new):
    sign = 1.0 if d[2] >= 0 else -1.0
    a = -1.0 / (sign + d[2])
    b = d[0] * d[1] * a
    sine = math.sin(theta)
    p, q, r = sine * math.cos(azimuth), sine * math.sin(azimuth), math.cos(theta)
    new[0] = p * (1 + sign * d[0] * d[0] * a) + q * b + r * d[0]
    new[1] = p * sign * b + q * (sign + d[1] * d[1] * a) + r * d[1]
    new[2] = -p * sign * d[0] - q * d[1] + r * d[2]
    size = math.sqrt(new[0] ** 2 + new[1] ** 2 + new[2] ** 2)
    for i in range(3):
        d[i] = new[i] / size


@numba.njit(cache=False)
def _from_water(cosine, index):
    """Fresnel reflectance from below the surface."""
    sine = index * math.sqrt(max(1 - cosine**2, 0.0))
    if sine >= 1:
        return 1.0
    out = math.sqrt(1 - sine**2)
    across = (index * cosine - out) / (index * cosine + out)
    along = (cosine - index * out) / (cosine + index * out)
    return 0.5 * (across**2 + along**2)


@numba.njit(cache=False)
def _carried(weight, length, excess):
    """What a walk carries in the band in which it carries most."""
    most = 0.0
    for w in range(len(weight)):
        most = max(most, weight[w] * math.exp(-length * excess[w]))
    return most


@numba.njit(cache=False)
def _polynomial(powers, values, x, z, t, total):
    total[:] = 0.0
    for n in range(len(powers)):
        term = x ** powers[n, 0] * z ** powers[n, 1] * t ** powers[n, 2]
        for w in range(len(total)):
            total[w] += term * values[n, w]


@numba.njit(cache=False)
def _walk(
    rng, mode, each, starts, lines, lengths, begin, b, excess, angles, factor, geometry,
    reflectance, floor, sand, middle, scale, inner_powers, inner, outer_powers, outer,
    on_board, c, floor_powers, inner_floor, outer_floor,
):  # fmt: skip
    """(row, wl) means of D.  mode 0: walks from `starts` along `lines` that first scatter within
    `lengths`; 1: from a board's front, diffusely; 2: along `lines`, unforced."""
    has_board = geometry[0] > 0
    distance, depth, half_width, half_height, patch = geometry[0], geometry[1], geometry[2], \
        geometry[3], geometry[4]  # fmt: skip
    across, down = half_width / 3, half_height / 2
    bands, rows, bins = len(excess), len(starts), len(angles) - 1
    found = np.zeros((rows, bands))
    position, direction, new = np.empty(3), np.empty(3), np.empty(3)
    weight, shade, below = np.empty(bands), np.empty(bands), np.empty(bands)
    cone = math.cos(math.radians(INNER)) ** 2
    for row in range(rows):
        for _ in range(each):
            position[:] = starts[row]
            direction[:] = lines[row]
            weight[:] = begin[row]
            length = 0.0
            turn = mode == 0
            if mode == 0:
                within = -math.expm1(-b * lengths[row])
                length = -math.log1p(-rng.random() * within) / b
                weight *= within
                position += length * direction
            elif mode == 1:
                direction[0], direction[1], direction[2] = 0.0, -1.0, 0.0
                _turned(
                    direction,
                    math.asin(math.sqrt(rng.random())),
                    2 * math.pi * rng.random(),
                    new,
                )
            while True:
                if turn:
                    place = rng.random() * bins
                    index = min(int(place), bins - 1)
                    theta = angles[index] + (place - index) * (angles[index + 1] - angles[index])
                    _turned(direction, theta, 2 * math.pi * rng.random(), new)
                    for w in range(bands):
                        weight[w] *= factor[index, w]
                flight = -math.log1p(-rng.random()) / b
                kind = 0
                if has_board and direction[1] != 0:
                    away = (distance - position[1]) / direction[1]
                    if 1e-9 < away < flight:
                        x = position[0] + away * direction[0]
                        z = position[2] + away * direction[2] - depth
                        if abs(x) < half_width and abs(z) < half_height:
                            kind, flight = 1, away
                if direction[2] < 0 and -position[2] / direction[2] < flight:
                    kind, flight = 2, -position[2] / direction[2]
                if direction[2] > 0 and (floor - position[2]) / direction[2] < flight:
                    kind, flight = 3, (floor - position[2]) / direction[2]
                length += flight
                for i in range(3):
                    position[i] += flight * direction[i]
                turn = kind == 0
                if kind == 1:
                    t = (position[2] - middle) / scale
                    x, z = direction[0], direction[2]
                    near = direction[1] ** 2 > cone
                    if near:
                        _polynomial(inner_powers, inner, x, z, t, shade)
                    else:
                        _polynomial(outer_powers, outer, x, z, t, shade)
                    if floor < 1e6 and z > 0:
                        if near:
                            _polynomial(floor_powers, inner_floor, x, z, t, below)
                        else:
                            _polynomial(floor_powers, outer_floor, x, z, t, below)
                        for w in range(bands):
                            shade[w] += below[w] * math.exp(-c[w] * (floor - position[2]) / z)
                    colour = reflectance[24]
                    if direction[1] > 0:
                        j = min(max(math.floor(position[0] / across + 3), 0), 5)
                        i = min(max(math.floor((position[2] - depth) / down + 2), 0), 3)
                        x = abs(position[0] - (j - 2.5) * across)
                        z = abs(position[2] - depth - (i - 1.5) * down)
                        if max(x, z) < patch:
                            colour = reflectance[int(6 * i + j)]
                    mean = 0.0
                    for w in range(bands):
                        log_e = 0.0
                        for k in range(len(on_board) - 1, -1, -1):
                            log_e = log_e * t + on_board[k, w]
                        change = colour[w] * math.exp(log_e) / math.pi - math.exp(shade[w])
                        found[row, w] += weight[w] * math.exp(-length * excess[w]) * change
                        mean += colour[w] / bands
                    chance = min(max(mean, 0.05), 1.0)
                    if rng.random() >= chance:
                        break
                    for w in range(bands):
                        weight[w] *= colour[w] / chance
                    side = -1.0 if direction[1] > 0 else 1.0
                    direction[:] = 0.0
                    direction[1], position[1] = side, distance
                elif kind == 3:
                    chance = sand.mean()
                    if rng.random() >= chance:
                        break
                    for w in range(bands):
                        weight[w] *= sand[w] / chance
                    direction[0], direction[1], direction[2] = 0.0, 0.0, -1.0
                    position[2] = floor
                elif kind == 2:
                    if rng.random() >= _from_water(-direction[2], 1.34):
                        break
                    direction[2] = -direction[2]
                    position[2] = 0.0
                if kind == 1 or kind == 3:
                    _turned(
                        direction,
                        math.asin(math.sqrt(rng.random())),
                        2 * math.pi * rng.random(),
                        new,
                    )
                # Roulette of walks that carry little, or are far from the board; its factor is 2.
                carried = _carried(weight, length, excess)
                if kind == 0:
                    past = max(position[1] - distance, -position[1], 0.0)
                    carried *= math.exp(-0.5 * b * past)
                    if position[1] > distance:
                        carried *= 0.2
                if carried < 0.1:
                    if rng.random() < 0.5:
                        break
                    weight *= 2
    return found / each


@numba.njit(cache=False)
def _from_the_sun(
    rng, walks, cosine, b, excess, angles, factor, floor, sand, depths, half, on_board
):  # fmt: skip
    """Adds to (depth, wl) the irradiance, for a sunbeam of irradiance 1 on the horizontal below
    the surface, on upright facets that face across the sun's azimuth: lengths of flights within
    `half` of every depth, times the cosine on the facet, over the height of that slab."""
    bands, bins = len(excess), len(angles) - 1
    weight, direction, new = np.empty(bands), np.empty(3), np.empty(3)
    deepest = depths.max() + half
    for _ in range(walks):
        direction[0], direction[1], direction[2] = -math.sqrt(1 - cosine**2), 0.0, cosine
        depth, length = 0.0, 0.0
        weight[:] = 1.0 / walks
        while True:
            flight = -math.log1p(-rng.random()) / b
            kind = 0
            if direction[2] < 0 and -depth / direction[2] < flight:
                kind, flight = 2, -depth / direction[2]
            if direction[2] > 0 and (floor - depth) / direction[2] < flight:
                kind, flight = 3, (floor - depth) / direction[2]
            end = depth + flight * direction[2]
            for k in range(len(depths)):
                low, high = depths[k] - half, depths[k] + half
                if max(depth, end) <= low or min(depth, end) >= high:
                    continue
                first, last = 0.0, flight
                if direction[2] != 0:
                    one, other = (low - depth) / direction[2], (high - depth) / direction[2]
                    first, last = max(first, min(one, other)), min(last, max(one, other))
                part = last - first
                across = abs(direction[1]) / 2 * part / (2 * half)
                for w in range(bands):
                    value = weight[w] * math.exp(-excess[w] * (length + (first + last) / 2))
                    on_board[k, w] += value * across
            length += flight
            depth = end
            if kind == 0:
                place = rng.random() * bins
                index = min(int(place), bins - 1)
                theta = angles[index] + (place - index) * (angles[index + 1] - angles[index])
                _turned(direction, theta, 2 * math.pi * rng.random(), new)
                for w in range(bands):
                    weight[w] *= factor[index, w]
            elif kind == 2:
                if rng.random() >= _from_water(-direction[2], 1.34):
                    break
                direction[2] = -direction[2]
                depth = 0.0
            else:
                chance = sand.mean()
                if rng.random() >= chance:
                    break
                for w in range(bands):
                    weight[w] *= sand[w] / chance
                direction[0], direction[1], direction[2] = 0.0, 0.0, -1.0
                _turned(
                    direction,
                    math.asin(math.sqrt(rng.random())),
                    2 * math.pi * rng.random(),
                    new,
                )
                depth = floor
            # Roulette of walks that carry little or are deep below; its factor is 2.
            carried = _carried(weight, length, excess) * walks
            if carried * math.exp(-0.5 * b * max(depth - deepest, 0.0)) < 0.1:
                if rng.random() < 0.5:
                    break
                weight *= 2


def irradiances(setting, scene, medium, depths, each: int = 100_000, most: int = 30):
    """(depth, wl) of E on facets that face the camera, by walks from the sun, and its relative
    standard error, below `E_ERROR` unless `most` batches do not reach it."""
    cosine, beam = (np.asarray(v) for v in scene.beam())
    floor = setting.depth + FLOOR_BELOW if setting.around == "sand" else np.inf
    rng = np.random.default_rng(4)

    def batch():
        found = np.zeros((len(depths), _BANDS))
        _from_the_sun(
            rng, each, float(cosine), medium.b, medium.c - medium.b, medium.angles,
            medium.factor, floor, sand(), depths, 0.2, found,
        )  # fmt: skip
        return found

    mean, spread, _ = mean_and_error(batch, lambda mean: E_ERROR * mean, least=8, most=most)
    return mean * beam * cosine, spread / mean


def walk(rng, mode, each, starts, lines, lengths, begin, light, medium, board, setting):
    """See `_walk`; `board` may be None."""
    floor = setting.depth + FLOOR_BELOW if setting.around == "sand" else np.inf
    geometry, colours = np.full(5, -1.0), np.full((25, _BANDS), BLACK)
    if board is not None:
        geometry = np.array(
            [board.distance, board.depth, board.half_width, board.half_height, board.patch_half]
        )
        colours = board.reflectance
    return _walk(
        rng, mode, each, starts, lines, lengths, begin, medium.b, medium.c - medium.b,
        medium.angles, medium.factor, geometry, colours, floor, sand(), light.middle,
        light.scale, light.inner_powers, light.inner, light.outer_powers, light.outer,
        light.on_board, medium.c, light.floor_powers, light.inner_floor,
        light.outer_floor,
    )  # fmt: skip


def mean_and_error(batch, wanted, least: int = 16, most: int = 800):
    """Mean of batches, its standard error and their number; ends when the error is below
    `wanted(mean)` everywhere."""
    total = square = 0.0
    for count in range(1, most + 1):
        value = batch()
        total, square = total + value, square + value**2
        if (count >= least and count % 4 == 0) or count == most:
            mean = total / count
            error = np.sqrt(np.maximum(square / count - mean**2, 0.0) / (count - 1))
            if np.all(error < wanted(mean)) or count == most:
                return mean, error, count
    raise AssertionError


def readings(setting, light, medium, board: Board, rng, error: float, each: int = 1024):
    """(patch, wl) radiances of a board, their standard errors, and the walks of each."""
    eye, centres = np.array([0.0, 0.0, board.depth]), board.centres()
    lines = centres - eye
    distance = np.linalg.norm(lines, axis=1)
    lines = lines / distance[:, None]
    colour = board.reflectance[:24]
    straight = np.exp(-distance[:, None] * medium.c)
    leaving = colour / math.pi * light.irradiance(centres[:, 2])
    hidden = light.radiance(centres[:, 2], lines)
    still = light.radiance(board.depth, lines) + straight * (leaving - hidden)
    eyes, ones = np.tile(eye, (24, 1)), np.ones((24, _BANDS))

    def batch():
        scene = light, medium, board, setting
        seen = walk(rng, 0, each, eyes, lines, distance, ones, *scene)
        again = walk(rng, 1, each // 4, centres, lines, distance, straight * colour, *scene)
        return seen + again

    mean, spread, count = mean_and_error(batch, lambda mean: error * (still + mean))
    return still + mean, spread, count * each


def background(setting, light, medium, board, angles, rng, error: float, each: int = 8192):
    """(wl,) mean radiance along horizontal lines `angles` (rad) off the axis, and its error."""
    eye = np.array([0.0, 0.0, setting.depth])
    lines = np.array([[math.sin(a), math.cos(a), 0.0] for a in angles])
    plain = light.radiance(setting.depth, lines).mean(axis=0)
    if board is None:
        return plain, np.zeros_like(plain)
    eyes, ones = np.tile(eye, (len(lines), 1)), np.ones((len(lines), _BANDS))

    def batch():
        scene = light, medium, board, setting
        return walk(rng, 2, each, eyes, lines, ones[:, 0], ones, *scene).mean(axis=0)

    mean, spread, _ = mean_and_error(batch, lambda mean: error * (plain + mean))
    return plain + mean, spread
