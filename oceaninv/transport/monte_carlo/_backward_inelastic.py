"""Backward walks with inelastic events: seen in one band, excited in all others at once.

At each scattering a walk becomes inelastic with probability 1/2.  Before that event it is weighted
in the bands of emission, after it in those of excitation, and the matrix between the bands joins
the two.  Conversion efficiencies of 1e-3 to 1e-9 are thus factors, not probabilities.  A walk may
convert more than once: the light of each of its stretches is kept until the end, when the matrices
are applied from the last stretch back to the eye.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from oceaninv.scene.scene import Scene
from oceaninv.transport.monte_carlo import _event_loop, _random_walk, _weights
from oceaninv.transport.monte_carlo._direct_light import arrivals
from oceaninv.transport.monte_carlo._event_loop import GROUP, TracedScene, WalkSettings
from oceaninv.transport.monte_carlo._random_numbers import turn, uniforms
from oceaninv.transport.monte_carlo._random_walk import WalkBatch
from oceaninv.water.inelastic import sources

_HALF = 0.5  # chance to convert at each scattering
_OWN = 0x2545F491  # sets these walks apart from the elastic ones
_COIN = 0x6C078965


class _Change(NamedTuple):
    """One change of wavelength on a walk.

    `seen`: weight of the walk on the stretch before it, (..., wl); `excited`, `tail`: light that
    excites it, by process, in all events and in the last quarter; `ratios`: 4 pi times the phase
    function of the new direction, by process; `layer`: where it happens.
    """

    seen: Float[Array, "... wl"]
    excited: tuple[Float[Array, "... wl"], ...]
    tail: tuple[Float[Array, "... wl"], ...]
    ratios: tuple[Float[Array, "..."], ...]
    layer: Int[Array, "..."]


class _Event(NamedTuple):
    """An event of the elastic walk, and what it would be as an inelastic one.

    `found`: elastic contributions, (..., wl); `inelastic`: whether it is inelastic; `seen`: weight
    of the walk there, (..., wl); `direct`: direct light turned towards the walk, (..., wl), by
    process; `ratios`: 4 pi times the phase function of the new direction, by process; `layer`:
    where it is; `late`: whether it counts among the last quarter.
    """

    found: Float[Array, "... wl"]
    inelastic: Bool[Array, "..."]
    seen: Float[Array, "... wl"]
    direct: list[Float[Array, "... wl"]]
    ratios: list[Float[Array, "..."]]
    layer: Int[Array, "..."]
    late: Bool[Array, ""]


def _direct_light(scene: Scene, world: TracedScene, phases, dark, fresh: WalkBatch, incoming):
    """Light that comes straight from the sources, turned by each process's phase function towards
    the direction from which the walk arrived."""
    direct = [dark for _ in phases]
    for light in arrivals(scene, world.domain, fresh.position):
        clear = light.spectrum * _weights.attenuated(world.medium, fresh, light.lengths)
        pairs = zip(light.towards, incoming, strict=True)
        cosine = sum((a * b for a, b in pairs), start=jnp.zeros_like(fresh.weight))
        for i, phase in enumerate(phases):
            direct[i] += phase(cosine)[..., None] * clear
    return direct


def _recorded(change: _Change, order: int, made: Int[Array, "..."], event: _Event) -> _Change:
    """`change` with the contributions of an event.  `order`: how many changes precede it on its
    walk; `made`: how many the walk has made before the event."""
    after_it, here = made == order + 1, event.inelastic & (made == order)
    gains = [
        jnp.where(after_it[..., None], ratio[..., None] * event.found, 0.0)
        + jnp.where(here[..., None], sun, 0.0)
        for ratio, sun in zip(change.ratios, event.direct, strict=True)
    ]
    pairs = zip(change.excited, change.tail, gains, strict=True)
    both = [(e + g, x + jnp.where(event.late, g, 0.0)) for e, x, g in pairs]
    return _Change(
        jnp.where(here[..., None], event.seen, change.seen),
        tuple(e for e, _ in both),
        tuple(x for _, x in both),
        tuple(
            jnp.where(here, new, old) for new, old in zip(event.ratios, change.ratios, strict=True)
        ),
        jnp.where(here, event.layer, change.layer),
    )


def _joined(changes: tuple[_Change, ...], processes, dark, which: str) -> Float[Array, "unit wl"]:
    """Radiance at the eye: the matrices between bands applied from the last change to the first.
    `which`: "excited" or "tail"."""
    emitted = dark
    for change in reversed(changes):
        total = jnp.zeros_like(dark)
        for i, process in enumerate(processes):
            here = jnp.where((change.layer == i)[..., None], change.seen, 0.0)
            parts = zip(getattr(change, which), change.ratios, process, strict=True)
            for light, ratio, (matrix, _) in parts:
                light = light + ratio[..., None] * emitted
                total += here * (light @ matrix.astype(light.dtype))
        emitted = total
    return jnp.sum(emitted, axis=1)


def backward_inelastic(
    scene: Scene,
    world: TracedScene,
    start: Callable[[UInt32[Array, " unit"]], WalkBatch],
    score: Callable,
    plan: WalkSettings,
    inelastic_orders: int,
    unit: UInt32[Array, " unit"],
) -> tuple[Float[Array, "unit wl"], Float[Array, "unit wl"]]:
    """Summed radiance by group, of all events and of the last quarter of them.

    `start(unit)`: the walks at the eye; `score(world, before, ahead, after, vertex)`: elastic
    contributions, (unit, walk, wl).
    """
    domain, proposal, medium, _ = world
    words = world.words ^ jnp.uint32(_OWN)
    inelastic = scene.inelastic
    assert inelastic is not None
    processes = [sources(inelastic, water) for water in _weights.waters(scene)]
    phases = [phase for _, phase in processes[0]]
    walks = start(unit)
    path = unit[:, None] * jnp.uint32(GROUP) + jnp.arange(GROUP, dtype=jnp.uint32)[None, :]
    dark = jnp.zeros((*walks.weight.shape, len(scene.wavelength)), walks.weight.dtype)
    nowhere = tuple(jnp.zeros_like(s) for s in walks.lengths)
    late = plan.bounces - max(plan.bounces // 4, 1)

    def step(carry, t):
        walks, changes, made = carry
        dtype = walks.weight.dtype
        u, v = uniforms(path, t, words, dtype), uniforms(path, t, words ^ jnp.uint32(_COIN), dtype)
        ahead = _random_walk.flight(domain, proposal, walks)
        after, vertex = _random_walk.advance(domain, proposal, walks, ahead, u)
        found = score(world, walks, ahead, after, vertex)

        may = vertex.scattered & (made < inelastic_orders)
        now = may & (v[0] < _HALF)
        # The emission replaces this scattering, which is not counted.
        arrived = after._replace(counts=walks.counts)
        share = after.weight / (_HALF * proposal.rate[vertex.layer])
        reaching = share[..., None] * _weights.attenuated(medium, arrived, nowhere)
        fresh = _event_loop.initial_state(
            domain,
            after.position,
            turn(after.direction, v[1], v[2]),
            _event_loop.carried(scene),
            walks.limit if walks.limit is None else jnp.full_like(walks.limit, jnp.inf),
        )
        direct = _direct_light(scene, world, phases, dark, fresh, after.direction)
        turned = [4.0 * jnp.pi * phase(1.0 - 2.0 * v[1]) for phase in phases]
        event = _Event(found, now, reaching, direct, turned, vertex.layer, t >= late)
        changes = tuple(
            _recorded(change, order, made, event) for order, change in enumerate(changes)
        )
        direction, cosine, density = _random_walk.deflect(proposal, after, vertex, ahead, u)
        scalar, spectral = _weights.scatter(medium, after, vertex, ahead, cosine, density)
        stays = jnp.where(may, 1.0 / (1.0 - _HALF), 1.0)
        after = after._replace(
            direction=direction,
            weight=after.weight * scalar * stays,
            spectral=spectral,
            limit=fresh.limit,
        )

        def choose(new, old):
            return jnp.where(now[..., None] if new.ndim > now.ndim else now, new, old)

        walks = jax.tree.map(choose, fresh, after)
        return (walks, changes, jnp.where(now, made + 1, made)), None

    none = jnp.zeros(walks.weight.shape, jnp.int32)
    blank, ones = (dark,) * len(phases), (jnp.ones_like(walks.weight),) * len(phases)
    carry = (walks, (_Change(dark, blank, blank, ones, none),) * inelastic_orders, none)
    times = jnp.arange(plan.bounces, dtype=jnp.uint32)
    (_, changes, _), _ = jax.lax.scan(step, carry, times)
    excited, tail = (_joined(changes, processes, dark, which) for which in ("excited", "tail"))
    return excited, tail
