"""Radiance of a range map: objects at known distances in the light of any transport."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from oceaninv.foundation.interface_optics import Rays
from oceaninv.scene.range_map import Ranged
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import AbstractTransport, Estimate, homogeneous
from oceaninv.transport.closed_form._ray_integral import ENDLESS
from oceaninv.transport.objects import _surface_irradiance


@eqx.filter_jit
def ranged_radiance(
    scene: Scene,
    rays: Rays,
    seen: Ranged,
    reflectance: Float[Array, "part wl"],
    transport: AbstractTransport,
    key: Key[Array, ""] | None = None,
) -> Estimate:
    """Radiance along the lines of sight of a camera, (ray, wl), with a range map.

    The radiance of a line of sight that meets an object is that of the water on the way (a finite
    ray) plus that of the object: it is Lambertian, under the sun and the diffuse light of its
    depth from where it looks, scaled to Ed and Eu of the same transport.  Objects out of the water
    or below the floor are ignored.  Objects cast no shadows, and light between them is
    neglected.  The errors stated are those of the water's light.
    """
    fall = rays.direction[:, 2]
    depth = rays.origin[:, 2] + seen.distance * fall
    met = seen.met & (depth > 0)
    if scene.floor is not None:
        met = met & (depth < scene.floor.depth)
    length = jnp.where(met, seen.distance, ENDLESS)
    water = transport.radiance(scene, Rays(rays.origin, rays.direction, length), key)
    depth = jnp.where(met, depth, rays.origin[:, 2])
    light = _surface_irradiance.light(transport, scene, jnp.min(depth), jnp.max(depth), key)
    distance = jnp.where(met, seen.distance, 0.0)
    at = rays.origin + distance[:, None] * rays.direction
    falling = _surface_irradiance.irradiance(scene, light, at, seen.normal, met)
    own = (seen.texture @ reflectance) / jnp.pi * falling
    own = own * jnp.exp(-homogeneous(scene).c[None, :] * distance[:, None])
    return Estimate(water.value + jnp.where(met[:, None], own, 0.0), water.stderr, water.bias)
