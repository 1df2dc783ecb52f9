"""Geometrical optics of a flat water surface: Snell, Fresnel and the n^2 law; view rays."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from oceaninv.foundation.numerics import gauss_legendre, safe_sqrt


class Rays(eqx.Module):
    """Lines of sight under water.

    **Arguments:**

    - `origin`: (ray, 3) position of the eye in metres; x and y horizontal, z the depth
      (positive down, surface at 0).  A single (3,) vector serves every ray.
    - `direction`: (ray, 3) unit vectors, the way the eye LOOKS (z > 0 looks down).  The sun
      stands towards +x.
    - `length`: metres to the object that ends the ray, scalar or (ray,); `inf` (default) when
      nothing but the floor, the surface or endless water ends it.
    """

    origin: Float[Array, "ray 3"]
    direction: Float[Array, "ray 3"]
    length: Float[Array, " ray"] | None

    def __init__(self, origin, direction, length: ArrayLike = np.inf):
        direction = jnp.atleast_2d(jnp.asarray(direction))
        if direction.shape[-1:] != (3,):
            raise ValueError(f"direction must have shape (ray, 3), not {direction.shape}.")
        self.direction = direction
        origin = jnp.asarray(origin, dtype=direction.dtype)
        if origin.shape[-1:] != (3,):
            raise ValueError(f"origin must have shape (3,) or (ray, 3), not {origin.shape}.")
        self.origin = jnp.broadcast_to(jnp.atleast_2d(origin), direction.shape)
        endless = isinstance(length, float) and np.isinf(length)
        self.length = (
            None
            if endless
            else jnp.broadcast_to(jnp.asarray(length, direction.dtype), direction.shape[:1])
        )


def refracted_cosine(cos_outside: Float[Array, "..."], index) -> Float[Array, "..."]:
    """Cosine in the denser medium of light that arrives with `cos_outside`: Snell's law.

    `index` is the denser medium's over the thinner one's (>= 1)."""
    return jnp.sqrt((index - 1.0) * (index + 1.0) + cos_outside**2) / index


def fresnel_from_air(cos_air: Float[Array, "..."], index) -> Float[Array, "..."]:
    """Unpolarised Fresnel reflectance of a flat surface seen from the thinner medium."""
    # Differences of cosines written as products: nothing cancels as the index nears 1.
    step = (index - 1.0) * (index + 1.0)
    root = jnp.sqrt(step + cos_air**2)
    across = step / (cos_air + root) ** 2
    along = step * ((index**2 + 1.0) * cos_air**2 - 1.0) / (index**2 * cos_air + root) ** 2
    return 0.5 * (across**2 + along**2)


def fresnel_from_water(cos_water: Float[Array, "..."], index) -> Float[Array, "..."]:
    """Unpolarised Fresnel reflectance from the denser medium: 1 beyond the critical angle."""
    step = (index - 1.0) * (index + 1.0)
    squared = (index * cos_water) ** 2 - step
    inside = squared > 0
    cos_air = safe_sqrt(squared)
    cos_water = jnp.where(inside, cos_water, 1.0)  # no 0/0 at the horizon, where the answer is 1
    across = step / (index * cos_water + cos_air) ** 2
    along = step * (index**2 - (index**2 + 1.0) * cos_water**2) / (cos_water + index * cos_air) ** 2
    return jnp.where(inside, 0.5 * (across**2 + along**2), 1.0)


_NODES, _WEIGHTS = gauss_legendre(48, 0.0, 1.0)


def diffuse_reflectance(index: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Flux reflectance of a flat surface under uniform radiance, (from air, from water).

    The second follows from the first by reversal: 1 - r_water = (1 - r_air)/n^2
    (0.0675 and 0.4807 at n = 1.34).
    """
    # Squared nodes: the reflectance has a root-like edge at grazing incidence.
    mu = jnp.asarray(_NODES**2, dtype=index.dtype)
    weight = jnp.asarray(4 * _NODES**3 * _WEIGHTS, dtype=index.dtype)
    from_air = jnp.sum(weight * fresnel_from_air(mu, index))
    return from_air, ((index - 1.0) * (index + 1.0) + from_air) / index**2


def scattering_half_sine(
    direction: Float[Array, "ray 3"], cos_sun: Float[Array, ""]
) -> Float[Array, " ray"]:
    """Sine of half the angle by which sunlight must turn to reach an eye that looks along
    `direction`; the cosine of the whole angle is 1 - 2 sin^2.

    `cos_sun` is the cosine of the in-water sun zenith; the sun stands towards +x, so its light
    travels along (-sin, 0, cos).  Exact also for the smallest angles, which a cosine cannot hold.
    """
    sin_sun = safe_sqrt(1.0 - cos_sun**2)
    across = (direction[:, 0] - sin_sun) ** 2 + direction[:, 1] ** 2
    return jnp.minimum(0.5 * safe_sqrt(across + (direction[:, 2] + cos_sun) ** 2), 1.0)
