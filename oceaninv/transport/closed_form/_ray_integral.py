"""Radiance along a ray whose source is a sum of exponentials of depth, in closed form.

The closed-form transports differ in the diffuse field that they solve.  This module is common to
all: the integral of the source along straight rays, single scattering with the true phase function,
the light of floor, surface and sky, and rays that end at an object.

The diffuse field is written in e^(-K z), e^(-k0 z) (k0: the beam's) and

    g(z) = (e^(-k0 z) - e^(-K z)) / (k0 - K),  s(z) = (e^(-K (T - z)) - e^(-K (T + z))) / (2 K).

With g and s, nothing is singular where the diffuse and the beam attenuation agree (K = k0), where
the diffuse light does not decay (K = 0: s = z), nor where a ray runs along the sunbeam.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv.foundation.interface_optics import Rays, fresnel_from_water, scattering_half_sine
from oceaninv.foundation.numerics import exp_mean, exp_mean3
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import homogeneous

# A ray without end: far longer than any water is clear, yet its square fits in float32.
ENDLESS = 1e9
# Directions closer to the horizon than this are treated as if this far from it.
_HORIZON = 1e-3


class ScaledAttenuation(eqx.Module):
    """Attenuation of a delta-scaled water (1/m).

    `c`: beam attenuation; `c_star`: the same when the forward peak counts as unscattered light;
    `forward`: the scattering subtracted from c for light scattered once, except at angles below
    `aureole` (twice the sine of half the angle).
    """

    c: Float[Array, " wl"]
    c_star: Float[Array, " wl"]
    forward: Float[Array, " wl"]
    aureole: float = eqx.field(static=True)


class Path(eqx.Module):
    """Straight rays from depth `z` to `end`, metres; `down`: change of depth per metre of ray.

    The first half of the rays looks down, the second half up: one program serves both.  Each
    method integrates one function of depth, attenuated by `c_star`, to (ray, wl).
    """

    z: Float[Array, "ray 1"]
    end: Float[Array, "ray 1"]
    length: Float[Array, "ray 1"]
    down: Float[Array, "ray 1"]
    c_star: Float[Array, "1 wl"]
    k0: Float[Array, "1 wl"]
    bottom: Float[Array, ""] | None

    def decay(self, k: Float[Array, "1 wl"]) -> Float[Array, "ray wl"]:
        """Of e^(-k z)."""
        depth = k * self.end + self.c_star * self.length
        return self.length * exp_mean(k * self.z, depth)

    def mixed(
        self, k: Float[Array, "1 wl"], decaying: Float[Array, "ray wl"]
    ) -> Float[Array, "ray wl"]:
        """Of g(z), given the integral of e^(-k z)."""
        half = self.z.shape[0] // 2
        z, down, ground, k0 = self.z[:half], self.down[:half], self.end[:half], self.k0
        start = -z * exp_mean(k * z, k0 * z)
        if self.bottom is not None:
            through = jnp.exp(-self.c_star * self.length[:half])
            start = start + through * ground * exp_mean(k * ground, k0 * ground)
        rate = self.c_star + k0 * down
        below = (start - down * decaying[:half]) / jnp.where(rate > 0, rate, 1.0)
        z, rise = self.z[half:], self.length[half:]
        above = -rise * z * exp_mean3(k * z, k0 * z, self.c_star * rise)
        return jnp.concatenate([below, above])

    def _from_floor(self, k, sign):
        assert self.bottom is not None
        near = k * (self.bottom + sign * self.z)
        return near, k * (self.bottom + sign * self.end) + self.c_star * self.length

    def grow(self, k: Float[Array, "1 wl"]) -> Float[Array, "ray wl"]:
        """Of s(z)."""
        # The difference of two means over 2 K, split into two parts without cancellation.
        (a1, b1), (a2, b2) = self._from_floor(k, -1.0), self._from_floor(k, 1.0)
        return self.length * (self.z * exp_mean3(a1, a2, b1) + self.end * exp_mean3(a2, b1, b2))

    def slope(self, k: Float[Array, "1 wl"]) -> Float[Array, "ray wl"]:
        """Of s'(z)."""
        below, above = self._from_floor(k, -1.0), self._from_floor(k, 1.0)
        return 0.5 * self.length * (exp_mean(*below) + exp_mean(*above))


class AbstractDiffuseField(eqx.Module):
    """A diffuse light field and the sunbeam that is its source.

    `mu0`: cosine of the sun in the water; `beam`: irradiance normal to it below the surface;
    `bottom`: depth of the floor or None.
    """

    attenuation: eqx.AbstractVar[ScaledAttenuation]
    mu0: eqx.AbstractVar[Float[Array, ""]]
    beam: eqx.AbstractVar[Float[Array, " wl"]]
    bottom: eqx.AbstractVar[Float[Array, ""] | None]

    @abc.abstractmethod
    def multiply_scattered(
        self, path: Path, direction: Float[Array, "ray 3"]
    ) -> Float[Array, "ray wl"]:
        """Radiance scattered into rays from the diffuse field."""

    @property
    def k0(self) -> Float[Array, " wl"]:
        """Attenuation of the delta-scaled sunbeam with depth, 1/m."""
        return self.attenuation.c_star / self.mu0

    def direct(self, z: Float[Array, " depth"]) -> Float[Array, "depth wl"]:
        """Irradiance normal to the delta-scaled sunbeam at depths z."""
        return self.beam[None, :] * jnp.exp(-self.k0[None, :] * z[:, None])


def _path(
    field: AbstractDiffuseField, z: Float[Array, "ray 1"], down: Float[Array, "ray 1"]
) -> Path:
    """Rays: the first half runs to the floor (or without end), the second to the surface."""
    lower, upper = (slice(None, z.shape[0] // 2), slice(z.shape[0] // 2, None))
    if field.bottom is None:
        fall = jnp.full_like(z[lower], ENDLESS)
        ground = z[lower] + ENDLESS * down[lower]
    else:
        fall = (field.bottom - z[lower]) / down[lower]
        ground = jnp.broadcast_to(field.bottom, fall.shape)
    length = jnp.concatenate([fall, -z[upper] / down[upper]])
    end = jnp.concatenate([ground, jnp.zeros_like(z[upper])])
    return Path(
        z, end, length, down, field.attenuation.c_star[None, :], field.k0[None, :], field.bottom
    )


def _singly_scattered(
    field: AbstractDiffuseField, scene: Scene, path: Path, direction
) -> Float[Array, "ray wl"]:
    """Sunlight scattered once, with the true phase function.  For light scattered through a small
    angle the attenuation is not reduced by the forward peak."""
    half_sine = scattering_half_sine(direction, field.mu0)
    attenuation = field.attenuation
    softening = -jnp.expm1(-2.0 * half_sine / attenuation.aureole)
    c = attenuation.c[None, :] - attenuation.forward[None, :] * softening[:, None]
    near, far = path.z * c / field.mu0, (path.end / field.mu0 + path.length) * c
    turned = homogeneous(scene).volume_scattering(1.0 - 2.0 * half_sine**2)
    return turned * field.beam[None, :] * path.length * exp_mean(near, far)


def _to_boundary(field: AbstractDiffuseField, scene: Scene, floor_radiance, z, direction):
    """Radiance of rays that end at the floor, at the surface or never, (ray, wl).  z: (ray,)."""
    steep = jnp.maximum(jnp.abs(direction[:, 2]), _HORIZON)[:, None]
    down = direction[:, 2:] >= 0
    depth = z[:, None]
    # Rays that look up see the water mirrored in the surface.  Their images start at depth 0 and
    # are evaluated together with the rays that look down.
    mirrored = jnp.concatenate([direction[:, :2], steep], axis=1)
    views = jnp.concatenate([mirrored, direction])
    start = jnp.concatenate([jnp.where(down, depth, 0.0), depth])
    path = _path(field, start, jnp.concatenate([steep, -steep]))
    radiance = field.multiply_scattered(path, views) + _singly_scattered(field, scene, path, views)
    below, above = jnp.split(radiance, 2)
    to_floor, to_surface = jnp.split(jnp.exp(-path.c_star * path.length), 2)
    if floor_radiance is not None:
        below = below + floor_radiance[None, :] * to_floor
    sky = scene.light.diffuse
    if scene.surface is None:
        if sky is not None:
            above = above + sky[None, :] * to_surface
    else:
        index = scene.surface.index.astype(z.dtype)
        reflectance = fresnel_from_water(steep, index)
        seen = reflectance * below
        if sky is not None:
            seen = seen + (1.0 - reflectance) * index**2 * sky[None, :]
        above = above + seen * to_surface
    return jnp.where(down, below, above)


def radiance(
    field: AbstractDiffuseField,
    scene: Scene,
    rays: Rays,
    floor_radiance: Float[Array, " wl"] | None,
) -> Float[Array, "ray wl"]:
    """Radiance along rays; a finite ray gathers the light scattered into it on the way.

    A finite ray follows from the exact identity A(P) = L(z) - e^(-c P) L(z + d P), whose c is
    NOT delta-scaled: light scattered forward into the ray is light that arrives.
    """
    z, direction = rays.origin[:, 2], rays.direction
    if rays.length is None:
        return _to_boundary(field, scene, floor_radiance, z, direction)
    end = z + rays.length * direction[:, 2]
    ended = end >= 0
    if field.bottom is not None:
        ended = ended & (end <= field.bottom)
    # Both ends of every ray in one evaluation, which halves the program to compile.
    ends = jnp.concatenate([z, jnp.where(ended, end, z)])
    both = jnp.concatenate([direction, direction])
    whole, beyond = jnp.split(_to_boundary(field, scene, floor_radiance, ends, both), 2)
    length = jnp.where(ended, rays.length, 0.0)
    transmitted = jnp.exp(-field.attenuation.c[None, :] * length[:, None])
    return jnp.where(ended[:, None], whole - transmitted * beyond, whole)
