"""Backward walks, from the eye towards the light: the radiance along rays."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from oceaninv.foundation.interface_optics import Rays
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import Estimate
from oceaninv.transport.monte_carlo import _event_loop, _weights
from oceaninv.transport.monte_carlo._backward_inelastic import backward_inelastic
from oceaninv.transport.monte_carlo._direct_light import arrivals
from oceaninv.transport.monte_carlo._event_loop import GROUP, TracedScene, WalkSettings
from oceaninv.transport.monte_carlo._geometry_derivative_guard import fixed_rays, fixed_scene
from oceaninv.transport.monte_carlo._random_numbers import Vector
from oceaninv.transport.monte_carlo._random_walk import Proposal


def _scattered(scene: Scene, world: TracedScene, before, after, vertex) -> Float[Array, "... wl"]:
    """Direct light scattered towards the eye where the flight ended in the water."""
    found = jnp.zeros((*after.weight.shape, len(scene.wavelength)), after.weight.dtype)
    # This scattering is the last one; `turned` holds its factor, so it is not counted again.
    arrived = after._replace(counts=before.counts)
    for light in arrivals(scene, world.domain, after.position):
        cosine = _dot(light.towards, before.direction)
        turned = _weights.volume_scattering(world.medium, world.proposal, vertex, cosine)
        reaching = _weights.attenuated(world.medium, arrived, light.lengths)
        found += turned * reaching * light.spectrum
    return after.weight[..., None] * found


def _boundary(scene: Scene, world: TracedScene, before, ahead) -> Float[Array, "... wl"]:
    """The sky through the surface, or the lit floor or object, as seen at the flight's end."""
    domain = world.domain
    weight = before.weight[..., None]
    found = jnp.zeros((*before.weight.shape, len(scene.wavelength)), before.weight.dtype)
    if scene.light.diffuse is not None:
        squared = 1.0 if domain.refraction is None else domain.refraction**2
        through = jnp.where(ahead.up & ahead.ends, (1.0 - ahead.reflectance) * squared, 0.0)
        reaching = _weights.attenuated(world.medium, before, ahead.lengths)
        found += _weights.outer(through, scene.light.diffuse) * reaching
    if scene.floor is None and not scene.objects:
        return weight * found
    level = jnp.zeros_like(before.weight)
    normal, colour = (level, level, level - 1.0), jnp.zeros_like(found)
    end = tuple(p + ahead.distance * d for p, d in zip(*before[:2], strict=True))
    depth = jnp.maximum(end[2], 0.0)
    if scene.floor is not None and domain.floor is not None:
        down = ~ahead.up & ahead.ends
        depth = jnp.where(down, domain.floor, depth)
        colour += _weights.outer(jnp.where(down, 1 / np.pi, 0.0), scene.floor.reflectance)
    if ahead.normal is not None:
        met = ahead.met
        pairs = zip(ahead.normal, normal, strict=True)
        normal = tuple(jnp.where(met, own, floor) for own, floor in pairs)
        colour += (ahead.thing @ _weights.reflectances(scene)) / np.pi
    for light in arrivals(scene, domain, (end[0], end[1], depth)):
        facing = jnp.maximum(_dot(light.towards, normal), 0.0)
        beyond = tuple(s + d for s, d in zip(ahead.lengths, light.lengths, strict=True))
        reaching = _weights.attenuated(world.medium, before, beyond)
        found += colour * facing[..., None] * light.spectrum * reaching
    return weight * found


def _dot(a: Vector, b: Vector) -> Float[Array, "..."]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@eqx.filter_jit
def radiance(
    scene: Scene,
    rays: Rays,
    words: UInt32[Array, " 2"],
    plan: WalkSettings,
    proposal: Proposal | None,
    inelastic_orders: int = 1,
) -> Estimate:
    """(ray, wl), with `inelastic_orders` orders of inelastic light."""
    scene, rays = fixed_scene(scene), fixed_rays(rays)
    world = _event_loop.world(scene, words, proposal)
    groups = -(-plan.paths // GROUP)
    count, bands = rays.direction.shape[0], len(scene.wavelength)
    lit = scene.floor is not None or scene.objects
    bounded = lit or scene.light.diffuse is not None

    def each_walk(world, before, ahead, after, vertex):
        found = _scattered(scene, world, before, after, vertex)
        return found + _boundary(scene, world, before, ahead) if bounded else found

    def score(world, before, ahead, after, vertex, t):
        del t
        return jnp.sum(each_walk(world, before, ahead, after, vertex), axis=1)

    def start_walks(unit):
        ray = (unit // jnp.uint32(groups)).astype(jnp.int32)
        position, direction = (
            tuple(jnp.broadcast_to(v[ray, i][:, None], (len(unit), GROUP)) for i in range(3))
            for v in (rays.origin, rays.direction)
        )
        limit = rays.length
        if limit is not None:
            limit = jnp.broadcast_to(limit[ray][:, None], (len(unit), GROUP))
        return _event_loop.initial_state(
            world.domain, position, direction, _event_loop.carried(scene), limit
        )

    def elastic(unit):
        blank = jnp.zeros((len(unit), bands), scene.light.direct.dtype)
        return _event_loop.walk(world, start_walks(unit), unit, plan, score, blank)[0]

    def inelastic(unit):
        return backward_inelastic(
            scene, world, start_walks, each_walk, plan, inelastic_orders, unit
        )

    found = []
    for run in (elastic,) if scene.inelastic is None else (elastic, inelastic):
        sums = _event_loop.in_chunks(run, count * groups, plan.progress)
        sums = tuple(v.reshape(count, groups, bands).swapaxes(0, 1) for v in sums)
        found.append(_event_loop.estimate(sums, scene, plan))
    return _event_loop.summed(found)
