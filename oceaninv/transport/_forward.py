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
from oceaninv.transport._sampling import uniforms
from oceaninv.transport._walks import GROUP, Plan, World
from oceaninv.transport.base import Estimate

_GRAZING = 0.01  # below this cosine, 1/cosine counts as its mean over the band, 2/0.01
_SKY = 0x51ED270B  # sets the draws of the sky's directions apart


def _entering(world: World, unit: UInt32[Array, " unit"], cosine: Array | None):
    """Directions and weights of walks that start at the surface: along the beam of a `cosine`, or
    from a uniform sky, as flux."""
    shape = (len(unit), GROUP)
    if cosine is not None:
        level = -safe_sqrt(1.0 - cosine**2)
        parts = (level, jnp.zeros_like(level), cosine)
        return tuple(jnp.broadcast_to(p, shape) for p in parts), jnp.ones(shape, cosine.dtype)
    path = unit[:, None] * jnp.uint32(GROUP) + jnp.arange(GROUP, dtype=jnp.uint32)[None, :]
    words = world.words ^ jnp.uint32(_SKY)
    u = uniforms(path, jnp.uint32(0), words, world.proposal.rate.dtype)
    above = jnp.sqrt(u[0])
    index = world.domain.index
    weight = jnp.ones(shape, above.dtype)
    if index is not None:
        weight = 1.0 - fresnel_from_air(above, index)
        above = refracted_cosine(above, index)
    level, azimuth = safe_sqrt(1.0 - above**2), 2.0 * np.pi * u[1]
    return (level * jnp.cos(azimuth), level * jnp.sin(azimuth), above), weight


def _crossing(scene: Scene, world: World, depths: Array, before, ahead, weight):
    """Ed, Eu and E0 that walks bring to each depth ahead, (unit, depth, 3, wl)."""
    z, steep = before.position[2], jnp.maximum(jnp.abs(before.direction[2]), 1e-6)
    slanted = jnp.where(steep < _GRAZING, 2.0 / _GRAZING, 1.0 / steep)
    found = []
    for depth in depths:
        passes = jnp.where(ahead.up, depth < z, depth >= z)
        length = jnp.where(passes, jnp.abs(depth - z) / steep, 0.0)
        beyond = _paths.by_layer(world.domain, z, jnp.where(passes, depth, z), length)
        reaching = _weights.attenuated(world.medium, before, beyond)
        crossed = jnp.where(passes, weight, 0.0)
        down, up = jnp.where(ahead.up, 0.0, crossed), jnp.where(ahead.up, crossed, 0.0)
        kinds = jnp.stack([down, up, crossed * slanted], axis=1)
        found.append(jnp.einsum("ukl,ulw->ukw", kinds, reaching))
    return jnp.stack(found, axis=1)


def _from(scene: Scene, world: World, depths: Array, plan: Plan, cosine: Array | None):
    """Group sums for unit flux on the surface: (unit, depth, 3, wl), whole and late."""

    def score(before, ahead, after, vertex, t):
        del after, vertex
        # The sunbeam itself is added in closed form.
        first = t == 0
        weight = before.weight if cosine is None else jnp.where(first, 0.0, before.weight)
        return _crossing(scene, world, depths, before, ahead, weight)

    def run(unit):
        direction, weight = _entering(world, unit, cosine)
        position = (jnp.zeros_like(weight),) * 3
        lanes = _walks.standing(world.domain, position, direction, _walks.carried(scene))
        lanes = lanes._replace(weight=weight)
        shape = (len(unit), depths.shape[0], 3, len(scene.wavelength))
        return _walks.walk(world, lanes, unit, plan, score, shape)

    return _walks.in_chunks(run, max(plan.paths // GROUP, 1))


@eqx.filter_jit
def irradiance(scene: Scene, depths: Float[Array, " depth"], words, plan: Plan) -> Estimate:
    """(depth, 3, wl): Ed, Eu, E0."""
    scene, depths = fixed_scene(scene), fixed("depths", depths)
    world = _walks.world(scene, words)
    cosine, sun = scene.beam()
    cosine = jax.lax.stop_gradient(cosine)
    sky = scene.light.diffuse
    if sky is not None:
        plan = plan._replace(paths=-(-plan.paths // 2))
    plan = plan._replace(paths=-(-plan.paths // GROUP) * GROUP)
    sums = _from(scene, world, depths, plan, cosine)
    lit = (sun * cosine)[None, None, None, :]
    found = _walks.estimate(tuple(v * lit for v in sums), scene, plan.bounces)
    if sky is not None:
        sums = _from(scene, world, depths, plan, None)
        lit = (sky * np.pi)[None, None, None, :]
        other = _walks.estimate(tuple(v * lit for v in sums), scene, plan.bounces)
        stderr = jnp.sqrt(found.stderr**2 + other.stderr**2)
        found = Estimate(found.value + other.value, stderr, found.bias + other.bias)
    beam = _beam(world, depths, cosine, sun)
    kinds = jnp.stack([cosine, jnp.zeros_like(cosine), jnp.ones_like(cosine)])
    value = found.value + beam[:, None, :] * kinds[None, :, None]
    return Estimate(value, found.stderr, found.bias)


def _beam(world: World, depths: Array, cosine: Array, sun: Array) -> Float[Array, "depth wl"]:
    """The sunbeam at depths, normal to itself."""
    lengths = _paths.by_layer(world.domain, jnp.zeros_like(depths), depths, depths / cosine)
    optical = sum(
        (_weights.outer(s, c) for s, c in zip(lengths, world.medium.c, strict=True)),
        start=jnp.zeros((depths.shape[0], sun.shape[0]), sun.dtype),
    )
    return sun[None, :] * jnp.exp(-optical)
