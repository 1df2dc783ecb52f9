"""Walks from the eye with inelastic events: seen in one band, excited in all others at once.

A walk converts at some of its scatterings, by the toss of a coin.  Up to there it is weighed in the
bands of emission, from there on in those of excitation, and the matrix between the bands joins the
two: probabilities of 1e-3 to 1e-9 are factors, never chances.  It may convert again: what was seen
on each stretch is kept until the end, when the matrices are applied from the last stretch back to
the eye.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from oceaninv.scene.scene import Scene
from oceaninv.transport.monte_carlo import _event_loop, _random_walk, _weights
from oceaninv.transport.monte_carlo._direct_light import arrivals
from oceaninv.transport.monte_carlo._event_loop import GROUP, Plan, World
from oceaninv.transport.monte_carlo._random_numbers import turn, uniforms
from oceaninv.transport.monte_carlo._random_walk import Lanes
from oceaninv.water.inelastic import sources

_HALF = 0.5  # chance to convert at each scattering
_OWN = 0x2545F491  # sets these walks apart from the elastic ones
_COIN = 0x6C078965


class _Change(NamedTuple):
    """One change of wavelength: weight on the stretch before it, (..., wl); light that excites it,
    in all and late, by process; 4 pi times the phase function of the turn, by process; its layer.
    """

    seen: Float[Array, "... wl"]
    excited: tuple[Float[Array, "... wl"], ...]
    tail: tuple[Float[Array, "... wl"], ...]
    ratios: tuple[Float[Array, "..."], ...]
    layer: Int[Array, "..."]


def shifted(
    scene: Scene,
    world: World,
    stand: Callable[[UInt32[Array, " unit"]], Lanes],
    score: Callable,
    plan: Plan,
    generations: int,
    unit: UInt32[Array, " unit"],
) -> tuple[Float[Array, "unit wl"], Float[Array, "unit wl"]]:
    """Summed radiance by group, of all events and of the last quarter of them.

    `score(world, before, ahead, after, vertex)`: elastic contributions, (unit, lane, wl).
    """
    domain, proposal, medium, _ = world
    words = world.words ^ jnp.uint32(_OWN)
    inelastic = scene.inelastic
    assert inelastic is not None
    processes = [sources(inelastic, water) for water in _weights.waters(scene)]
    phases = [phase for _, phase in processes[0]]
    lanes = stand(unit)
    path = unit[:, None] * jnp.uint32(GROUP) + jnp.arange(GROUP, dtype=jnp.uint32)[None, :]
    dark = jnp.zeros((*lanes.weight.shape, len(scene.wavelength)), lanes.weight.dtype)
    nowhere = tuple(jnp.zeros_like(s) for s in lanes.lengths)
    late = plan.bounces - max(plan.bounces // 4, 1)

    def step(carry, t):
        lanes, changes, made = carry
        dtype = lanes.weight.dtype
        u, v = uniforms(path, t, words, dtype), uniforms(path, t, words ^ jnp.uint32(_COIN), dtype)
        ahead = _random_walk.flight(domain, proposal, lanes)
        after, vertex = _random_walk.advance(domain, proposal, lanes, ahead, u)
        found = score(world, lanes, ahead, after, vertex)

        may = vertex.scattered & (made < generations)
        now = may & (v[0] < _HALF)
        arrived = after._replace(counts=lanes.counts)
        share = after.weight / (_HALF * proposal.rate[vertex.layer])
        reaching = share[..., None] * _weights.attenuated(medium, arrived, nowhere)
        fresh = _event_loop.standing(
            domain,
            after.position,
            turn(after.direction, v[1], v[2]),
            _event_loop.carried(scene),
            lanes.limit if lanes.limit is None else jnp.full_like(lanes.limit, jnp.inf),
        )
        direct = [dark for _ in phases]
        for light in arrivals(scene, domain, after.position):
            clear = light.spectrum * _weights.attenuated(medium, fresh, light.lengths)
            pairs = zip(light.towards, after.direction, strict=True)
            cosine = sum((a * b for a, b in pairs), start=jnp.zeros_like(after.weight))
            for i, phase in enumerate(phases):
                direct[i] += phase(cosine)[..., None] * clear
        turned = [4.0 * jnp.pi * phase(1.0 - 2.0 * v[1]) for phase in phases]

        def changed(own: _Change, order: int) -> _Change:
            """With this event's light; `order`: how many changes there were before this one."""
            after_it, here = made == order + 1, now & (made == order)
            gains = [
                jnp.where(after_it[..., None], ratio[..., None] * found, 0.0)
                + jnp.where(here[..., None], sun, 0.0)
                for ratio, sun in zip(own.ratios, direct, strict=True)
            ]
            pairs = zip(own.excited, own.tail, gains, strict=True)
            both = [(e + g, x + jnp.where(t >= late, g, 0.0)) for e, x, g in pairs]
            return _Change(
                jnp.where(here[..., None], reaching, own.seen),
                tuple(e for e, _ in both),
                tuple(x for _, x in both),
                tuple(
                    jnp.where(here, new, old) for new, old in zip(turned, own.ratios, strict=True)
                ),
                jnp.where(here, vertex.layer, own.layer),
            )

        changes = tuple(changed(own, order) for order, own in enumerate(changes))
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

        lanes = jax.tree.map(choose, fresh, after)
        return (lanes, changes, jnp.where(now, made + 1, made)), None

    none = jnp.zeros(lanes.weight.shape, jnp.int32)
    blank, ones = (dark,) * len(phases), (jnp.ones_like(lanes.weight),) * len(phases)
    carry = (lanes, (_Change(dark, blank, blank, ones, none),) * generations, none)
    times = jnp.arange(plan.bounces, dtype=jnp.uint32)
    (_, changes, _), _ = jax.lax.scan(step, carry, times)

    def joined(which):
        """From the last change back to the eye."""
        emitted = dark
        for own in reversed(changes):
            total = jnp.zeros_like(dark)
            for i, process in enumerate(processes):
                here = jnp.where((own.layer == i)[..., None], own.seen, 0.0)
                parts = zip(getattr(own, which), own.ratios, process, strict=True)
                for light, ratio, (matrix, _) in parts:
                    light = light + ratio[..., None] * emitted
                    total += here * (light @ matrix.astype(light.dtype))
            emitted = total
        return jnp.sum(emitted, axis=1)

    return joined("excited"), joined("tail")
