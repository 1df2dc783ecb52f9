"""Walks from the eye towards the light: the radiance along rays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from oceaninv._numerics import safe_sqrt
from oceaninv.optics import Rays
from oceaninv.scene import Scene
from oceaninv.transport import _paths, _walks, _weights
from oceaninv.transport._guard import fixed_rays, fixed_scene
from oceaninv.transport._paths import Proposal
from oceaninv.transport._walks import GROUP, Plan, World
from oceaninv.transport.base import Estimate


class _Sun:
    """The sunbeam under water: towards where it travels, how much, and through what."""

    def __init__(self, scene: Scene, world: World):
        cosine, self.irradiance = scene.beam()
        self.cosine = jax.lax.stop_gradient(cosine)
        self.domain = world.domain
        self.across = -safe_sqrt(1.0 - self.cosine**2)

    def lengths(self, depth: Float[Array, "..."]) -> tuple[Float[Array, "..."], ...]:
        """Its way down to a depth, by layer."""
        return _paths.by_layer(self.domain, jnp.zeros_like(depth), depth, depth / self.cosine)

    def turned(self, direction) -> Float[Array, "..."]:
        """Cosine of the angle by which it must turn to reach an eye looking along `direction`."""
        return -(self.across * direction[0] + self.cosine * direction[2])


def _scattered(world: World, sun: _Sun, before, after, vertex) -> Float[Array, "... wl"]:
    """Sunlight scattered towards the eye where the flight ended in the water."""
    turned = sun.turned(before.direction)
    light = _weights.volume_scattering(world.medium, world.proposal, vertex, turned)
    # This scattering is the last, and in `light`: it does not count among the earlier ones.
    arrived = after._replace(counts=before.counts)
    reaching = _weights.attenuated(world.medium, arrived, sun.lengths(after.position[2]))
    return after.weight[..., None] * light * reaching * sun.irradiance[None, None, :]


def _boundary(scene: Scene, world: World, sun: _Sun, before, ahead) -> Float[Array, "... wl"]:
    """The sky through the surface, or the sunlit floor, as seen at the end of the flight."""
    domain = world.domain
    depth = before.position[2]
    end = jnp.where(ahead.up, 0.0, depth if domain.floor is None else domain.floor)
    below = sun.lengths(end)
    beyond = tuple(s + d for s, d in zip(ahead.lengths, below, strict=True))
    weight = jnp.where(ahead.ends, before.weight, 0.0)
    colour = jnp.zeros((*weight.shape, len(scene.wavelength)), weight.dtype)
    if scene.light.diffuse is not None:
        squared = 1.0 if domain.refraction is None else domain.refraction**2
        through = jnp.where(ahead.up, weight * (1.0 - ahead.reflectance) * squared, 0.0)
        colour += _weights.outer(through, scene.light.diffuse)
    if scene.floor is not None:
        lit = scene.floor.reflectance * sun.irradiance * (sun.cosine / np.pi)
        colour += _weights.outer(jnp.where(ahead.up, 0.0, weight), lit)
    return colour * _weights.attenuated(world.medium, before, beyond)


@eqx.filter_jit
def radiance(
    scene: Scene, rays: Rays, words: UInt32[Array, " 2"], plan: Plan, proposal: Proposal | None
) -> Estimate:
    """(ray, wl)."""
    scene, rays = fixed_scene(scene), fixed_rays(rays)
    world = _walks.world(scene, words, proposal)
    sun = _Sun(scene, world)
    groups = -(-plan.paths // GROUP)
    count, bands = rays.direction.shape[0], len(scene.wavelength)
    bounded = scene.floor is not None or scene.light.diffuse is not None

    def score(before, ahead, after, vertex, t):
        del t
        found = jnp.sum(_scattered(world, sun, before, after, vertex), axis=1)
        if bounded:
            found += jnp.sum(_boundary(scene, world, sun, before, ahead), axis=1)
        return found

    def run(unit):
        ray = (unit // jnp.uint32(groups)).astype(jnp.int32)
        position, direction = (
            tuple(jnp.broadcast_to(v[ray, i][:, None], (len(unit), GROUP)) for i in range(3))
            for v in (rays.origin, rays.direction)
        )
        limit = rays.length
        if limit is not None:
            limit = jnp.broadcast_to(limit[ray][:, None], (len(unit), GROUP))
        lanes = _walks.standing(world.domain, position, direction, _walks.carried(scene), limit)
        return _walks.walk(world, lanes, unit, plan, score, (len(unit), bands))

    sums = _walks.in_chunks(run, count * groups)
    sums = tuple(v.reshape(count, groups, bands).swapaxes(0, 1) for v in sums)
    return _walks.estimate(sums, scene, plan.bounces)
