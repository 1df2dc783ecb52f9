"""Sun and sky above the surface."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv.iops import check_concrete


class Light(eqx.Module):
    """A sun and, optionally, a uniform sky.

    **Arguments:**

    - `zenith`: sun zenith angle in degrees, 0 <= zenith < 90: in air, or in the water when the
      scene has no surface.
    - `direct`: (wl,) irradiance of the sunbeam on a plane normal to the beam, above the surface,
      W m-2 nm-1 (any unit: results come out in the same).
    - `diffuse`: (wl,) radiance of a uniform sky, W m-2 sr-1 nm-1; `None` is a black sky.
    """

    zenith: Float[Array, ""]
    direct: Float[Array, " wl"]
    diffuse: Float[Array, " wl"] | None

    def __init__(self, zenith, direct, diffuse=None):
        check_concrete("zenith", zenith, 0.0, 89.9)
        check_concrete("direct", direct)
        self.direct = jnp.asarray(direct)
        self.zenith = jnp.asarray(zenith, dtype=self.direct.dtype)
        if diffuse is not None:
            check_concrete("diffuse", diffuse)
            diffuse = jnp.asarray(diffuse, dtype=self.direct.dtype)
            if diffuse.shape != self.direct.shape:
                raise ValueError(
                    f"diffuse must have the shape of direct, {self.direct.shape}, "
                    f"not {diffuse.shape}."
                )
        self.diffuse = diffuse

    @property
    def cosine(self) -> Float[Array, ""]:
        """Cosine of the sun zenith angle."""
        return jnp.cos(jnp.deg2rad(self.zenith))
