"""The loop over events: walks in groups, thinned as they grow old, scored on the way."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from oceaninv._numerics import safe_sqrt
from oceaninv.iops import Layers
from oceaninv.scene import Scene
from oceaninv.transport import _paths, _weights
from oceaninv.transport._paths import Domain, Flight, Lanes, Proposal, Vertex
from oceaninv.transport._sampling import Vector, uniforms
from oceaninv.transport._weights import Medium
from oceaninv.transport.base import Estimate

GROUP = 32  # walks that are thinned together: the unit of independence
_YOUNG = 6  # events before the thinning
_PART = 8  # one walk in so many is kept
_CHUNK = 8192  # walks side by side
_COMB = 0x9E3779B9  # sets the draws of the thinning apart from those of the walks


class Plan(NamedTuple):
    """Walks per ray (or in all), events per walk, whether walks are thinned."""

    paths: int
    bounces: int
    thin: bool


class World(NamedTuple):
    """Where walks go and what they meet."""

    domain: Domain
    proposal: Proposal
    medium: Medium
    words: UInt32[Array, " 2"]


def stages(plan: Plan) -> list[tuple[int, int, int]]:
    """(first event, events, lanes per group) of every stage: two at most, for each is compiled."""
    if not plan.thin or plan.bounces <= _YOUNG:
        return [(0, plan.bounces, GROUP)]
    return [(0, _YOUNG, GROUP), (_YOUNG, plan.bounces - _YOUNG, GROUP // _PART)]


# (before, ahead, after, vertex, event) -> (unit, ...), summed over the lanes of a unit.
Score = Callable[[Lanes, Flight, Lanes, Vertex, Array], Array]


def walk(
    world: World,
    lanes: Lanes,
    unit: UInt32[Array, " unit"],
    plan: Plan,
    score: Score,
    shape: tuple[int, ...],
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Summed scores, of `shape`, of all events and of the last quarter of them."""
    domain, proposal, medium, words = world
    dtype = lanes.weight.dtype
    late = plan.bounces - max(plan.bounces // 4, 1)
    sums = (jnp.zeros(shape, dtype), jnp.zeros(shape, dtype))
    for first, events, kept in stages(plan):
        if kept < lanes.weight.shape[1]:
            event = jnp.asarray(first, jnp.uint32)
            u = uniforms(unit, event, words ^ jnp.uint32(_COMB), dtype)
            lanes = _weights.comb(medium, lanes, kept, u[0])
        path = unit[:, None] * jnp.uint32(GROUP) + jnp.arange(kept, dtype=jnp.uint32)[None, :]

        def step(carry, t, path=path):
            lanes, (whole, tail) = carry
            u = uniforms(path, t, words, dtype)
            ahead = _paths.flight(domain, proposal, lanes)
            after, vertex = _paths.advance(domain, proposal, lanes, ahead, u)
            scores = score(lanes, ahead, after, vertex, t)
            direction, cosine, density = _paths.deflect(proposal, after, vertex, ahead, u)
            scalar, spectral = _weights.scatter(medium, after, vertex, ahead, cosine, density)
            after = after._replace(
                direction=direction, weight=after.weight * scalar, spectral=spectral
            )
            if after.limit is not None:
                after = after._replace(limit=jnp.full_like(after.limit, jnp.inf))
            tail = tail + jnp.where(t >= late, scores, 0.0)
            return (after, (whole + scores, tail)), None

        times = jnp.arange(first, first + events, dtype=jnp.uint32)
        (lanes, sums), _ = jax.lax.scan(step, (lanes, sums), times)
    return sums


def standing(
    domain: Domain,
    position: Vector,
    direction: Vector,
    wavelengths: int | None,
    limit: Array | None = None,
) -> Lanes:
    """Walks at their start; `wavelengths` where a spectral factor is carried."""
    zero = jnp.zeros_like(position[2])
    layers = (zero,) * (domain.edges.shape[0] + 1)
    spectral = None
    if wavelengths is not None:
        spectral = jnp.ones((*zero.shape, wavelengths), zero.dtype)
    return Lanes(position, direction, jnp.ones_like(zero), layers, layers, zero, spectral, limit)


def world(scene: Scene, words: UInt32[Array, " 2"], proposal: Proposal | None = None) -> World:
    """The scene as walks see it."""
    edges = jnp.zeros((0,), scene.light.direct.dtype)
    if isinstance(scene.water, Layers):
        edges = scene.water.interfaces.astype(edges.dtype)
    floor = None if scene.floor is None else scene.floor.depth
    index = None if scene.surface is None else scene.surface.index.astype(edges.dtype)
    rows = jnp.eye(len(scene.objects), dtype=edges.dtype)
    things = tuple(
        eqx.tree_at(lambda o: o.reflectance, thing, row)
        for thing, row in zip(scene.objects, rows, strict=True)
    )
    domain = jax.lax.stop_gradient(Domain(edges, floor, index, things))
    proposal = _weights.propose(scene) if proposal is None else proposal
    return World(domain, proposal, _weights.medium(scene, proposal), words)


def carried(scene: Scene) -> int | None:
    """How many bands a walk's spectral factor has, where it needs one."""
    return len(scene.wavelength) if _weights.mixed(scene) else None


def in_chunks(run: Callable, units: int):
    """run(unit numbers) over all units, a fixed number of walks at a time: (unit, ...)."""
    block = max(min(_CHUNK // GROUP, units), 1)
    blocks = -(-units // block)
    numbers = jnp.arange(blocks * block, dtype=jnp.uint32).reshape(blocks, block)
    # Checkpointed: reverse mode then stores one block's walks, not all.
    found = jax.lax.map(jax.checkpoint(run), numbers)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:units] / GROUP, found)


def estimate(sums: tuple[Array, Array], scene: Scene, bounces: int) -> Estimate:
    """Mean over groups (axis 0), its standard error, and the truncation bound."""
    whole, tail = sums
    value = jnp.mean(whole, axis=0)
    groups = whole.shape[0]
    spread = jnp.var(jax.lax.stop_gradient(whole), axis=0) / max(groups - 1, 1)
    stderr = safe_sqrt(spread) if groups > 1 else jnp.full_like(spread, jnp.nan)
    # Each further event multiplies what is left by the albedo at most.
    albedo = jnp.max(jnp.stack([w.albedo for w in _weights.waters(scene)]), axis=0)
    albedo = jax.lax.stop_gradient(albedo).reshape((1,) * (value.ndim - 1) + (-1,))
    last = jnp.abs(jnp.mean(jax.lax.stop_gradient(tail), axis=0)) / max(bounces // 4, 1)
    room = 1.0 - albedo
    # That holds once contributions decline: not while the last quarter still brings a tenth.
    declining = last * max(bounces // 4, 1) <= 0.1 * jnp.abs(jax.lax.stop_gradient(value))
    known = (room > 0) & declining
    bias = jnp.where(known, last * albedo / jnp.where(room > 0, room, 1.0), jnp.nan)
    return Estimate(value, stderr, bias)


def summed(parts: list[Estimate]) -> Estimate:
    """The sum of independent estimates."""
    if len(parts) == 1:
        return parts[0]
    variance = jnp.sum(jnp.stack([part.stderr**2 for part in parts]), axis=0)
    value, bias = (
        jnp.sum(jnp.stack([getattr(part, name) for part in parts]), axis=0)
        for name in ("value", "bias")
    )
    return Estimate(value, safe_sqrt(variance), bias)
