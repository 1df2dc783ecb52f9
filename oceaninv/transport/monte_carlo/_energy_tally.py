"""What walks leave behind in the water, at the floor and above the surface, band by band."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from oceaninv.scene.scene import Scene
from oceaninv.transport.monte_carlo import _event_loop, _random_walk, _weights
from oceaninv.transport.monte_carlo._event_loop import GROUP, Plan, World
from oceaninv.transport.monte_carlo._forward import Entry, enter, entry, split
from oceaninv.transport.monte_carlo._forward_inelastic import coloured, converted
from oceaninv.transport.monte_carlo._random_walk import Domain, Flight, Lanes, Proposal

_ENDLESS = 1e30  # metres


class Tracks(NamedTuple):
    """Of every group of walks, last axis wl.  `light` (group, layer, wl): scalar irradiance over
    the depth of each layer, W m-1; `escaped` through the surface, `floor`: what reaches it, `left`
    after the last event, `entered`: (group, wl), W m-2."""

    light: Float[Array, "group layer wl"]
    escaped: Float[Array, "group wl"]
    floor: Float[Array, "group wl"]
    left: Float[Array, "group wl"]
    entered: Float[Array, "group wl"]


def _nowhere(lanes: Lanes) -> tuple[Array, ...]:
    return tuple(jnp.zeros_like(s) for s in lanes.lengths)


def _lengths(domain: Domain, lanes: Lanes, ahead: Flight) -> list[Array]:
    """Metres in each layer of the way ahead, endless ones included."""
    z, mu = lanes.position[2], lanes.direction[2]
    level = jnp.abs(mu) < _random_walk.LEVEL
    steep = jnp.where(level, 1.0, jnp.abs(mu))
    own = _random_walk.layer_of(domain, z)
    parts = []
    for i, (length, (top, bottom)) in enumerate(
        zip(ahead.lengths, _random_walk.bounds(domain), strict=True)
    ):
        below = (jnp.maximum(bottom, z) - jnp.maximum(top, z)) / steep
        endless = jnp.where(level, jnp.where(own == i, _ENDLESS, 0.0), below)
        parts.append(jnp.minimum(jnp.where(ahead.ends, length, endless), _ENDLESS))
    return parts


def _deposit(world: World, lanes: Lanes, ahead: Flight, energy: Array):
    """(light by layer, escaped, floor) of flights, expected values, summed over a unit's lanes.
    `energy`: (unit, lane, wl)."""
    lengths, c = _lengths(world.domain, lanes, ahead), world.medium.c
    optical = [_weights.outer(s, own) for s, own in zip(lengths, c, strict=True)]
    down, up, both = [jnp.zeros_like(energy)], [jnp.zeros_like(energy)], ahead.up[..., None]
    for own in optical[:-1]:
        down.append(down[-1] + own)
    for own in optical[:0:-1]:
        up.insert(0, up[0] + own)
    light = []
    for i, own in enumerate(optical):
        reaching = energy * jnp.exp(-jnp.where(both, up[i], down[i]))
        thick = own > 1e-6
        rate = jnp.where(thick, jnp.broadcast_to(c[i], own.shape), 1.0)
        light.append(reaching * jnp.where(thick, -jnp.expm1(-own) / rate, lengths[i][..., None]))
    whole = energy * jnp.exp(-sum(optical[1:], optical[0]))
    out = jnp.where(ahead.up & ahead.ends, 1.0 - ahead.reflectance, 0.0)[..., None]
    low = (~ahead.up & ahead.ends)[..., None]
    light = jnp.stack([jnp.sum(v, axis=1) for v in light], axis=1)
    return light, jnp.sum(out * whole, axis=1), jnp.sum(jnp.where(low, whole, 0.0), axis=1)


def _of(world: World, lanes: Lanes, spectrum: Array) -> Array:
    """Energy of walks, (unit, lane, wl)."""
    inside = _weights.attenuated(world.medium, lanes, _nowhere(lanes))
    return lanes.weight[..., None] * inside * spectrum[:, None, :]


def elastic(
    scene: Scene,
    words: UInt32[Array, " 2"],
    plan: Plan,
    proposal: Proposal | None,
    width: Float[Array, " wl"],
) -> tuple[list[Tracks], Float[Array, "group event"]]:
    """Tracks of each source's light, inelastic events counted as absorption; what is gone from
    the water between one event and the next, in all bands."""
    world = _event_loop.world(scene, words, proposal)
    light, groups = _entry(scene, plan)
    waters, bands = _weights.waters(scene), len(scene.wavelength)
    taken = jnp.stack([w.a for w in waters])
    black = jnp.ones(bands) if scene.floor is None else 1.0 - scene.floor.reflectance

    def run(unit):
        lanes, _, spectrum = enter(world, light, unit, groups, _event_loop.carried(scene))
        spectrum = spectrum * width[None, :]

        def score(world, before, ahead, after, vertex, t):
            del after, vertex
            found = _deposit(world, before, ahead, _of(world, before, spectrum))
            gone = jnp.sum(found[0] * taken[None], axis=(1, 2))
            gone += jnp.sum(found[1] + found[2] * black.astype(width.dtype)[None], axis=1)
            now = (jnp.arange(plan.bounces, dtype=t.dtype) == t).astype(width.dtype)
            return *found, gone[:, None] * now[None, :]

        level = jnp.zeros((len(unit), bands), width.dtype)
        layered = jnp.zeros((len(unit), len(waters), bands), width.dtype)
        gone = jnp.zeros((len(unit), plan.bounces), width.dtype)
        (found, _), last = _event_loop.walk(
            world, lanes, unit, plan, score, (layered, level, level, gone)
        )
        left = jnp.sum(_of(world, last, spectrum), axis=1)
        entered = jnp.sum(lanes.weight, axis=1)[:, None] * spectrum
        track, escaped, low, gone = found
        return Tracks(track, escaped, low, left, entered), gone

    tracks, gone = _event_loop.in_chunks(run, groups * len(light.fluxes), plan.progress)
    return split(tracks, light, groups), sum(split(gone, light, groups)[1:], gone[:groups])


def inelastic(
    scene: Scene,
    words: UInt32[Array, " 2"],
    plan: Plan,
    proposal: Proposal | None,
    width: Float[Array, " wl"],
    generations: int,
) -> list[Tracks]:
    """Tracks of each generation of light that has changed its wavelength; `entered` is 0."""
    world = _event_loop.world(scene, words, proposal, spectral=True)
    light, groups = _entry(scene, plan)
    layers, bands = len(_weights.waters(scene)), len(scene.wavelength)

    def run(unit):
        lanes, _, spectrum = enter(world, light, unit, groups, None)
        lanes = coloured(lanes, spectrum)
        widths = jnp.broadcast_to(width, (len(unit), bands))

        def score(before, ahead, generation):
            energy = _of(world, before, widths)
            each = [
                _deposit(world, before, ahead, jnp.where((generation == g)[..., None], energy, 0.0))
                for g in range(1, generations + 1)
            ]
            return tuple(jnp.stack(v, axis=1) for v in zip(*each, strict=True))

        level = jnp.zeros((len(unit), generations, bands), width.dtype)
        layered = jnp.zeros((len(unit), generations, layers, bands), width.dtype)
        (found, _), last, generation = converted(
            scene, world, lanes, unit, plan, generations, score, (layered, level, level)
        )
        energy = _of(world, last, widths)
        left = [
            jnp.sum(jnp.where((generation == g)[..., None], energy, 0.0), axis=1)
            for g in range(1, generations + 1)
        ]
        track, escaped, low = found
        return Tracks(track, escaped, low, jnp.stack(left, axis=1), level)

    sources = split(
        _event_loop.in_chunks(run, groups * len(light.fluxes), plan.progress), light, groups
    )
    both = jax.tree.map(lambda *parts: sum(parts[1:], parts[0]), *sources)
    return [jax.tree.map(lambda v, g=g: v[:, g], both) for g in range(generations)]


def _entry(scene: Scene, plan: Plan) -> tuple[Entry, int]:
    light = entry(scene)
    return light, -(-plan.paths // (GROUP * len(light.fluxes)))
