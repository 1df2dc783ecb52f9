"""Forward walks, from the light into the water: irradiances at depths."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from oceaninv.foundation.interface_optics import fresnel_from_air, refracted_cosine
from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import Estimate
from oceaninv.transport.monte_carlo import _array_rqmc, _event_loop, _random_walk, _weights
from oceaninv.transport.monte_carlo._array_rqmc import SortOrder
from oceaninv.transport.monte_carlo._event_loop import GROUP, TracedScene, WalkSettings
from oceaninv.transport.monte_carlo._forward_inelastic import forward_inelastic, with_spectra
from oceaninv.transport.monte_carlo._geometry_derivative_guard import fixed, fixed_scene
from oceaninv.transport.monte_carlo._random_walk import Proposal, Vertex, WalkBatch

_GRAZING = 0.003  # below this cosine, 1/cosine counts as its mean over the band, 2/0.003:
# right where light is even there; a band of 0.03 put E0 of thin layers off by 0.03 %
_FAR = 8.0  # e-foldings of the light beyond which importance does not increase
_LONGER = 0.8  # of the rate at which light decays: the stretching of downward flights
_TILT = 0.7  # power of the share of returning light in the importance of upward walks
_GROUPS = 64  # least number of groups, if there are enough walks: their scatter gives the error
_MOST = 16384  # walks in a group
_SKY = 0x51ED270B  # sets the draws of the sky's directions apart


def grouped(paths: int) -> int:
    """Walks per sorted group: the larger a group, the more evenly it covers the phase space."""
    size = GROUP
    while size < _MOST and 2 * size * _GROUPS <= paths:
        size *= 2
    return size


def _from_sky(world: TracedScene, unit: UInt32[Array, " unit"], group: int):
    """Directions and weights of walks that enter from a uniform sky, as flux."""
    words = world.words ^ jnp.uint32(_SKY)
    u = _array_rqmc.points(unit, jnp.uint32(0), words, group, world.proposal.rate.dtype, (0, 1))
    above = jnp.sqrt(u[0])
    index = world.domain.refraction
    weight = jnp.ones_like(above)
    if index is not None:
        weight = 1.0 - fresnel_from_air(above, index)
        above = refracted_cosine(above, index)
    level, azimuth = safe_sqrt(1.0 - above**2), 2.0 * np.pi * u[1]
    return (level * jnp.cos(azimuth), level * jnp.sin(azimuth), above), weight


def _crossing(
    world: TracedScene, depth: Array, walks: WalkBatch, weight: Array, factor: Array | None
):
    """Ed, Eu and E0 that walks bring to a depth ahead, (unit, 3, wl)."""
    z, up = walks.position[2], walks.direction[2] < 0
    steep = jnp.maximum(jnp.abs(walks.direction[2]), 1e-6)
    slanted = jnp.where(steep < _GRAZING, 2.0 / _GRAZING, 1.0 / steep)
    if world.domain.floor is not None and factor is None:
        # Light from the floor itself: 1/cosine has unbounded variance, so its mean over Lambert's
        # law takes its place.
        slanted = jnp.where(up & (z == world.domain.floor) & (depth == z), 2.0, slanted)
    passes = jnp.where(up, depth <= z, depth >= z)
    length = jnp.where(passes, jnp.abs(depth - z) / steep, 0.0)
    beyond = _random_walk.by_layer(world.domain, z, jnp.where(passes, depth, z), length)
    reaching = _weights.attenuated(world.medium, walks, beyond)
    if factor is not None:
        reaching = reaching * factor
    crossed = jnp.where(passes, weight, 0.0)
    down, upward = jnp.where(up, 0.0, crossed), jnp.where(up, crossed, 0.0)
    kinds = jnp.stack([down, upward, crossed * slanted], axis=1)
    return jnp.einsum("ukl,ulw->ukw", kinds, reaching)


_at_depths = jax.vmap(_crossing, (None, 0, None, None, None), 1)


def _even_scattering(
    world: TracedScene, depths: Array, before: WalkBatch, after: WalkBatch, vertex: Vertex, unit, t
):
    """The contribution of each scattering to the depths in a uniformly drawn direction: light that
    a peaked phase function seldom scatters backward.  Its weight is 1 minus that of the walk's own
    direction (`_weights.own_share`)."""
    count, dtype = before.weight.shape[1], before.weight.dtype
    u = _array_rqmc.points(unit, t, world.words, count, dtype, (4, 5))
    steep = 2.0 * u[0] - 1.0
    level, azimuth = safe_sqrt(1.0 - steep**2), 2.0 * np.pi * u[1]
    direction = (level * jnp.cos(azimuth), level * jnp.sin(azimuth), steep)
    pairs = zip(direction, before.direction, strict=True)
    cosine = sum((a * b for a, b in pairs), start=jnp.zeros_like(steep))
    scattered = _weights.volume_scattering(world.medium, world.proposal, vertex, cosine)
    share = 1.0 - _weights.own_share(world.medium, vertex, cosine)
    walks = after._replace(counts=before.counts, direction=direction)
    return _at_depths(world, depths, walks, 4.0 * np.pi * share * after.weight, scattered)


def _e_foldings(world: TracedScene, z: Array) -> Array:
    """The number of e-foldings by which the light has decayed at a depth, at most _FAR."""
    depth = jnp.zeros_like(z)
    pairs = zip(_random_walk.bounds(world.domain), world.proposal.decay, strict=True)
    for (top, bottom), rate in pairs:
        depth = depth + rate * (jnp.clip(z, top, bottom) - top)
    return jnp.minimum(depth, _FAR)


def _returned_share(world: TracedScene) -> Array:
    """The share of the light that a layer and all below it send back up, (layer,), by two streams
    (Kubelka & Munk), the mean of all bands, at least 0.001."""
    medium = jax.lax.stop_gradient(world.medium)
    below = jnp.zeros_like(medium.c[0]) if world.domain.floor is None else world.proposal.floor
    found = []
    for i, (top, bottom) in reversed(list(enumerate(_random_walk.bounds(world.domain)))):
        rows, phases = medium.rows[i], medium.phases[i]
        even = 1.0 - jnp.stack([jnp.asarray(p.asymmetry, rows.dtype) for p in phases])
        back, a = 0.5 * (even @ rows), medium.c[i] - jnp.sum(rows, axis=0)
        fall = jnp.maximum(safe_sqrt(a * (a + 2.0 * back)), 1e-6 * medium.c[i] + 1e-9)
        # 1.5: mean path length of diffuse light over the vertical distance.
        optical = 1.5 * fall * (bottom - top)
        turned = jnp.tanh(optical) / (fall + (a + back) * jnp.tanh(optical))
        through = 1.0 / (jnp.cosh(optical) + (a + back) / fall * jnp.sinh(optical))
        own = back * turned
        below = own + through**2 * below / (1.0 - own * below)
        found.insert(0, jnp.maximum(jnp.mean(below), 1e-3))
    return jnp.stack(found)


def _importance(world: TracedScene, depths: Array, turning: Array, walks: WalkBatch) -> Array:
    """Importance of a walk: its expected contribution to each depth relative to the light there,
    which decays with distance as the light does.  Walks are thus concentrated where there is little
    light.  The rarer upward light is (`turning`), the more important an upward walk is to the
    depths above it, and the less important to those below."""
    z = walks.position[2]
    own, wanted = _e_foldings(world, z)[..., None], _e_foldings(world, depths)[None, None, :]
    turning = turning[_random_walk.layer_of(world.domain, z)][..., None] ** _TILT
    up = (walks.direction[2] < 0)[..., None]
    above = jnp.exp(2.0 * wanted - own) * jnp.where(up, 1.0 / turning, 1.0)
    below = jnp.exp(own) * jnp.where(up, turning, 1.0)
    return jnp.mean(jnp.where(wanted <= own, above, below), axis=-1)


def _rate(world: TracedScene, walks: WalkBatch) -> Array:
    """Rate at which flights are drawn, relative to the proposal's: downward flights are stretched
    (exponential transform; Clark 1966, Nucl. Sci. Eng. 26:236)."""
    proposal, layer = world.proposal, _random_walk.layer_of(world.domain, walks.position[2])
    fall = proposal.decay[layer] / proposal.rate[layer]
    return 1.0 - _LONGER * fall * jnp.maximum(walks.direction[2], 0.0)


class Entry(NamedTuple):
    """The light that enters the water: the cosine of the sunbeam, and the flux of each source,
    (wl,), the sun's first."""

    cosine: Array
    fluxes: tuple[Array, ...]


def entry(scene: Scene) -> Entry:
    """The fluxes of the sun and, where there is one, of the sky; the latter above the surface."""
    cosine, sun = scene.beam()
    cosine = jax.lax.stop_gradient(cosine)
    fluxes = (sun * cosine,)
    if scene.light.diffuse is not None:
        fluxes = (*fluxes, scene.light.diffuse * np.pi)
    return Entry(cosine, fluxes)


def enter(
    world: TracedScene,
    entry: Entry,
    unit: UInt32[Array, " unit"],
    groups: int,
    bands: int | None,
    group: int = GROUP,
) -> tuple[WalkBatch, Array, Array]:
    """Walks just below the surface, for unit flux: `groups` units for the sun, then as many for the
    sky, each of `group` walks; whether they are the sun's, (unit, 1); their spectra, (unit, wl)."""
    shape, cosine = (len(unit), group), entry.cosine
    level = -safe_sqrt(1.0 - cosine**2)
    beam = (level, jnp.zeros_like(level), cosine)
    direction = tuple(jnp.broadcast_to(part, shape) for part in beam)
    weight, sunlit = jnp.ones(shape, cosine.dtype), jnp.ones((len(unit), 1), bool)
    spectrum = jnp.broadcast_to(entry.fluxes[0], (len(unit), *entry.fluxes[0].shape))
    if len(entry.fluxes) > 1:
        sunlit = (unit < groups)[:, None]
        other, through = _from_sky(world, unit, group)
        direction = tuple(jnp.where(sunlit, s, o) for s, o in zip(direction, other, strict=True))
        weight = jnp.where(sunlit, weight, through)
        spectrum = jnp.where(sunlit, *(flux[None, :] for flux in entry.fluxes))
    position = (jnp.zeros(shape, cosine.dtype),) * 3
    walks = _event_loop.initial_state(world.domain, position, direction, bands)
    return walks._replace(weight=weight), sunlit, spectrum


def split(sums, entry: Entry, groups: int) -> list:
    """Sums (unit, ...), divided by source."""
    return [
        jax.tree.map(lambda v, i=i: v[i * groups : (i + 1) * groups], sums)
        for i in range(len(entry.fluxes))
    ]


def _elastic(
    scene: Scene,
    world: TracedScene,
    depths: Array,
    plan: WalkSettings,
    entry: Entry,
    group: int,
    gathers: bool,
):
    """Means of groups of walks by source, for unit flux on the surface, (unit, depth, 3, wl), of
    all events and of the last quarter; `gathers`: whether walks are resampled by importance."""
    groups = -(-plan.paths // (group * len(entry.fluxes)))

    def run(unit):
        walks, sunlit, _ = enter(world, entry, unit, groups, _event_loop.carried(scene), group)
        walks = walks._replace(own=jnp.ones_like(walks.weight))

        def score(world, before, ahead, after, vertex, t):
            del ahead
            # The sunbeam itself is added in closed form.
            new = jnp.where((t == 0) & sunlit, 0.0, before.weight * before.own)
            found = _at_depths(world, depths, before, new, None)
            return found + _even_scattering(world, depths, before, after, vertex, unit, t)

        order = SortOrder(
            lambda walks: -jnp.expm1(-_e_foldings(world, walks.position[2])), None, None
        )
        if gathers:
            turning = _returned_share(world)
            order = order._replace(
                importance=lambda walks: _importance(world, depths, turning, walks),
                rate=lambda walks: _rate(world, walks),
            )
        shape = (len(unit), depths.shape[0], 3, len(scene.wavelength))
        blank = jnp.zeros(shape, walks.weight.dtype)
        return _event_loop.walk(world, walks, unit, plan, score, blank, order)[0]

    sums = _event_loop.in_chunks(run, groups * len(entry.fluxes), plan.progress, group)
    return split(sums, entry, groups)


def _inelastic(
    scene: Scene,
    world: TracedScene,
    depths: Array,
    plan: WalkSettings,
    entry: Entry,
    inelastic_orders: int,
):
    """The same for light that has changed its wavelength, for the actual fluxes."""
    groups = -(-plan.paths // (GROUP * len(entry.fluxes)))
    bands = len(scene.wavelength)

    def run(unit):
        walks, _, spectrum = enter(world, entry, unit, groups, None)
        walks = with_spectra(walks, spectrum)

        def score(before, ahead, inelastic_order):
            del ahead
            new = jnp.where(inelastic_order > 0, before.weight, 0.0)
            return _at_depths(world, depths, before, new, None)

        blank = jnp.zeros((len(unit), depths.shape[0], 3, bands), walks.weight.dtype)
        return forward_inelastic(scene, world, walks, unit, plan, inelastic_orders, score, blank)[0]

    sums = _event_loop.in_chunks(run, groups * len(entry.fluxes), plan.progress)
    return split(sums, entry, groups)


@eqx.filter_jit
def irradiance(
    scene: Scene,
    depths: Float[Array, " depth"],
    words: UInt32[Array, " 2"],
    plan: WalkSettings,
    proposal: Proposal | None,
    inelastic_orders: int = 1,
) -> Estimate:
    """(depth, 3, wl): Ed, Eu, E0, with `inelastic_orders` orders of inelastic light."""
    scene, depths = fixed_scene(scene), fixed("depths", depths)
    world = _event_loop.world(scene, words, proposal)
    light = entry(scene)
    group = grouped(plan.paths // len(light.fluxes))
    found = []
    # Frozen walks are not resampled: their importance depends on the water.
    sums = _elastic(scene, world, depths, plan, light, group, proposal is None)
    for own, flux in zip(sums, light.fluxes, strict=True):
        own = tuple(v * flux[None, None, None] for v in own)
        found.append(_event_loop.estimate(own, scene, plan))
    if scene.inelastic is not None:
        world = _event_loop.world(scene, words, proposal, spectral=True)
        sums = _inelastic(scene, world, depths, plan, light, inelastic_orders)
        found += [_event_loop.estimate(own, scene, plan) for own in sums]
    cosine, sun = light.cosine, scene.beam()[1]
    beam = _beam(world, depths, cosine, sun)
    kinds = jnp.stack([cosine, jnp.zeros_like(cosine), jnp.ones_like(cosine)])
    found = _event_loop.summed(found)
    value = found.value + beam[:, None, :] * kinds[None, :, None]
    return Estimate(value, found.stderr, found.bias)


def _beam(world: TracedScene, depths: Array, cosine: Array, sun: Array) -> Float[Array, "depth wl"]:
    """The sunbeam at depths, normal to itself."""
    lengths = _random_walk.by_layer(world.domain, jnp.zeros_like(depths), depths, depths / cosine)
    optical = jnp.zeros((depths.shape[0], sun.shape[0]), sun.dtype)
    for length, c in zip(lengths, world.medium.c, strict=True):
        optical += _weights.outer(length, c)
    return sun[None, :] * jnp.exp(-optical)
