"""The irradiance of small facets in a horizontally uniform light field, whichever way they face.

The irradiance of a facet is the integral of the radiance of its hemisphere times the cosine.  Here

    E(n) = sun(n) + water(n),

`sun` being the light that comes from within some degrees of the sun and `water` the rest.

The rest is a sum over some hundred directions of the radiance of the transport (`PlaneParallel`)
or, where its radiance knows no azimuth, of the four-stream closed form.  Near the sun radiance has
a peak that no small sum holds, and that closed forms count as unscattered sunlight.  Its irradiance
is that of small-angle scattering of all orders (Snyder & Dash 1949; Wells 1973): with b_l the
moments of the peak of the volume scattering function, s the sunlight's way and x the cosine between
facet and sun,

    sun(n) = F sum_l (2 l + 1)/(4 pi) A_l P_l(x) e^(-(c - b_l) s),

A_l the moments of the facet's cosine (0 for odd l > 1; Ramamoorthi & Hanrahan 2001).  Degrees from
_DEGREES on count as unscattered: max(x, 0), less its own lower degrees.

At last, `sun`, the water's light from above and that from below are scaled such that level facets
get the transport's Ed and Eu.  Each remains the irradiance of a radiance, so that E(n) - E(-n) is
the component of the flux vector along n.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from oceaninv.foundation.interface_optics import Rays, scattering_half_sine
from oceaninv.foundation.numerics import gauss_legendre, safe_ratio, safe_sqrt
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import AbstractTransport, homogeneous
from oceaninv.transport.closed_form.four_stream import FourStream
from oceaninv.transport.plane_parallel.plane_parallel import PlaneParallel

_DEPTHS = 65  # at which Ed and Eu are computed; between them their logarithm is linear
_KNOTS = 17  # depths at which the shape of the light is computed; linear between them
_STEPS = 24  # of the tabulated normals, per half circle of zenith and of azimuth
# Directions on one side of the sun's plane, which is a mirror: Gauss nodes of either hemisphere's
# cosine with azimuths, for the light away from the sun, and angles from the sun with azimuths
# around it, for the rest.  What is near is weighed by a Gaussian of _NEAR degrees.
_COSINES, _AZIMUTHS, _AROUND = 5, 8, 6
_NEAR = 25.0


class _Rule(NamedTuple):
    """Edges of pieces of the angle from the sun and Gauss nodes in each; `width` of the sun's own
    part, a Gaussian of twice the sine of half the angle."""

    edges: tuple[float, ...]  # degrees
    nodes: int
    width: float  # degrees


# Closed forms lack the light near the sun that `PlaneParallel` has.
_CLOSED = _Rule((0.0, 20.0, 60.0), 2, 15.0)
_EXACT = _Rule((0.0, 3.0, 12.0, 30.0, 60.0), 3, 4.0)
_DEGREES = 32
# Most that the sun's part is scaled up by, for light that is scattered away from there and back.
# Deeper, where next to none of it is left, the rest of the light from above is scaled.
_MOST = 4.0
# Share of Ed and Eu that is taken as uniform: defines the light of bands in which nothing else is.
_UNIFORM = 1e-6


def _pieces(edges, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes and weights of angles between edges in degrees, weighed by the sine."""
    edges = np.radians(edges)
    parts = [gauss_legendre(count, low, high) for low, high in itertools.pairwise(edges)]
    nodes, weights = (np.concatenate(part) for part in zip(*parts, strict=True))
    return nodes, weights * np.sin(nodes)


def _legendre_table(x: np.ndarray, most: int) -> np.ndarray:
    """P_l(x), (l, ...) for l <= most."""
    rows = [np.ones_like(x), x]
    for l in range(1, most):
        rows.append(((2 * l + 1) * x * rows[-1] - l * rows[-2]) / (l + 1))
    return np.stack(rows)


def _cosine_moments(degrees: np.ndarray) -> np.ndarray:
    """(2 l + 1)/(4 pi) A_l: the Legendre coefficients of max(x, 0)."""
    x, w = gauss_legendre(_DEGREES, 0.0, 1.0)
    return (degrees + 0.5) * (_legendre_table(x, _DEGREES)[degrees] @ (w * x))


_LOWER = np.array([0, 1, *range(2, _DEGREES, 2)])
_COEFFICIENT = _cosine_moments(_LOWER)
# The peak, by Gauss nodes that follow it down to the smallest angles, and its Legendre moments.
_PEAK, _PEAK_WEIGHT = _pieces([0, 0.003, 0.03, 0.3, 1, 3, 8, 16, 30, 60], 6)
_PEAK_TABLE = (_legendre_table(np.cos(_PEAK), _DEGREES) * 2 * np.pi * _PEAK_WEIGHT)[
    np.array([*_LOWER, _DEGREES])
]


def facet_irradiance(
    scene: Scene,
    transport: AbstractTransport,
    depths: Float[Array, " facet"],
    normals: Float[Array, "facet 3"],
    key: Key[Array, ""] | None = None,
) -> Float[Array, "facet wl"]:
    """Irradiance of small facets at `depths` (m) with outward unit `normals`, (facet, wl).

    In one homogeneous water, unshaded; z points down and the sun stands towards +x.  A level facet
    gets Ed or Eu of `transport`.  Differentiable in everything, forward and reverse; where
    the facet turns away from the sun, derivatives in its normal have a kink.

    **Raises:** ValueError for `Layers`.
    """
    found = transport.irradiance(scene, depths, key)
    field = _field(scene, transport, depths, found.Ed.value, found.Eu.value, key)

    def one(field: _Field, normal):
        sun, scattered, above, below = (part[0] for part in _parts(field, normal[None]))
        return sun + scattered + above + below

    axes = _Field._make((None, None, None, 0, 0, 0, 0, 0))
    return jax.vmap(one, (axes, 0))(field, normals)


class _Field(NamedTuple):
    """The light of all directions at depths; the leading axis of all but the first three."""

    to_sun: Float[Array, "3"]
    directions: Float[Array, "direction 3"]  # on one side of the sun's plane
    lit: Bool[Array, " direction"]  # whether light from there travels down
    light: Float[Array, "depth direction wl"]  # radiance times solid angle, without the peak
    uniform: Float[Array, "depth 2 wl"]  # additional plane irradiance, down and up
    core: Float[Array, "depth wl"]  # irradiance normal to the unscattered sunlight
    peak: Float[Array, "depth degree wl"]  # that of small-angle scattering less `core`, by degree
    lost: Float[Array, "depth wl"]  # of the sun's part, on a facet that looks down


def _field(
    scene: Scene,
    transport: AbstractTransport,
    depths: Float[Array, " depth"],
    down: Float[Array, "depth wl"],
    up: Float[Array, "depth wl"],
    key: Key[Array, ""] | None,
) -> _Field:
    """The field at depths where Ed and Eu are `down` and `up`."""
    exact = isinstance(transport, PlaneParallel)
    rule = _EXACT if exact else _CLOSED
    width = float(np.radians(rule.width))
    mu0 = scene.beam()[0]
    directions, weight = _directions(mu0, rule)
    # Radiance without the peak.
    none = jnp.zeros_like(depths)
    eyes = jnp.repeat(jnp.stack([none, none, depths], axis=1), weight.shape[0], axis=0)
    rays = Rays(eyes, jnp.tile(directions, (depths.shape[0], 1)))
    source = transport if exact else FourStream()
    radiance = source.radiance(scene, rays, key).value
    radiance = radiance.reshape(depths.shape[0], weight.shape[0], -1)
    angle = 2.0 * scattering_half_sine(directions, mu0) / width
    # Where there is no sun, there is no peak around it.
    without = jnp.where(scene.beam()[1][None, :] > 0, -jnp.expm1(-(angle[:, None] ** 2)), 1.0)
    light = radiance * (weight[:, None] * without)[None]
    lit = directions[:, 2] < 0

    core, peak = _small_angles(scene, depths, width)
    to_sun = jnp.stack([safe_sqrt(1.0 - mu0**2), jnp.zeros_like(mu0), -mu0])
    series = jnp.einsum("l,dlw->dw", _polynomials(mu0[None])[0], peak)
    other = jnp.einsum("l,dlw->dw", _polynomials(-mu0[None])[0], peak)
    sun, lost = mu0 * core + series, other
    # Twice, for either side of the mirror.
    level = (2.0 * jnp.abs(directions[:, 2]))[None, :, None]
    above = jnp.sum(jnp.where(lit[None, :, None], level * light, 0.0), axis=1)
    below = jnp.sum(jnp.where(lit[None, :, None], 0.0, level * light), axis=1)
    uniform = _UNIFORM * jnp.stack([down, up], axis=1)
    above, below = above + uniform[:, 0], below + uniform[:, 1]
    scale_sun = jnp.clip(safe_ratio(down - above, sun), 0.0, _MOST)
    scale_above = safe_ratio(down - scale_sun * sun, above)
    scale_below = safe_ratio(up, below)
    by_side = jnp.where(lit[None, :, None], scale_above[:, None], scale_below[:, None])
    return _Field(
        to_sun,
        directions,
        lit,
        light * by_side,
        uniform * jnp.stack([scale_above, scale_below], axis=1),
        core * scale_sun,
        peak * scale_sun[:, None],
        lost * scale_sun,
    )


def _directions(
    mu0: Float[Array, ""], rule: _Rule
) -> tuple[Float[Array, "direction 3"], Float[Array, " direction"]]:
    """Directions on one side of the sun's plane and their solid angles."""
    cosine, weight = gauss_legendre(_COSINES, 0.0, 1.0)
    cosine, weight = np.concatenate([-cosine, cosine]), np.concatenate([weight, weight])
    z, turn = _grid(cosine, _AZIMUTHS)
    level = np.sqrt(1.0 - z**2)
    apart = jnp.asarray(np.stack([level * np.cos(turn), level * np.sin(turn), z], 1), mu0.dtype)
    apart_weight = jnp.asarray(np.repeat(weight, _AZIMUTHS) * np.pi / _AZIMUTHS, mu0.dtype)

    angle, weight = _pieces(rule.edges, rule.nodes)
    angle, turn = _grid(angle, _AROUND)
    tilt, sine = np.sin(angle), safe_sqrt(1.0 - mu0**2)
    along, over, aside = (
        jnp.asarray(v, mu0.dtype) for v in (np.cos(angle), tilt * np.cos(turn), tilt * np.sin(turn))
    )
    near = jnp.stack([along * sine + over * mu0, aside, over * sine - along * mu0], axis=1)
    near_weight = jnp.asarray(np.repeat(weight, _AROUND) * np.pi / _AROUND, mu0.dtype)

    def square(directions):
        return (2.0 * scattering_half_sine(directions, mu0) / float(np.radians(_NEAR))) ** 2

    weights = [-jnp.expm1(-square(apart)) * apart_weight, jnp.exp(-square(near)) * near_weight]
    return jnp.concatenate([apart, near]), jnp.concatenate(weights)


def _grid(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Each x with each of `count` azimuths of a half circle."""
    azimuth = (np.arange(count) + 0.5) * np.pi / count
    first, second = np.meshgrid(x, azimuth, indexing="ij")
    return first.ravel(), second.ravel()


def _small_angles(scene: Scene, depths, width: float):
    """`core` and `peak` of a field before they are scaled."""
    dtype = depths.dtype
    water = homogeneous(scene)
    mu0, beam = scene.beam()
    shape = np.exp(-((2.0 * np.sin(_PEAK / 2.0) / width) ** 2))
    table = jnp.asarray(_PEAK_TABLE * shape, dtype)
    moments = table @ water.volume_scattering(jnp.asarray(np.cos(_PEAK), dtype))
    way = (depths / mu0)[:, None, None]
    sun = beam[None, None, :] * jnp.exp(-(water.c[None, :] - moments)[None] * way)
    # Differences of exponentials, without cancellation and without overflow.
    more = -jnp.expm1(-(moments[:-1] - moments[-1:])[None] * way)
    return sun[:, -1], jnp.asarray(_COEFFICIENT, dtype)[None, :, None] * sun[:, :-1] * more


def _polynomials(x: Float[Array, " facet"]) -> Float[Array, "facet degree"]:
    """P_l(x) of the degrees of `_LOWER`."""
    rows = [jnp.ones_like(x), x]
    for l in range(1, _DEGREES - 2):
        rows.append(((2 * l + 1) * x * rows[-1] - l * rows[-2]) / (l + 1))
    return jnp.stack([rows[l] for l in _LOWER], axis=1)


def _parts(field: _Field, normals: Float[Array, "facet 3"]) -> tuple[Float[Array, "facet wl"], ...]:
    """Irradiance at one depth of unscattered sunlight, of the peak around it, and of the other
    light from above and from below, each (facet, wl); `field` without its leading axis."""
    x = normals @ field.to_sun
    sun = jnp.maximum(x, 0.0)[:, None] * field.core[None, :]
    skyward = 0.5 * (1.0 - normals[:, 2:])  # what a facet sees of uniform light from above
    scattered = _polynomials(x) @ field.peak - (1.0 - skyward) * field.lost[None, :]
    mirror = np.array([1.0, -1.0, 1.0])
    cosines = sum(
        jnp.maximum(normals @ side.T, 0.0)
        for side in (field.directions, field.directions * jnp.asarray(mirror, x.dtype)[None, :])
    )
    above = jnp.where(field.lit[None, :], cosines, 0.0) @ field.light
    below = jnp.where(field.lit[None, :], 0.0, cosines) @ field.light
    above = above + skyward * field.uniform[:1]
    below = below + (1.0 - skyward) * field.uniform[1:]
    return sun, scattered, above, below


class LightBetweenDepths(NamedTuple):
    """The light between two depths."""

    top: Float[Array, ""]
    bottom: Float[Array, ""]
    plane: Float[Array, "depth 2wl"]  # logarithms of Ed and of Eu
    core: Float[Array, "knot wl"]  # irradiance normal to unscattered sunlight, over Ed
    # The peak around it and the other light from above, over Ed; light from below, over Eu.
    shape: Float[Array, "knot zenith azimuth 3wl"]


def light(
    base: AbstractTransport,
    scene: Scene,
    top: Float[Array, ""],
    bottom: Float[Array, ""],
    key: Key[Array, ""] | None,
) -> LightBetweenDepths:
    """The light between two depths of a scene without objects."""
    if scene.floor is not None:
        bottom = jnp.minimum(bottom, scene.floor.depth)
    share = jnp.linspace(0.0, 1.0, _DEPTHS, dtype=top.dtype)
    depths = top + share * (bottom - top)
    found = base.irradiance(scene, depths, key)
    tiny = jnp.asarray(1e-30, top.dtype)
    down, up = (jnp.maximum(v.value, tiny) for v in (found.Ed, found.Eu))
    every = (_DEPTHS - 1) // (_KNOTS - 1)
    at = slice(None, None, every)
    field = _field(scene, base, depths[at], down[at], up[at], key)
    normals = _tabulated_normals(top.dtype)
    axes = _Field._make((None, None, None, 0, 0, 0, 0, 0))
    _, scattered, above, below = jax.vmap(_parts, (axes, None))(field, normals)
    shape = jnp.concatenate(
        [scattered / down[at][:, None], above / down[at][:, None], below / up[at][:, None]], axis=2
    )
    side = _STEPS + 1
    plane = jnp.log(jnp.concatenate([down, up], axis=1))
    return LightBetweenDepths(
        top, bottom, plane, field.core / down[at], shape.reshape(_KNOTS, side, side, -1)
    )


def _tabulated_normals(dtype) -> Float[Array, "facet 3"]:
    """From facets that look up to those that look down, each from the sun's azimuth round to the
    opposite."""
    angle = np.linspace(0.0, np.pi, _STEPS + 1)
    zenith, azimuth = (v.ravel() for v in np.meshgrid(angle, angle, indexing="ij"))
    level = np.sin(zenith)
    level[-_STEPS - 1 :] = 0.0
    up = -np.cos(zenith)
    return jnp.asarray(np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], 1), dtype)


def irradiance(
    scene: Scene,
    lit: LightBetweenDepths,
    at: Float[Array, "ray 3"],
    normal: Float[Array, "ray 3"],
    free: Bool[Array, " ray"],
) -> Float[Array, "ray wl"]:
    """Irradiance of facets; `free`: whether nothing blocks the sun."""
    height = jnp.maximum(lit.bottom - lit.top, 1e-6)
    share = jnp.clip((at[:, 2] - lit.top) / height, 0.0, 1.0)
    low, part = _place(share, _DEPTHS)
    plane = jnp.exp((1.0 - part) * lit.plane[low] + part * lit.plane[low + 1])
    down, up = jnp.split(plane, 2, axis=1)

    knot, depth_part = _place(share, _KNOTS)
    level = safe_sqrt(normal[:, 0] ** 2 + normal[:, 1] ** 2)
    upright = level > 1e-6
    across = jnp.where(upright, normal[:, 0], 1.0), jnp.where(upright, normal[:, 1], 0.0)
    row, row_part = _place(jnp.arctan2(level, -normal[:, 2]) / jnp.pi, _STEPS + 1)
    turn = jnp.arctan2(jnp.abs(across[1]), across[0])
    column, column_part = _place(turn / jnp.pi, _STEPS + 1)

    def shape(knot):
        def along(row):
            near, far = lit.shape[knot, row, column], lit.shape[knot, row, column + 1]
            return (1.0 - column_part) * near + column_part * far

        return (1.0 - row_part) * along(row) + row_part * along(row + 1)

    found = (1.0 - depth_part) * shape(knot) + depth_part * shape(knot + 1)
    scattered, above, below = jnp.split(found, 3, axis=1)
    core = (1.0 - depth_part) * lit.core[knot] + depth_part * lit.core[knot + 1]
    sun = jnp.maximum(normal @ to_sun(scene), 0.0)[:, None] * core + scattered
    return down * (jnp.where(free[:, None], sun, 0.0) + above) + up * below


def to_sun(scene: Scene) -> Float[Array, "3"]:
    """Unit vector in the water towards the sun."""
    mu0 = scene.beam()[0]
    return jnp.stack([safe_sqrt(1.0 - mu0**2), jnp.zeros_like(mu0), -mu0])


def _place(share: Float[Array, " ray"], count: int):
    """The lower one of two neighbours among `count` rows, and the part (ray, 1) of the upper."""
    place = share * (count - 1)
    low = jnp.clip(jnp.floor(place).astype(int), 0, count - 2)
    return low, (place - low.astype(place.dtype))[:, None]
