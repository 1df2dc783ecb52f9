"""Walks with exactly one inelastic event: seen in one band, excited in all others at once.

A walk from the eye converts at one of its scatterings, by the toss of a coin.  Up to there it is
weighed in the bands of emission, from there on in those of excitation, and the matrix between the
bands joins the two: probabilities of 1e-3 to 1e-9 are factors, never chances.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from oceaninv.inelastic import sources
from oceaninv.scene import Scene
from oceaninv.transport import _paths, _walks, _weights
from oceaninv.transport._lights import arrivals
from oceaninv.transport._paths import Lanes
from oceaninv.transport._sampling import turn, uniforms
from oceaninv.transport._walks import GROUP, Plan, World

_HALF = 0.5  # chance to convert at each scattering
_OWN = 0x2545F491  # sets these walks apart from the elastic ones
_COIN = 0x6C078965


def shifted(
    scene: Scene,
    world: World,
    stand: Callable[[UInt32[Array, " unit"]], Lanes],
    score: Callable,
    plan: Plan,
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
        lanes, seen, excited, tail, ratios, converted, layer = carry
        dtype = lanes.weight.dtype
        u, v = uniforms(path, t, words, dtype), uniforms(path, t, words ^ jnp.uint32(_COIN), dtype)
        ahead = _paths.flight(domain, proposal, lanes)
        after, vertex = _paths.advance(domain, proposal, lanes, ahead, u)
        found = jnp.where(converted[..., None], score(world, lanes, ahead, after, vertex), 0.0)
        gains = [ratio[..., None] * found for ratio in ratios]

        now = ~converted & vertex.scattered & (v[0] < _HALF)
        arrived = after._replace(counts=lanes.counts)
        share = after.weight / (_HALF * proposal.rate[vertex.layer])
        reaching = share[..., None] * _weights.attenuated(medium, arrived, nowhere)
        seen = jnp.where(now[..., None], reaching, seen)
        layer = jnp.where(now, vertex.layer, layer)
        fresh = _walks.standing(
            domain,
            after.position,
            turn(after.direction, v[1], v[2]),
            _walks.carried(scene),
            lanes.limit if lanes.limit is None else jnp.full_like(lanes.limit, jnp.inf),
        )
        for light in arrivals(scene, domain, after.position):
            clear = light.spectrum * _weights.attenuated(medium, fresh, light.lengths)
            pairs = zip(light.towards, after.direction, strict=True)
            cosine = sum((a * b for a, b in pairs), start=jnp.zeros_like(after.weight))
            for i, phase in enumerate(phases):
                direct = phase(cosine)[..., None] * clear
                gains[i] = gains[i] + jnp.where(now[..., None], direct, 0.0)
        turned = 1.0 - 2.0 * v[1]
        ratios = tuple(
            jnp.where(now, 4.0 * jnp.pi * phase(turned), ratio)
            for phase, ratio in zip(phases, ratios, strict=True)
        )
        excited = tuple(e + g for e, g in zip(excited, gains, strict=True))
        tail = tuple(e + jnp.where(t >= late, g, 0.0) for e, g in zip(tail, gains, strict=True))

        direction, cosine, density = _paths.deflect(proposal, after, vertex, ahead, u)
        scalar, spectral = _weights.scatter(medium, after, vertex, ahead, cosine, density)
        stays = jnp.where(vertex.scattered & ~converted, 1.0 / (1.0 - _HALF), 1.0)
        after = after._replace(
            direction=direction,
            weight=after.weight * scalar * stays,
            spectral=spectral,
            limit=fresh.limit,
        )

        def choose(new, old):
            return jnp.where(now[..., None] if new.ndim > now.ndim else now, new, old)

        lanes = jax.tree.map(choose, fresh, after)
        return (lanes, seen, excited, tail, ratios, converted | now, layer), None

    none = jnp.zeros(lanes.weight.shape, jnp.int32)
    blank = (dark,) * len(phases)
    ones = (jnp.ones_like(lanes.weight),) * len(phases)
    carry = (lanes, dark, blank, blank, ones, none > 0, none)
    (_, seen, excited, tail, _, _, layer), _ = jax.lax.scan(
        step, carry, jnp.arange(plan.bounces, dtype=jnp.uint32)
    )

    def joined(excited):
        total = jnp.zeros_like(dark)
        for i, process in enumerate(processes):
            here = jnp.where((layer == i)[..., None], seen, 0.0)
            for light, (matrix, _) in zip(excited, process, strict=True):
                total += here * (light @ matrix.astype(light.dtype))
        return jnp.sum(total, axis=1)

    return joined(excited), joined(tail)
