"""Forward walks that change their wavelength: inelastic light of any order.

At each scattering a walk converts with probability 1/2.  A walk that converts continues with the
spectrum that its light excites there, the bands mixed by the matrices of all processes together,
and may convert again.  Conversion efficiencies are factors of the weight, not probabilities.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from oceaninv.scene.scene import Scene
from oceaninv.transport.monte_carlo import _event_loop, _random_walk, _weights
from oceaninv.transport.monte_carlo._event_loop import GROUP, TracedScene, WalkSettings
from oceaninv.transport.monte_carlo._random_numbers import turn, uniforms
from oceaninv.transport.monte_carlo._random_walk import WalkBatch
from oceaninv.water.inelastic import sources

_HALF = 0.5  # chance to convert at each scattering
_OWN = 0x7FEB352D  # sets these walks apart from the elastic ones
_COIN = 0x6C078965


def with_spectra(walks: WalkBatch, spectrum: Float[Array, "unit wl"]) -> WalkBatch:
    """Walks in their initial state that carry the spectra of their units."""
    shape = (*walks.weight.shape, spectrum.shape[1])
    return walks._replace(spectral=jnp.broadcast_to(spectrum[:, None, :], shape))


def forward_inelastic(
    scene: Scene,
    world: TracedScene,
    walks: WalkBatch,
    unit: UInt32[Array, " unit"],
    plan: WalkSettings,
    inelastic_orders: int,
    score: Callable,
    blank: Any,
) -> tuple[tuple[Any, Any], WalkBatch, Array]:
    """The sums of `score(before, ahead, inelastic_order)`, arrays (unit, ...), over all events and
    over the last quarter; the walks at their ends; and how often each converted.

    `blank`: zeros of the shape of the scores; `walks` and `world` carry a spectral factor.
    """
    domain, proposal, medium, _ = world
    words = world.words ^ jnp.uint32(_OWN)
    assert scene.inelastic is not None
    processes = [sources(scene.inelastic, water) for water in _weights.waters(scene)]
    path = unit[:, None] * jnp.uint32(GROUP) + jnp.arange(GROUP, dtype=jnp.uint32)[None, :]
    nowhere = tuple(jnp.zeros_like(s) for s in walks.lengths)
    late = plan.bounces - max(plan.bounces // 4, 1)

    def emitted(exciting, layer, cosine):
        """Light emitted at an angle by what excites it, relative to isotropic emission."""
        total = jnp.zeros_like(exciting)
        for i, process in enumerate(processes):
            for matrix, phase in process:
                ratio = jnp.where(layer == i, 4.0 * jnp.pi * phase(cosine), 0.0)
                total += ratio[..., None] * (exciting @ matrix.astype(exciting.dtype))
        return total

    def step(carry, t):
        walks, inelastic_order, (whole, tail) = carry
        dtype = walks.weight.dtype
        u, v = uniforms(path, t, words, dtype), uniforms(path, t, words ^ jnp.uint32(_COIN), dtype)
        ahead = _random_walk.flight(domain, proposal, walks)
        after, vertex = _random_walk.advance(domain, proposal, walks, ahead, u)
        scores = score(walks, ahead, inelastic_order)
        whole = jax.tree.map(jnp.add, whole, scores)
        tail = jax.tree.map(lambda s, new: s + jnp.where(t >= late, new, 0.0), tail, scores)

        may = vertex.scattered & (inelastic_order < inelastic_orders)
        now = may & (v[0] < _HALF)
        # The emission replaces this scattering, which is not counted.
        arrived = after._replace(counts=walks.counts)
        share = after.weight / (_HALF * proposal.rate[vertex.layer])
        exciting = share[..., None] * _weights.attenuated(medium, arrived, nowhere)
        fresh = _event_loop.initial_state(
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

        walks = jax.tree.map(choose, fresh, after)
        return (walks, jnp.where(now, inelastic_order + 1, inelastic_order), (whole, tail)), None

    carry = (walks, jnp.zeros(walks.weight.shape, jnp.int32), (blank, blank))
    times = jnp.arange(plan.bounces, dtype=jnp.uint32)
    (walks, inelastic_order, sums), _ = jax.lax.scan(step, carry, times)
    return sums, walks, inelastic_order
