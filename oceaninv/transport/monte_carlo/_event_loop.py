"""The loop over events: walks in groups, scored at every event, resampled after some of them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32

from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import Estimate
from oceaninv.transport.monte_carlo import _array_rqmc, _random_walk, _weights
from oceaninv.transport.monte_carlo._array_rqmc import SortOrder
from oceaninv.transport.monte_carlo._random_numbers import Vector, spread, uniforms
from oceaninv.transport.monte_carlo._random_walk import Domain, Flight, Proposal, Vertex, WalkBatch
from oceaninv.transport.monte_carlo._weights import Medium
from oceaninv.water.iops import Layers

GROUP = 32  # walks that are resampled together: groups are independent of each other
_FIRST_RESAMPLING = 6  # events before the thinning
_RESAMPLING_FACTOR = 8  # one walk in so many is kept
_CHUNK = 8192  # walks side by side
_POPULATION_CONTROL = 0x9E3779B9  # sets the draws of the thinning apart from those of the walks


Progress = Callable[[int, int], None]


class WalkSettings(NamedTuple):
    """Settings of a run.

    `paths`: walks per ray (or in all); `bounces`: events per walk; `roulette`: whether walks are
    resampled 8:1; `similar`: number of events after which the water is replaced by a similar one
    that scatters isotropically (None: never); `progress(done, total)`: callback after each chunk.
    """

    paths: int
    bounces: int
    roulette: bool
    similar: int | None = None
    progress: Progress | None = None


class TracedScene(NamedTuple):
    """A scene in the form that walks use; `words`: of the random key."""

    domain: Domain
    proposal: Proposal
    medium: Medium
    words: UInt32[Array, " 2"]


class Stage(NamedTuple):
    """Events that are compiled together: the first one, their number, the walks per group, and
    whether the water is replaced by the similar one."""

    first: int
    events: int
    kept: int
    soft: bool


def stages(plan: WalkSettings, group: int) -> list[Stage]:
    """As few as possible, as each is compiled; `group`: walks per group at the start."""
    first_resampling = _FIRST_RESAMPLING if plan.roulette else plan.bounces
    soft = plan.bounces if plan.similar is None else plan.similar
    starts = sorted({0, *(n for n in (first_resampling, soft) if n < plan.bounces)})
    ends = [*starts[1:], plan.bounces]
    return [
        Stage(a, b - a, group if a < first_resampling else group // _RESAMPLING_FACTOR, a >= soft)
        for a, b in zip(starts, ends, strict=True)
    ]


# (world, before, ahead, after, vertex, event) -> arrays (unit, ...), summed over a unit's walks.
Score = Callable[[TracedScene, WalkBatch, Flight, WalkBatch, Vertex, Array], Any]


def walk(
    world: TracedScene,
    walks: WalkBatch,
    unit: UInt32[Array, " unit"],
    plan: WalkSettings,
    score: Score,
    blank: Any,
    order: SortOrder | None = None,
) -> tuple[tuple[Any, Any], WalkBatch]:
    """The sums of the scores over all events and over the last quarter of them, and the walks at
    their ends.  `blank`: zeros of the shape of the scores; `order`: the order in which walks take
    the points of a net at every event (None: they share strata)."""
    words, dtype = world.words, walks.weight.dtype
    soft = False
    late = plan.bounces - max(plan.bounces // 4, 1)
    sums = (blank, blank)
    group = walks.weight.shape[1]
    for first, events, kept, softer in stages(plan, group):
        if kept < walks.weight.shape[1]:
            event = jnp.asarray(first, jnp.uint32)
            u = uniforms(unit, event, words ^ jnp.uint32(_POPULATION_CONTROL), dtype)
            importance = 1.0
            if order is not None and order.importance is not None:
                importance = jax.lax.stop_gradient(order.importance(walks))
            walks = _weights.population_control(world.medium, walks, kept, u[0], importance)
        if softer and not soft:
            soft = True
            walks = _weights.flush_weights(world.medium, walks)
            proposal, medium = _weights.similar(world.proposal, world.medium)
            world = world._replace(proposal=proposal, medium=medium)
        path = unit[:, None] * jnp.uint32(group) + jnp.arange(kept, dtype=jnp.uint32)[None, :]

        def step(carry, t, path=path, kept=kept, world=world):
            domain, proposal, medium, _ = world
            walks, (whole, tail) = carry
            if order is None:
                u = spread(uniforms(path, t, words, dtype), unit, t, words)
            else:
                walks = _array_rqmc.sorted_and_resampled(walks, order, unit, t, words)
                u = _array_rqmc.points(unit, t, words, kept, dtype, (0, 1, 2, 3))
            ahead = _random_walk.flight(domain, proposal, walks)
            rate = None if order is None or order.rate is None else order.rate(walks)
            after, vertex = _random_walk.advance(domain, proposal, walks, ahead, u, rate)
            scores = score(world, walks, ahead, after, vertex, t)
            direction, cosine, density = _random_walk.deflect(proposal, after, vertex, ahead, u)
            scalar, spectral = _weights.scatter(medium, after, vertex, ahead, cosine, density)
            after = after._replace(
                direction=direction, weight=after.weight * scalar, spectral=spectral
            )
            if after.own is not None:
                after = after._replace(own=_weights.own_share(medium, vertex, cosine))
            if after.limit is not None:
                after = after._replace(limit=jnp.full_like(after.limit, jnp.inf))
            whole = jax.tree.map(jnp.add, whole, scores)
            tail = jax.tree.map(lambda s, new: s + jnp.where(t >= late, new, 0.0), tail, scores)
            return (after, (whole, tail)), None

        times = jnp.arange(first, first + events, dtype=jnp.uint32)
        (walks, sums), _ = jax.lax.scan(step, (walks, sums), times)
    return sums, walks


def initial_state(
    domain: Domain,
    position: Vector,
    direction: Vector,
    wavelengths: int | None,
    limit: Array | None = None,
) -> WalkBatch:
    """The initial state of walks; `wavelengths`: length of the spectral factor, None without it."""
    zero = jnp.zeros_like(position[2])
    layers = (zero,) * (domain.edges.shape[0] + 1)
    spectral = None
    if wavelengths is not None:
        spectral = jnp.ones((*zero.shape, wavelengths), zero.dtype)
    return WalkBatch(
        position, direction, jnp.ones_like(zero), layers, layers, zero, spectral, limit
    )


def world(
    scene: Scene,
    words: UInt32[Array, " 2"],
    proposal: Proposal | None = None,
    spectral: bool = False,
) -> TracedScene:
    """The scene in the form that walks use; `spectral`: whether walks carry a spectral factor even
    if water and objects need none."""
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
    spectral = spectral or _weights.mixed(scene)
    return TracedScene(domain, proposal, _weights.medium(scene, proposal, spectral), words)


def carried(scene: Scene) -> int | None:
    """The length of a walk's spectral factor; None where it needs none."""
    return len(scene.wavelength) if _weights.mixed(scene) else None


def in_chunks(run: Callable, units: int, progress: Progress | None = None, group: int = GROUP):
    """run(unit numbers) over all units of `group` walks, a fixed number of walks at a time, on all
    local devices in parallel: (unit, ...).  The result of a unit depends on its number alone."""
    devices = jax.local_devices()
    block = max(min(_CHUNK // group, -(-units // len(devices))), 1)
    chunks = -(-units // (block * len(devices)))
    shape = (len(devices), chunks, block)
    numbers = jnp.arange(np.prod(shape), dtype=jnp.uint32).reshape(shape)

    def one(number):
        # Checkpointed, so that reverse mode stores the walks of one block only.
        found = jax.checkpoint(run)(number)
        if progress is not None:
            jax.debug.callback(progress, number[0] // jnp.uint32(block), chunks * len(devices))
        return found

    def several(numbers):
        return jax.lax.map(one, numbers)

    if len(devices) == 1:
        found = several(numbers[0])
    else:
        mesh = jax.sharding.Mesh(np.asarray(devices), ("walks",))
        spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("walks"))
        numbers = jax.lax.with_sharding_constraint(numbers, spread)
        found = jax.vmap(several, spmd_axis_name="walks")(numbers)
        found = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:units] / group, found)


def estimate(sums: tuple[Array, Array], scene: Scene, plan: WalkSettings) -> Estimate:
    """Mean over groups (axis 0), its standard error, and the truncation bound."""
    bounces = plan.bounces
    whole, tail = sums
    value = jnp.mean(whole, axis=0)
    groups = whole.shape[0]
    spread = jnp.var(jax.lax.stop_gradient(whole), axis=0) / max(groups - 1, 1)
    stderr = safe_sqrt(spread) if groups > 1 else jnp.full_like(spread, jnp.nan)
    # Each further event multiplies the remaining light by the albedo at most.
    albedo = jnp.max(jnp.stack([w.albedo for w in _weights.waters(scene)]), axis=0)
    albedo = jax.lax.stop_gradient(albedo).reshape((1,) * (value.ndim - 1) + (-1,))
    last = jnp.abs(jnp.mean(jax.lax.stop_gradient(tail), axis=0)) / max(bounces // 4, 1)
    absorbed = 1.0 - albedo
    # The bound holds once contributions decline, hence not if the last quarter adds over a tenth.
    declining = last * max(bounces // 4, 1) <= 0.1 * jnp.abs(jax.lax.stop_gradient(value))
    known = (absorbed > 0) & declining & (plan.similar is None)
    bias = jnp.where(known, last * albedo / jnp.where(absorbed > 0, absorbed, 1.0), jnp.nan)
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
    # A single group has no standard error, and neither has a sum that includes one.
    stderr = jnp.where(jnp.isnan(variance), jnp.nan, safe_sqrt(variance))
    return Estimate(value, stderr, bias)
