"""Apparent optical properties of a light field: diffuse attenuation and reflectances.

Each function states which Kd it returns: the values just below the surface, in the mean over a
depth range and deep down differ by up to a third.
"""

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation.interface_optics import (
    Rays,
    fresnel_from_air,
    fresnel_from_water,
    refracted_cosine,
)
from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.scene.scene import Scene
from oceaninv.transport.plane_parallel import _layer_modes
from oceaninv.transport.plane_parallel.plane_parallel import PlaneParallel
from oceaninv.water.iops import IOPs

_STEPS = 7  # of Newton's method
_HALVINGS = 50


class Apparent(eqx.Module):
    """Apparent optical properties at depths, each (depth, wl).

    `Kd`, `Ku`, `K0`: -d ln/dz of Ed, Eu and E0 right there, 1/m.  `R`: Eu/Ed.  `mean_cosine`,
    `mean_cosine_down`, `mean_cosine_up`: of all light, of what travels down and of what travels up.
    """

    Kd: Float[Array, "depth wl"]
    Ku: Float[Array, "depth wl"]
    K0: Float[Array, "depth wl"]
    R: Float[Array, "depth wl"]
    mean_cosine: Float[Array, "depth wl"]
    mean_cosine_down: Float[Array, "depth wl"]
    mean_cosine_up: Float[Array, "depth wl"]


def apparent(scene: Scene, depths, transport: PlaneParallel | None = None) -> Apparent:
    """Attenuation, reflectance and mean cosines at depths (m), from the exact derivative of the
    fluxes with depth."""
    depths = _depths(scene, depths)
    fluxes, slopes = _default(transport).fluxes_and_slopes(scene, depths)
    return Apparent(
        -slopes.Ed / fluxes.Ed,
        -slopes.Eu / fluxes.Eu,
        -(slopes.E0d + slopes.E0u) / fluxes.E0,
        fluxes.Eu / fluxes.Ed,
        fluxes.mean_cosine,
        fluxes.Ed / fluxes.E0d,
        fluxes.Eu / fluxes.E0u,
    )


def kd_between(
    scene: Scene, upper, lower, transport: PlaneParallel | None = None
) -> Float[Array, " wl"]:
    """Mean Kd between two depths (m), ln(Ed(upper)/Ed(lower))/(lower - upper), 1/m."""
    upper, lower = jnp.asarray(upper, dtype=float), jnp.asarray(lower, dtype=float)
    depths = _depths(scene, jnp.stack([upper, lower]))
    light = _default(transport).fluxes(scene, depths).Ed
    return jnp.log(light[0] / light[1]) / (depths[1] - depths[0])


def kd_to_light(
    scene: Scene, share: float = 0.1, transport: PlaneParallel | None = None
) -> tuple[Float[Array, " wl"], Float[Array, " wl"]]:
    """Mean Kd (1/m) from the surface to the depth (m) where Ed has fallen to a share of its value
    just below the surface, and that depth, each per wavelength.

    In water over a floor that more light than this reaches, both are nan.
    """
    if not 0 < share < 1:
        raise ValueError(f"share must be between 0 and 1, not {share}.")
    return _to_light(scene, float(share), _default(transport))


@eqx.filter_jit
def _to_light(scene: Scene, share: float, transport: PlaneParallel):
    dtype = scene.light.direct.dtype
    deepest = jnp.asarray(np.inf, dtype=dtype)
    if scene.floor is not None:
        deepest = scene.floor.depth.astype(dtype)

    def logarithm(z):
        """ln of Ed at depth z (one per wavelength) over Ed at the surface, and its slope."""
        depths = jnp.concatenate([jnp.zeros_like(z[:1]), z])
        fluxes, slopes = transport.fluxes_and_slopes(scene, depths)
        light = jnp.diagonal(fluxes.Ed[1:])
        return jnp.log(light / fluxes.Ed[0]), jnp.diagonal(slopes.Ed[1:]) / light

    def newton(_, state):
        # ln Ed is nearly straight in z.
        z, _ = state
        value, slope = logarithm(z)
        miss = np.log(share) - value
        return jnp.clip(z + miss / slope, 0.0, deepest), miss

    waters = (scene.water,) if isinstance(scene.water, IOPs) else scene.water.iops
    start = -np.log(share) / jnp.max(jnp.stack([water.a + water.bb for water in waters]), axis=0)
    start = jnp.minimum(start, deepest)
    found, miss = jax.lax.fori_loop(0, _STEPS, newton, (start, start))
    found = jnp.where(jnp.abs(miss) < 1e-4, found, jnp.nan)
    return -np.log(share) / found, found


_TAIL = 1024  # degrees of the light without scattering that are followed beyond the moments


@eqx.filter_jit
def kd_asymptotic(water: IOPs, moments: int = 64) -> Float[Array, " wl"]:
    """Attenuation (1/m) of all light deep in endless water, which no longer depends on the sun.

    The slowest mode of the transfer equation itself, without discrete directions: the smallest
    K^2 at which the recurrence of its Legendre moments ends (Case & Zweifel 1967, section 4.6),
    for a phase function of `moments` Legendre moments and a forward peak (delta-M).
    """

    def one(a, scattering):
        layer = _layer_modes.scale_layer(a, scattering, jnp.ones_like(a))
        scattered = jnp.concatenate([layer.gain, jnp.zeros(_TAIL, dtype=layer.gain.dtype)])
        degree = jnp.arange(scattered.shape[0], dtype=scattered.dtype)
        height = ((2 * degree + 1) * (1 - scattered)).at[0].set(layer.lost)

        def ends(x):
            """What the recurrence leaves at degree 0, x = (K/c)^2, and whether x is too large."""
            # q_l = x l^2/(h_l - q_{l+1}), from what it tends to at high degrees.
            last = (degree[-1] + 0.5) * (1 - safe_sqrt(1 - x))

            def step(carry, values):
                q, beyond = carry
                h, l = values
                rest = h - q
                beyond = beyond | (rest <= 0)
                return (x * l**2 / jnp.where(rest == 0, 1.0, rest), beyond), None

            rows = (height[1:], degree[1:])
            (q, beyond), _ = jax.lax.scan(step, (last, x > 1), rows, reverse=True)
            return height[0] - q, beyond | (height[0] < q)

        def halve(_, bounds):
            low, high = bounds
            middle = (low + high) / 2
            beyond = ends(middle)[1]
            return jnp.where(beyond, low, middle), jnp.where(beyond, middle, high)

        bounds = (jnp.zeros_like(a), jnp.ones_like(a))
        low, high = jax.lax.fori_loop(0, _HALVINGS, halve, bounds)
        # Newton's step carries the derivatives; where hardly anything scatters K is c.
        x = jax.lax.stop_gradient((low + high) / 2)
        free = 1 - x < 1e-9
        inside = jnp.where(free, 0.5, x)
        left, slope = jax.jvp(lambda x: ends(x)[0], (inside,), (jnp.ones_like(x),))
        root = jnp.where(free, 1.0, inside - left / jax.lax.stop_gradient(slope))
        return layer.extinction * safe_sqrt(root)

    return jax.vmap(one)(water.a, water.scattering_moments(moments).T)


def irradiance_reflectance(
    scene: Scene, transport: PlaneParallel | None = None
) -> Float[Array, " wl"]:
    """R = Eu/Ed just below the surface."""
    top = _default(transport).fluxes(scene, jnp.zeros(1, dtype=scene.light.direct.dtype))
    return top.Eu[0] / top.Ed[0]


def radiance_above(
    scene: Scene,
    directions: Float[Array, "ray 3"],
    transport: PlaneParallel | None = None,
    reflected: bool = True,
) -> Float[Array, "ray wl"]:
    """Radiance that an eye above a flat surface sees in the water, (ray, wl).

    `directions`: unit vectors, the way the eye looks in air, z > 0 (down).  What leaves the water
    is (1 - F)/n^2 of the radiance below; `reflected` adds the sky's mirror image, but never the
    sun's.

    Raises ValueError for a scene without a surface and for eyes that do not look down.
    """
    if scene.surface is None:
        raise ValueError("there is nothing above the water of a scene without a surface.")
    directions = jnp.asarray(directions)
    if not isinstance(directions, jax.core.Tracer) and np.any(np.asarray(directions)[:, 2] <= 0):
        raise ValueError("directions must look down, z > 0, to meet the water from above.")
    index = scene.surface.index.astype(directions.dtype)
    cos_air = directions[:, 2]
    cos_water = refracted_cosine(cos_air, index)
    inside = jnp.concatenate([directions[:, :2] / index, cos_water[:, None]], axis=1)
    rays = Rays(jnp.zeros(3, dtype=directions.dtype), inside)
    below = _default(transport).radiance(scene, rays).value
    through = (1 - fresnel_from_water(cos_water, index)) / index**2
    seen = through[:, None] * below
    if reflected and scene.light.diffuse is not None:
        sky = scene.light.sky_radiance(cos_air)
        seen = seen + fresnel_from_air(cos_air, index)[:, None] * sky
    return seen


def remote_sensing_reflectance(
    scene: Scene, transport: PlaneParallel | None = None, direction=(0.0, 0.0, 1.0)
) -> Float[Array, " wl"]:
    """Rrs: radiance that leaves the water per irradiance on the surface, 1/sr; for an eye that
    looks straight down, or along `direction` in air."""
    looks = jnp.asarray(direction, dtype=scene.light.direct.dtype)[None]
    leaving = radiance_above(scene, looks, transport, reflected=False)[0]
    down = scene.light.cosine * scene.light.direct
    if scene.light.diffuse is not None:
        down = down + np.pi * scene.light.diffuse
    return leaving / down


def _default(transport: PlaneParallel | None) -> PlaneParallel:
    return PlaneParallel() if transport is None else transport


def _depths(scene: Scene, depths) -> Float[Array, " depth"]:
    depths = jnp.atleast_1d(jnp.asarray(depths, dtype=scene.light.direct.dtype))
    scene.check_depths(depths)
    return depths
