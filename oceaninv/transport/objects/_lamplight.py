"""Light of lamps in the water: on objects and the floor, and scattered once into lines of sight."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from oceaninv.foundation.interface_optics import Rays
from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.scene.light import AbstractLamp, SpotLamp
from oceaninv.scene.objects import blocked
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import homogeneous
from oceaninv.transport.closed_form._two_moment_field import DeltaScaledWater

_NEAREST = 1e-3  # metres from a lamp, within which its light does not grow further


def lamplight(
    scene: Scene,
    rays: Rays,
    end: Float[Array, " ray"],
    normal: Float[Array, "ray 3"],
    reflectance: Float[Array, "ray wl"],
    met: Bool[Array, " ray"],
    on_floor: Bool[Array, " ray"],
    through: Float[Array, "ray wl"],
    steps: int,
) -> Float[Array, "ray wl"]:
    """Radiance that all lamps add.  `end`: length of the rays; `through`: transmittance from
    there; `normal`, `reflectance`: of the object that was met."""
    near = jnp.where(met | on_floor, end, 0.0)
    at = rays.origin + near[:, None] * rays.direction
    up = jnp.asarray([0.0, 0.0, -1.0], at.dtype)
    normal = jnp.where(met[:, None], normal, up[None, :])
    if scene.floor is not None:
        reflectance = jnp.where(on_floor[:, None], scene.floor.reflectance[None, :], reflectance)
    reflectance = jnp.where((met | on_floor)[:, None], reflectance, 0.0)
    total = jnp.zeros_like(through)
    for lamp in scene.lamps:
        across, arriving = _arriving(scene, lamp, at)
        facing = jnp.maximum(-jnp.sum(across * normal, axis=1), 0.0)
        total = total + reflectance / jnp.pi * arriving * facing[:, None] * through
        total = total + _scattered(scene, lamp, rays, end, steps)
    return total


def _arriving(scene: Scene, lamp: AbstractLamp, at):
    """Direction of a lamp's light at points, (ray, 3), and its irradiance across it, (ray, wl)."""
    apart = at - lamp.position[None, :]
    distance = jnp.sqrt(jnp.sum(apart**2, axis=1) + _NEAREST**2)
    across = apart / distance[:, None]
    sent = jax.vmap(lamp.along)(across)
    c_star = DeltaScaledWater(homogeneous(scene)).attenuation.c_star
    irradiance = sent * jnp.exp(-c_star[None, :] * distance[:, None]) / distance[:, None] ** 2
    if scene.objects:
        dark = jax.vmap(lambda x, d, r: blocked(scene.objects, x, -d, r))(at, across, distance)
        irradiance = jnp.where(dark[:, None], 0.0, irradiance)
    return across, irradiance


def _lit(lamp: AbstractLamp, rays: Rays, end):
    """The stretch of each ray that a lamp can light, metres: 0 to `end`, or its part in a cone."""
    start = jnp.zeros_like(end)
    if not isinstance(lamp, SpotLamp):
        return start, end
    apart = rays.origin - lamp.position[None, :]
    height, rise = apart @ lamp.direction, rays.direction @ lamp.direction
    squared = jnp.cos(jnp.deg2rad(lamp.half_angle)) ** 2
    # (height + rise t)^2 = squared |apart + t direction|^2 on the cone and its mirror image.
    a = rise**2 - squared
    b = height * rise - squared * jnp.sum(apart * rays.direction, axis=1)
    c = height**2 - squared * jnp.sum(apart**2, axis=1)
    along = jnp.abs(a) < 64.0 * float(jnp.finfo(a.dtype).eps)  # beside the cone: all of the ray
    root = safe_sqrt(b**2 - a * c)
    large = -b - jnp.where(b >= 0, root, -root)
    none = large == 0
    pair = large / jnp.where(along, 1.0, a), jnp.where(none, 0.0, c / jnp.where(none, 1.0, large))
    near, far = jnp.minimum(*pair), jnp.maximum(*pair)
    # A ray steeper than the cone stays in it, or in its image; another passes through one of them.
    steep, through = a > 0, (root > 0) & (height + 0.5 * rise * (near + far) > 0)
    onward = rise > 0
    first = jnp.where(steep, jnp.where(onward, far, start), near)
    last = jnp.where(steep, jnp.where(onward, end, near), jnp.where(through, far, near))
    first = jnp.where(along, start, jnp.clip(first, start, end))
    return first, jnp.where(along, end, jnp.clip(last, first, end))


def _scattered(scene: Scene, lamp: AbstractLamp, rays: Rays, end, steps: int):
    """Scattered once on the way, as far as the lamp shines on it.  Steps are equal in the angle at
    which the lamp sees them, which takes the inverse square of the distance out of the integral
    (Kulla & Fajardo 2012)."""
    first, last = _lit(lamp, rays, end)
    apart = lamp.position[None, :] - rays.origin
    closest = jnp.sum(apart * rays.direction, axis=1)
    aside = apart - closest[:, None] * rays.direction
    gap = jnp.sqrt(jnp.sum(aside**2, axis=1) + _NEAREST**2)
    low = jnp.arctan2(first - closest, gap)
    width = (jnp.arctan2(last - closest, gap) - low) / steps
    water = homogeneous(scene)
    c_star = DeltaScaledWater(water).attenuation.c_star[None, :]

    def add(i, total):
        t = closest + gap * jnp.tan(low + (i + 0.5) * width)
        x = rays.origin + t[:, None] * rays.direction
        across, arriving = _arriving(scene, lamp, x)
        # Light travels along -direction to the eye.
        turned = water.volume_scattering(-jnp.sum(across * rays.direction, axis=1))
        distance_squared = gap**2 + (t - closest) ** 2
        weight = (width / gap * distance_squared)[:, None]
        return total + turned * arriving * jnp.exp(-c_star * t[:, None]) * weight

    zero = jnp.zeros((rays.origin.shape[0], c_star.shape[1]), rays.origin.dtype)
    return jax.lax.fori_loop(0, steps, add, zero)
