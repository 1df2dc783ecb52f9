"""Pictures of things whose distances are known: the light of any transport on a range map."""

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

    A line of sight that meets something gathers the light of the water on the way (a finite ray)
    and what the thing sends: it is Lambertian, under the sun and the diffuse light of its depth,
    both of the same transport.  Things out of the water or under the floor do not count.  They
    cast no shadows; light between them is neglected.  The errors stated are those of the water's
    light.
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
