"""Tallies of the energy that walks deposit in the water, at the floor and above the surface."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from oceaninv.scene.scene import Scene
from oceaninv.transport.monte_carlo import _event_loop, _random_walk, _weights
from oceaninv.transport.monte_carlo._event_loop import GROUP, TracedScene, WalkSettings
from oceaninv.transport.monte_carlo._forward import Entry, enter, entry, split
from oceaninv.transport.monte_carlo._forward_inelastic import forward_inelastic, with_spectra
from oceaninv.transport.monte_carlo._random_walk import Domain, Flight, Proposal, WalkBatch

_ENDLESS = 1e30  # metres


class Tracks(NamedTuple):
    """Energy of every group of walks.

    `light`: scalar irradiance integrated over the depth of each layer, W m-1; the others in W m-2:
    `escaped` through the surface, `floor`: arriving there, `left` after the last event, `entered`.
    """

    light: Float[Array, "group layer wl"]
    escaped: Float[Array, "group wl"]
    floor: Float[Array, "group wl"]
    left: Float[Array, "group wl"]
    entered: Float[Array, "group wl"]


def _nowhere(walks: WalkBatch) -> tuple[Array, ...]:
    return tuple(jnp.zeros_like(s) for s in walks.lengths)


def _lengths(domain: Domain, walks: WalkBatch, ahead: Flight) -> list[Array]:
    """Length of the way ahead in each layer, m, `_ENDLESS` included."""
    z, mu = walks.position[2], walks.direction[2]
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


def _deposit(world: TracedScene, walks: WalkBatch, ahead: Flight, energy: Array):
    """(light by layer, escaped, floor) of flights: expected values, summed over a unit's walks.
    `energy`: (unit, walk, wl)."""
    lengths, c = _lengths(world.domain, walks, ahead), world.medium.c
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


def _of(world: TracedScene, walks: WalkBatch, spectrum: Array) -> Array:
    """Energy of walks, (unit, walk, wl)."""
    inside = _weights.attenuated(world.medium, walks, _nowhere(walks))
    return walks.weight[..., None] * inside * spectrum[:, None, :]


def elastic(
    scene: Scene,
    words: UInt32[Array, " 2"],
    plan: WalkSettings,
    proposal: Proposal | None,
    width: Float[Array, " wl"],
) -> tuple[list[Tracks], Float[Array, "group event"]]:
    """Tracks of the light of each source, inelastic events counted as absorption; and the energy
    lost from the water between one event and the next, summed over bands."""
    world = _event_loop.world(scene, words, proposal)
    light, groups = _entry(scene, plan)
    waters, bands = _weights.waters(scene), len(scene.wavelength)
    absorption = jnp.stack([w.a for w in waters])
    black = jnp.ones(bands) if scene.floor is None else 1.0 - scene.floor.reflectance

    def run(unit):
        walks, _, spectrum = enter(world, light, unit, groups, _event_loop.carried(scene))
        spectrum = spectrum * width[None, :]

        def score(world, before, ahead, after, vertex, t):
            del after, vertex
            found = _deposit(world, before, ahead, _of(world, before, spectrum))
            gone = jnp.sum(found[0] * absorption[None], axis=(1, 2))
            gone += jnp.sum(found[1] + found[2] * black.astype(width.dtype)[None], axis=1)
            now = (jnp.arange(plan.bounces, dtype=t.dtype) == t).astype(width.dtype)
            return *found, gone[:, None] * now[None, :]

        level = jnp.zeros((len(unit), bands), width.dtype)
        layered = jnp.zeros((len(unit), len(waters), bands), width.dtype)
        gone = jnp.zeros((len(unit), plan.bounces), width.dtype)
        (found, _), last = _event_loop.walk(
            world, walks, unit, plan, score, (layered, level, level, gone)
        )
        left = jnp.sum(_of(world, last, spectrum), axis=1)
        entered = jnp.sum(walks.weight, axis=1)[:, None] * spectrum
        track, escaped, low, gone = found
        return Tracks(track, escaped, low, left, entered), gone

    tracks, gone = _event_loop.in_chunks(run, groups * len(light.fluxes), plan.progress)
    return split(tracks, light, groups), sum(split(gone, light, groups)[1:], gone[:groups])


def inelastic(
    scene: Scene,
    words: UInt32[Array, " 2"],
    plan: WalkSettings,
    proposal: Proposal | None,
    width: Float[Array, " wl"],
    inelastic_orders: int,
) -> list[Tracks]:
    """Tracks of each order of inelastic light; `entered` is 0."""
    world = _event_loop.world(scene, words, proposal, spectral=True)
    light, groups = _entry(scene, plan)
    layers, bands = len(_weights.waters(scene)), len(scene.wavelength)

    def run(unit):
        walks, _, spectrum = enter(world, light, unit, groups, None)
        walks = with_spectra(walks, spectrum)
        widths = jnp.broadcast_to(width, (len(unit), bands))

        def score(before, ahead, inelastic_order):
            energy = _of(world, before, widths)
            each = [
                _deposit(
                    world, before, ahead, jnp.where((inelastic_order == g)[..., None], energy, 0.0)
                )
                for g in range(1, inelastic_orders + 1)
            ]
            return tuple(jnp.stack(v, axis=1) for v in zip(*each, strict=True))

        level = jnp.zeros((len(unit), inelastic_orders, bands), width.dtype)
        layered = jnp.zeros((len(unit), inelastic_orders, layers, bands), width.dtype)
        (found, _), last, inelastic_order = forward_inelastic(
            scene, world, walks, unit, plan, inelastic_orders, score, (layered, level, level)
        )
        energy = _of(world, last, widths)
        left = [
            jnp.sum(jnp.where((inelastic_order == g)[..., None], energy, 0.0), axis=1)
            for g in range(1, inelastic_orders + 1)
        ]
        track, escaped, low = found
        return Tracks(track, escaped, low, jnp.stack(left, axis=1), level)

    sources = split(
        _event_loop.in_chunks(run, groups * len(light.fluxes), plan.progress), light, groups
    )
    both = jax.tree.map(lambda *parts: sum(parts[1:], parts[0]), *sources)
    return [jax.tree.map(lambda v, g=g: v[:, g], both) for g in range(inelastic_orders)]


def _entry(scene: Scene, plan: WalkSettings) -> tuple[Entry, int]:
    light = entry(scene)
    return light, -(-plan.paths // (GROUP * len(light.fluxes)))
