"""Walks from the light that change their wavelength: forward inelastic light, of any order.

At each scattering the toss of a coin decides whether a walk converts.  A walk that does leaves
with the spectrum that its light excites there, the bands mixed by the matrices of all processes at
once, and may convert again: generation after generation, each event a factor, never a chance.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from oceaninv.scene.scene import Scene
from oceaninv.transport.monte_carlo import _event_loop, _random_walk, _weights
from oceaninv.transport.monte_carlo._event_loop import GROUP, Plan, World
from oceaninv.transport.monte_carlo._random_numbers import turn, uniforms
from oceaninv.transport.monte_carlo._random_walk import Lanes
from oceaninv.water.inelastic import sources

_HALF = 0.5  # chance to convert at each scattering
_OWN = 0x7FEB352D  # sets these walks apart from the elastic ones
_COIN = 0x6C078965


def coloured(lanes: Lanes, spectrum: Float[Array, "unit wl"]) -> Lanes:
    """Lanes at their start that carry the spectra of their units."""
    shape = (*lanes.weight.shape, spectrum.shape[1])
    return lanes._replace(spectral=jnp.broadcast_to(spectrum[:, None, :], shape))


def converted(
    scene: Scene,
    world: World,
    lanes: Lanes,
    unit: UInt32[Array, " unit"],
    plan: Plan,
    generations: int,
    score: Callable,
    blank: Any,
) -> tuple[tuple[Any, Any], Lanes, Array]:
    """`score(before, ahead, generation)`, arrays (unit, ...), summed from `blank` zeros on over all
    events and over the last quarter; the walks at their ends, and how often each converted.

    `lanes` and `world` carry a spectral factor.
    """
    domain, proposal, medium, _ = world
    words = world.words ^ jnp.uint32(_OWN)
    assert scene.inelastic is not None
    processes = [sources(scene.inelastic, water) for water in _weights.waters(scene)]
    path = unit[:, None] * jnp.uint32(GROUP) + jnp.arange(GROUP, dtype=jnp.uint32)[None, :]
    nowhere = tuple(jnp.zeros_like(s) for s in lanes.lengths)
    late = plan.bounces - max(plan.bounces // 4, 1)

    def emitted(exciting, layer, cosine):
        """What light makes the water emit at an angle, relative to as much in all directions."""
        total = jnp.zeros_like(exciting)
        for i, process in enumerate(processes):
            for matrix, phase in process:
                ratio = jnp.where(layer == i, 4.0 * jnp.pi * phase(cosine), 0.0)
                total += ratio[..., None] * (exciting @ matrix.astype(exciting.dtype))
        return total

    def step(carry, t):
        lanes, generation, (whole, tail) = carry
        dtype = lanes.weight.dtype
        u, v = uniforms(path, t, words, dtype), uniforms(path, t, words ^ jnp.uint32(_COIN), dtype)
        ahead = _random_walk.flight(domain, proposal, lanes)
        after, vertex = _random_walk.advance(domain, proposal, lanes, ahead, u)
        scores = score(lanes, ahead, generation)
        whole = jax.tree.map(jnp.add, whole, scores)
        tail = jax.tree.map(lambda s, new: s + jnp.where(t >= late, new, 0.0), tail, scores)

        may = vertex.scattered & (generation < generations)
        now = may & (v[0] < _HALF)
        # The emission takes the place of this scattering, which does not count.
        arrived = after._replace(counts=lanes.counts)
        share = after.weight / (_HALF * proposal.rate[vertex.layer])
        exciting = share[..., None] * _weights.attenuated(medium, arrived, nowhere)
        fresh = _event_loop.standing(
            domain, after.position, turn(after.direction, v[1], v[2]), None
        )
        fresh = fresh._replace(spectral=emitted(exciting, vertex.layer, 1.0 - 2.0 * v[1]))

        direction, cosine, density = _random_walk.deflect(proposal, after, vertex, ahead, u)
        scalar, spectral = _weights.scatter(medium, after, vertex, ahead, cosine, density)
        stays = jnp.where(may, 1.0 / (1.0 - _HALF), 1.0)
        after = after._replace(
            direction=direction, weight=after.weight * scalar * stays, spectral=spectral
        )

        def choose(new, old):
            return jnp.where(now[..., None] if new.ndim > now.ndim else now, new, old)

        lanes = jax.tree.map(choose, fresh, after)
        return (lanes, jnp.where(now, generation + 1, generation), (whole, tail)), None

    carry = (lanes, jnp.zeros(lanes.weight.shape, jnp.int32), (blank, blank))
    times = jnp.arange(plan.bounces, dtype=jnp.uint32)
    (lanes, generation, sums), _ = jax.lax.scan(step, carry, times)
    return sums, lanes, generation
