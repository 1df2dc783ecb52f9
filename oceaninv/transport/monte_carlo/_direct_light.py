"""Direct light on a point under water: the sunbeam, and lamps with their mirror images."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv.foundation.interface_optics import fresnel_from_water
from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.scene.light import AbstractLamp
from oceaninv.scene.objects import blocked
from oceaninv.scene.scene import Scene
from oceaninv.transport.monte_carlo._random_numbers import Vector
from oceaninv.transport.monte_carlo._random_walk import Domain, by_layer, each


class Arrival(NamedTuple):
    """Light that comes straight to points.

    `towards`: directions to its source; `spectrum`: irradiance normal to the beam, without
    attenuation, (..., wl); `lengths`: path length in each layer, m.
    """

    towards: Vector
    spectrum: Float[Array, "... wl"]
    lengths: tuple[Float[Array, "..."], ...]


def arrivals(scene: Scene, domain: Domain, position: Vector) -> list[Arrival]:
    """All direct light on points, shadows of objects included."""
    found = [_sun(scene, domain, position)]
    for lamp in scene.lamps:
        found.append(_lamp(lamp, domain, position))
        if domain.refraction is not None:
            found.append(_image(lamp, domain, position))
    return found


def _seen(domain: Domain, position: Vector, towards: Vector, limit: Array) -> Array:
    """Whether nothing stands between points and a source, `limit` metres away: 1 or 0."""
    if not domain.things:
        return jnp.ones_like(limit)

    def clear(origin, direction, limit):
        return jnp.where(blocked(domain.things, origin, direction, limit), 0.0, 1.0)

    return each(clear, position, towards, limit).astype(limit.dtype)


def _sun(scene: Scene, domain: Domain, position: Vector) -> Arrival:
    cosine, irradiance = scene.beam()
    cosine = jax.lax.stop_gradient(cosine)
    depth = position[2]
    parts = (safe_sqrt(1.0 - cosine**2), jnp.zeros_like(cosine), -cosine)
    towards = tuple(jnp.broadcast_to(part, depth.shape) for part in parts)
    length = depth / cosine
    spectrum = irradiance.reshape((1,) * depth.ndim + (-1,))
    if domain.things:
        spectrum = spectrum * _seen(domain, position, towards, length)[..., None]
    return Arrival(towards, spectrum, by_layer(domain, jnp.zeros_like(depth), depth, length))


def _shine(lamp: AbstractLamp, travel: Vector, distance: Array) -> Float[Array, "... wl"]:
    """Irradiance normal to light that travels along `travel`, without attenuation."""
    intensity = each(lambda v: lamp.along(v), travel)
    squared = jnp.maximum(distance**2, jnp.finfo(distance.dtype).tiny)
    return intensity / squared[..., None]


def _apart(start: Vector, end: Vector) -> tuple[Array, Vector]:
    apart = tuple(e - s for s, e in zip(start, end, strict=True))
    distance = jnp.maximum(safe_sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2), 1e-6)
    return distance, tuple(part / distance for part in apart)


def _lamp(lamp: AbstractLamp, domain: Domain, position: Vector) -> Arrival:
    place = tuple(jnp.broadcast_to(p, position[2].shape) for p in lamp.position)
    distance, towards = _apart(position, place)
    spectrum = _shine(lamp, tuple(-t for t in towards), distance)
    spectrum = spectrum * _seen(domain, position, towards, distance)[..., None]
    return Arrival(towards, spectrum, by_layer(domain, position[2], place[2], distance))


def _image(lamp: AbstractLamp, domain: Domain, position: Vector) -> Arrival:
    """The lamp as the surface mirrors it."""
    place = tuple(jnp.broadcast_to(p, position[2].shape) for p in lamp.position)
    depth = position[2]
    distance, towards = _apart(position, (place[0], place[1], -place[2]))
    whole = jnp.maximum(depth + place[2], 1e-6)
    below, above = distance * depth / whole, distance * place[2] / whole
    mirror = tuple(p + below * t for p, t in zip(position, towards, strict=True))
    onward = (towards[0], towards[1], -towards[2])
    reflected = fresnel_from_water(jnp.abs(towards[2]), domain.refraction)
    seen = _seen(domain, position, towards, below) * _seen(domain, mirror, onward, above)
    spectrum = _shine(lamp, tuple(-t for t in onward), distance) * (seen * reflected)[..., None]
    zero = jnp.zeros_like(depth)
    legs = by_layer(domain, zero, depth, below), by_layer(domain, zero, place[2], above)
    return Arrival(towards, spectrum, tuple(a + b for a, b in zip(*legs, strict=True)))
