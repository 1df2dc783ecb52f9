"""The irradiance of small facets of objects in a horizontally uniform light field."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import AbstractTransport, homogeneous
from oceaninv.transport.closed_form._two_moment_field import DeltaScaledWater

_DEPTHS = 65  # at which the light is computed; between them its logarithm is linear


class LightBetweenDepths(NamedTuple):
    """The light between two depths; fields (depth, wl)."""

    top: Float[Array, ""]
    bottom: Float[Array, ""]
    down: Float[Array, "depth wl"]  # diffuse, plane
    up: Float[Array, "depth wl"]
    around: Float[Array, "depth wl"]  # diffuse, scalar
    sun: Float[Array, "depth wl"]  # normal to the delta-scaled beam


def light(
    base: AbstractTransport,
    scene: Scene,
    top: Float[Array, ""],
    bottom: Float[Array, ""],
    key: Key[Array, ""] | None,
) -> LightBetweenDepths:
    """The light between two depths of a scene without objects."""
    if scene.floor is not None:
        bottom = jnp.minimum(bottom, scene.floor.depth)
    share = jnp.linspace(0.0, 1.0, _DEPTHS, dtype=top.dtype)
    depths = top + share * (bottom - top)
    found = base.irradiance(scene, depths, key)
    mu0, beam = scene.beam()
    c_star = DeltaScaledWater(homogeneous(scene)).attenuation.c_star
    sun = beam[None, :] * jnp.exp(-c_star[None, :] * depths[:, None] / mu0)
    diffuse = jnp.maximum(found.Ed.value - mu0 * sun, 0.0)
    scalar = jnp.maximum(found.E0.value - sun, 0.0)
    return LightBetweenDepths(top, bottom, diffuse, found.Eu.value, scalar, sun)


def irradiance(
    scene: Scene,
    lit: LightBetweenDepths,
    at: Float[Array, "ray 3"],
    normal: Float[Array, "ray 3"],
    free: Bool[Array, " ray"],
) -> Float[Array, "ray wl"]:
    """Irradiance of facets; `free`: whether nothing blocks the sun."""
    height = jnp.maximum(lit.bottom - lit.top, 1e-6)
    place = jnp.clip((at[:, 2] - lit.top) / height, 0.0, 1.0) * (_DEPTHS - 1)
    down, up, around, sun = (_between(v, place) for v in lit[2:])
    # A level facet takes plane irradiance; an upright one a quarter of the scalar irradiance,
    # as of light that grows linearly with the cosine; between them a parabola.
    level = -normal[:, 2:]
    side = around / 4.0
    total = side + level * (down - up) / 2.0 + level**2 * ((down + up) / 2.0 - side)
    facing = normal @ to_sun(scene)
    return total + sun * jnp.where((facing > 0) & free, facing, 0.0)[:, None]


def to_sun(scene: Scene) -> Float[Array, "3"]:
    """Unit vector in the water towards the sun."""
    mu0 = scene.beam()[0]
    return jnp.stack([safe_sqrt(1.0 - mu0**2), jnp.zeros_like(mu0), -mu0])


def _between(values: Float[Array, "depth wl"], place: Float[Array, " ray"]):
    """Values at fractional rows, linear in their logarithm."""
    tiny = jnp.asarray(1e-30, values.dtype)
    logs = jnp.log(jnp.maximum(values, tiny))
    low = jnp.clip(jnp.floor(place).astype(int), 0, values.shape[0] - 2)
    part = (place - low.astype(place.dtype))[:, None]
    return jnp.exp((1.0 - part) * logs[low] + part * logs[low + 1])
