"""Radiance along a ray whose source is a sum of exponentials of depth, in closed form.

The diffuse light field of the closed-form transports is written, at depth z, as

    scalar irradiance  E(z) = e.decay e^(-K z) + e.beam e^(-k0 z) + e.mixed g(z) + e.grow s(z)
    net downward flux  F(z) = f.decay e^(-K z) + f.beam e^(-k0 z) + f.mixed g(z) + f.grow s'(z)
    g(z) = (e^(-k0 z) - e^(-K z)) / (k0 - K),  s(z) = (e^(-K (T - z)) - e^(-K (T + z))) / (2 K),

the pair (E, F) being the first two angular moments of the diffuse radiance.  The multiply
scattered source is then (b* E + 3 mu b* g F)/(4 pi), and its integral along a straight ray is
elementary.  Written with g and s, nothing is singular where the diffuse and the beam attenuation
agree (K = k0), where the diffuse light does not decay (K = 0: s = z), nor where a ray runs along
the sunbeam.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv._numerics import exp_mean, exp_mean3
from oceaninv.iops import IOPs
from oceaninv.optics import Rays, fresnel_from_water, scattering_half_sine
from oceaninv.scene import Scene
from oceaninv.transport.base import homogeneous

# A ray without end: far longer than any water is clear, yet its square fits in float32.
ENDLESS = 1e9
# Directions closer to the horizon than this are treated as if this far from it.
_HORIZON = 1e-3
# Angular scale (twice the sine of half the angle) below which scattering does not soften the beam.
_AUREOLE = 0.138


class Scaled(eqx.Module):
    """Delta-scaled water: the share chi_2 of scattering counts as unscattered light (1/m)."""

    c: Float[Array, " wl"]
    c_star: Float[Array, " wl"]
    b_star: Float[Array, " wl"]
    bg_star: Float[Array, " wl"]
    forward: Float[Array, " wl"]

    def __init__(self, water: IOPs):
        moments = water.scattering_moments(2)
        b, first, second = moments[0], moments[1], moments[2]
        self.c = water.a + b
        self.b_star = b - second
        self.bg_star = first - second
        self.c_star = water.a + self.b_star
        # Capped, lest a phase function that is all peak leave nothing to attenuate.
        self.forward = jnp.where(second > 0.995 * b, 0.995 * b, second)


class Terms(eqx.Module):
    """Coefficients of one moment of the diffuse field; a term that is None does not exist."""

    decay: Float[Array, " wl"]
    beam: Float[Array, " wl"] | None = None
    mixed: Float[Array, " wl"] | None = None
    grow: Float[Array, " wl"] | None = None

    def __call__(self, decay, beam, mixed, grow) -> Float[Array, "rows wl"]:
        """The sum of the terms that exist, given the values (rows, wl) of each basis function."""
        total = self.decay[None, :] * decay()
        for coefficient, basis in ((self.beam, beam), (self.mixed, mixed), (self.grow, grow)):
            if coefficient is not None:
                total = total + coefficient[None, :] * basis()
        return total


class Field(eqx.Module):
    """A diffuse light field with the beam that feeds it.

    `K`: diffuse attenuation, `k0`: beam attenuation with depth (both 1/m); `e`, `f`: moments;
    `bottom`: depth of the floor or None.
    """

    water: Scaled
    K: Float[Array, " wl"]
    k0: Float[Array, " wl"]
    mu0: Float[Array, ""]
    beam: Float[Array, " wl"]
    e: Terms
    f: Terms
    bottom: Float[Array, ""] | None

    def moments(self, z: Float[Array, " depth"]):
        """E and F of the diffuse light at depths z, each (depth, wl)."""
        z = z[:, None]
        k, k0 = self.K[None, :], self.k0[None, :]
        shared = (
            lambda: jnp.exp(-k * z),
            lambda: jnp.exp(-k0 * z),
            lambda: -z * exp_mean(k * z, k0 * z),
        )

        def grow():
            assert self.bottom is not None
            return z * exp_mean(k * (self.bottom - z), k * (self.bottom + z))

        def slope():
            assert self.bottom is not None
            return 0.5 * (jnp.exp(-k * (self.bottom - z)) + jnp.exp(-k * (self.bottom + z)))

        return self.e(*shared, grow), self.f(*shared, slope)

    def direct(self, z: Float[Array, " depth"]) -> Float[Array, "depth wl"]:
        """Irradiance normal to the (softened) sunbeam at depths z."""
        return self.beam[None, :] * jnp.exp(-self.k0[None, :] * z[:, None])


def _source_integral(field: Field, scene: Scene, z, rays_down, half_sine):
    """In-scattered radiance along rays that run to the floor (or for ever) or to the surface.

    The first half of the rays looks down, the second half up: one program serves both.  `z`
    (ray, 1): starting depths; `rays_down` (ray, 1): change of depth per metre of ray; `half_sine`
    (ray,): sine of half the scattering angle.  Returns radiance and the softened transmittance of
    the whole ray, both (ray, wl).
    """
    k, k0, mu0 = field.K[None, :], field.k0[None, :], field.mu0
    water = field.water
    c_star = water.c_star[None, :]
    lower, upper = (slice(None, z.shape[0] // 2), slice(z.shape[0] // 2, None))
    if field.bottom is None:
        fall = jnp.full_like(z[lower], ENDLESS)
        ground = z[lower] + ENDLESS * rays_down[lower]
    else:
        fall = (field.bottom - z[lower]) / rays_down[lower]
        ground = jnp.broadcast_to(field.bottom, fall.shape)
    length = jnp.concatenate([fall, -z[upper] / rays_down[upper]])
    end = jnp.concatenate([ground, jnp.zeros_like(z[upper])])
    transmitted = jnp.exp(-c_star * length)

    def along(rate):
        return length * exp_mean(rate * z, rate * end + c_star * length)

    def mixed():
        start = -z[lower] * exp_mean(k * z[lower], k0 * z[lower])
        if field.bottom is not None:
            start = start + transmitted[lower] * ground * exp_mean(k * ground, k0 * ground)
        rate = c_star + k0 * rays_down[lower]
        below = (start - rays_down[lower] * decaying[lower]) / jnp.where(rate > 0, rate, 1.0)
        up, rise = z[upper], length[upper]
        above = -rise * up * exp_mean3(k * up, k0 * up, c_star * rise)
        return jnp.concatenate([below, above])

    def floor_rates(sign):
        near = k * (field.bottom + sign * z)
        return near, k * (field.bottom + sign * end) + c_star * length

    def grow():
        # The difference of two means over 2 K, taken one corner at a time.
        (a1, b1), (a2, b2) = floor_rates(-1.0), floor_rates(1.0)
        return length * (z * exp_mean3(a1, a2, b1) + end * exp_mean3(a2, b1, b2))

    def slope():
        return 0.5 * length * (exp_mean(*floor_rates(-1.0)) + exp_mean(*floor_rates(1.0)))

    decaying = along(k)
    shared = (
        lambda: decaying,
        functools.cache(lambda: along(k0)),
        functools.cache(mixed),
    )
    isotropic = water.b_star[None, :] * field.e(*shared, grow)
    forward = -3.0 * rays_down * water.bg_star[None, :] * field.f(*shared, slope)
    multiple = (isotropic + forward) / (4.0 * jnp.pi)

    # Single scattering keeps the true phase function; light turned through a small angle is not
    # softened by scattering through larger ones.
    softening = -jnp.expm1(-2.0 * half_sine / _AUREOLE)
    c_single = water.c[None, :] - water.forward[None, :] * softening[:, None]
    single = (
        homogeneous(scene).volume_scattering(1.0 - 2.0 * half_sine**2)
        * field.beam[None, :]
        * length
        * exp_mean(z * c_single / mu0, (end / mu0 + length) * c_single)
    )
    return multiple + single, transmitted


def _endless(field: Field, scene: Scene, floor_radiance, z, direction):
    """Radiance of rays that end at the floor, at the surface or never, (ray, wl).  z: (ray,)."""
    steep = jnp.maximum(jnp.abs(direction[:, 2]), _HORIZON)[:, None]
    down = direction[:, 2:] >= 0
    depth = z[:, None]
    # Rays that look up see the water from below, mirrored in the surface: from depth 0 they share
    # an evaluation with the rays that look down.
    mirrored = jnp.concatenate([direction[:, :2], steep], axis=1)
    radiance, transmitted = _source_integral(
        field,
        scene,
        jnp.concatenate([jnp.where(down, depth, 0.0), depth]),
        jnp.concatenate([steep, -steep]),
        scattering_half_sine(jnp.concatenate([mirrored, direction]), field.mu0),
    )
    below, above = jnp.split(radiance, 2)
    to_floor, to_surface = jnp.split(transmitted, 2)
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
    field: Field, scene: Scene, rays: Rays, floor_radiance: Float[Array, " wl"] | None
) -> Float[Array, "ray wl"]:
    """Radiance along rays; a finite ray gathers the light scattered into it on the way.

    A finite ray follows from the exact identity A(P) = L(z) - e^(-c P) L(z + d P), whose c is
    NOT softened: light scattered forward into the ray is light that arrives.
    """
    z, direction = rays.origin[:, 2], rays.direction
    if rays.length is None:
        return _endless(field, scene, floor_radiance, z, direction)
    end = z + rays.length * direction[:, 2]
    ended = end >= 0
    if field.bottom is not None:
        ended = ended & (end <= field.bottom)
    # Both ends of every ray in one evaluation: half the program to compile.
    ends = jnp.concatenate([z, jnp.where(ended, end, z)])
    both = jnp.concatenate([direction, direction])
    whole, beyond = jnp.split(_endless(field, scene, floor_radiance, ends, both), 2)
    length = jnp.where(ended, rays.length, 0.0)
    transmitted = jnp.exp(-field.water.c[None, :] * length[:, None])
    return jnp.where(ended[:, None], whole - transmitted * beyond, whole)
