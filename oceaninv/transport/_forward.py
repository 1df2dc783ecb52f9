"""Walks from the light into the water: irradiances at depths."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from oceaninv._numerics import safe_sqrt
from oceaninv.optics import fresnel_from_air, refracted_cosine
from oceaninv.scene import Scene
from oceaninv.transport import _paths, _walks, _weights
from oceaninv.transport._guard import fixed, fixed_scene
from oceaninv.transport._paths import Proposal
from oceaninv.transport._sampling import uniforms
from oceaninv.transport._walks import GROUP, Plan, World
from oceaninv.transport.base import Estimate

_GRAZING = 0.01  # below this cosine, 1/cosine counts as its mean over the band, 2/0.01
_SKY = 0x51ED270B  # sets the draws of the sky's directions apart


def _from_sky(world: World, unit: UInt32[Array, " unit"]):
    """Directions and weights of walks that enter from a uniform sky, as flux."""
    path = unit[:, None] * jnp.uint32(GROUP) + jnp.arange(GROUP, dtype=jnp.uint32)[None, :]
    words = world.words ^ jnp.uint32(_SKY)
    u = uniforms(path, jnp.uint32(0), words, world.proposal.rate.dtype)
    above = jnp.sqrt(u[0])
    index = world.domain.refraction
    weight = jnp.ones_like(above)
    if index is not None:
        weight = 1.0 - fresnel_from_air(above, index)
        above = refracted_cosine(above, index)
    level, azimuth = safe_sqrt(1.0 - above**2), 2.0 * np.pi * u[1]
    return (level * jnp.cos(azimuth), level * jnp.sin(azimuth), above), weight


def _crossing(world: World, depth: Array, before, ahead, weight):
    """Ed, Eu and E0 that walks bring to a depth ahead, (unit, 3, wl)."""
    z, steep = before.position[2], jnp.maximum(jnp.abs(before.direction[2]), 1e-6)
    slanted = jnp.where(steep < _GRAZING, 2.0 / _GRAZING, 1.0 / steep)
    passes = jnp.where(ahead.up, depth <= z, depth >= z)
    length = jnp.where(passes, jnp.abs(depth - z) / steep, 0.0)
    beyond = _paths.by_layer(world.domain, z, jnp.where(passes, depth, z), length)
    reaching = _weights.attenuated(world.medium, before, beyond)
    crossed = jnp.where(passes, weight, 0.0)
    down, up = jnp.where(ahead.up, 0.0, crossed), jnp.where(ahead.up, crossed, 0.0)
    kinds = jnp.stack([down, up, crossed * slanted], axis=1)
    return jnp.einsum("ukl,ulw->ukw", kinds, reaching)


def _sums(scene: Scene, world: World, depths: Array, plan: Plan, cosine: Array, groups: int):
    """Group sums for unit flux on the surface, (unit, depth, 3, wl), in all and late: `groups` of
    the sun, then as many of the sky where there is one."""
    sky = scene.light.diffuse is not None
    at_depths = jax.vmap(_crossing, (None, 0, None, None, None), 1)

    def run(unit):
        shape = (len(unit), GROUP)
        level = -safe_sqrt(1.0 - cosine**2)
        beam = (level, jnp.zeros_like(level), cosine)
        direction = tuple(jnp.broadcast_to(part, shape) for part in beam)
        weight, sunlit = jnp.ones(shape, cosine.dtype), jnp.ones((len(unit), 1), bool)
        if sky:
            sunlit = (unit < groups)[:, None]
            other, through = _from_sky(world, unit)
            pairs = zip(direction, other, strict=True)
            direction = tuple(jnp.where(sunlit, s, o) for s, o in pairs)
            weight = jnp.where(sunlit, weight, through)

        def score(before, ahead, after, vertex, t):
            del after, vertex
            # The sunbeam itself is added in closed form.
            new = jnp.where((t == 0) & sunlit, 0.0, before.weight)
            return at_depths(world, depths, before, ahead, new)

        position = (jnp.zeros(shape, cosine.dtype),) * 3
        lanes = _walks.standing(world.domain, position, direction, _walks.carried(scene))
        lanes = lanes._replace(weight=weight)
        sums = (len(unit), depths.shape[0], 3, len(scene.wavelength))
        return _walks.walk(world, lanes, unit, plan, score, sums)

    return _walks.in_chunks(run, groups * (2 if sky else 1))


@eqx.filter_jit
def irradiance(
    scene: Scene,
    depths: Float[Array, " depth"],
    words: UInt32[Array, " 2"],
    plan: Plan,
    proposal: Proposal | None,
) -> Estimate:
    """(depth, 3, wl): Ed, Eu, E0."""
    scene, depths = fixed_scene(scene), fixed("depths", depths)
    world = _walks.world(scene, words, proposal)
    cosine, sun = scene.beam()
    cosine = jax.lax.stop_gradient(cosine)
    spectra = [sun * cosine]
    if scene.light.diffuse is not None:
        spectra.append(scene.light.diffuse * np.pi)
    groups = -(-plan.paths // (GROUP * len(spectra)))
    sums = _sums(scene, world, depths, plan, cosine, groups)
    found = []
    for i, spectrum in enumerate(spectra):
        own = tuple(v[i * groups : (i + 1) * groups] * spectrum[None, None, None] for v in sums)
        found.append(_walks.estimate(own, scene, plan.bounces))
    beam = _beam(world, depths, cosine, sun)
    kinds = jnp.stack([cosine, jnp.zeros_like(cosine), jnp.ones_like(cosine)])
    found = _walks.summed(found)
    value = found.value + beam[:, None, :] * kinds[None, :, None]
    return Estimate(value, found.stderr, found.bias)


def _beam(world: World, depths: Array, cosine: Array, sun: Array) -> Float[Array, "depth wl"]:
    """The sunbeam at depths, normal to itself."""
    lengths = _paths.by_layer(world.domain, jnp.zeros_like(depths), depths, depths / cosine)
    optical = jnp.zeros((depths.shape[0], sun.shape[0]), sun.dtype)
    for length, c in zip(lengths, world.medium.c, strict=True):
        optical += _weights.outer(length, c)
    return sun[None, :] * jnp.exp(-optical)
