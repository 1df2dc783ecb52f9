"""Cameras: from a pose to lines of sight, from linear channel values to the values in a file."""

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from oceaninv.foundation.interface_optics import Rays
from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.foundation.spectrum import Response
from oceaninv.water.iops import check_concrete, check_scalar


class Camera(eqx.Module):
    """A pinhole camera under water.

    **Arguments:**

    - `position`: (3,) metres; x and y horizontal, z the depth.  Seen along +y with the surface up,
      +x is to the left.
    - `direction`: (3,) the way it looks; need not be of unit length.
    - `up`: (3,) which way is up in the picture, for instance (0, 0, -1); not along `direction`.
    - `fov`: full horizontal field of view in the water, degrees, 0 < fov < 180.
    - `width`, `height`: pixels.
    - `response`: spectral response, one row per channel.
    - `port_index`: refractive index of the water before a flat port; `fov` is then that of the
      lens in air, and lines of sight bend at the port (Snell).  Its thickness and its reflection
      are neglected.  `None`: no port, or a dome.
    """

    position: Float[Array, "3"]
    direction: Float[Array, "3"]
    up: Float[Array, "3"]
    fov: Float[Array, ""]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    response: Response
    port_index: Float[Array, ""] | None

    def __init__(self, position, direction, up, fov, width, height, response, port_index=None):
        check_scalar("fov", fov)
        check_concrete("fov", fov, 1e-3, 179.0)
        for name, vector in (("position", position), ("direction", direction), ("up", up)):
            if np.shape(vector) != (3,):
                raise ValueError(
                    f"{name} must be three numbers, not of shape {np.shape(vector)}: x, y and the "
                    "depth z, downwards."
                )
        if port_index is not None:
            check_concrete("port_index", port_index, 1.0, 2.0)
        if int(width) < 1 or int(height) < 1:
            raise ValueError(f"width and height must be at least 1, not {width} and {height}.")
        dtype = jnp.result_type(float, response.values.dtype)
        self.position = jnp.asarray(position, dtype=dtype)
        self.direction = jnp.asarray(direction, dtype=dtype)
        self.up = jnp.asarray(up, dtype=dtype)
        self.fov = jnp.asarray(fov, dtype=dtype)
        self.width = int(width)
        self.height = int(height)
        self.response = response
        self.port_index = None if port_index is None else jnp.asarray(port_index, dtype=dtype)
        if not any(isinstance(v, jax.core.Tracer) for v in (self.direction, self.up)):
            across = np.linalg.norm(np.cross(np.asarray(self.direction), np.asarray(self.up)))
            if not across > 1e-6 * np.linalg.norm(self.direction) * np.linalg.norm(self.up):
                raise ValueError(
                    f"direction {np.asarray(self.direction)} and up {np.asarray(self.up)} must not"
                    " be parallel or of length 0."
                )

    def rays(self) -> Rays:
        """Lines of sight through the pixel centres, row by row from the top left."""
        forward = self.direction / jnp.linalg.norm(self.direction)
        right = jnp.cross(forward, self.up)
        right = right / jnp.linalg.norm(right)
        top = jnp.cross(right, forward)
        half = jnp.tan(0.5 * jnp.deg2rad(self.fov))
        dtype = self.fov.dtype
        x = (jnp.arange(self.width, dtype=dtype) + 0.5) / self.width * 2.0 - 1.0
        y = (self.height - 2.0 * (jnp.arange(self.height, dtype=dtype) + 0.5)) / self.width
        across, along = jnp.meshgrid(half * x, half * y)
        if self.port_index is not None:
            # Seen under tan t in air, under tan t' in water, with sin t = n sin t'.
            squared = across**2 + along**2
            bend = 1.0 / jnp.sqrt(self.port_index**2 + (self.port_index**2 - 1.0) * squared)
            across, along = bend * across, bend * along
        direction = (
            forward[None, :]
            + across.reshape(-1, 1) * right[None, :]
            + along.reshape(-1, 1) * top[None, :]
        )
        direction = direction / jnp.linalg.norm(direction, axis=1, keepdims=True)
        return Rays(self.position, direction)


class Sensor(eqx.Module):
    """What turns linear channel values into numbers between 0 and 1.

    **Arguments:**

    - `exposure`: factor on the channel values; `None` brings the 99th percentile (the lower of
      the two ranks about it, so that the brightest pixel never counts) of the brightest channel to
      0.9.
    - `full_well`: electrons at value 1, which set the photon noise; `None`: none.
    - `read_noise`: standard deviation of every pixel, electrons; needs `full_well`.
    - `bits`: of the analogue-to-digital converter; `None`: not rounded.

    Differentiable until it rounds; values clip at 0 and 1.
    """

    exposure: Float[Array, ""] | None
    full_well: Float[Array, ""] | None
    read_noise: Float[Array, ""] | None
    bits: int | None = eqx.field(static=True)

    def __init__(self, exposure=None, full_well=None, read_noise=None, bits=None):
        for name, value in (("exposure", exposure), ("full_well", full_well)):
            if value is not None:
                check_concrete(name, value, float(np.finfo(np.float32).tiny))
        if read_noise is not None:
            check_concrete("read_noise", read_noise)
            if full_well is None:
                raise ValueError("read_noise is in electrons: state full_well, too.")
        if bits is not None and not 1 <= int(bits) <= 16:
            raise ValueError(f"bits must be between 1 and 16, not {bits}.")
        self.exposure, self.full_well, self.read_noise = (
            None if v is None else jnp.asarray(v, dtype=jnp.result_type(float, v))
            for v in (exposure, full_well, read_noise)
        )
        self.bits = None if bits is None else int(bits)

    def expose(
        self, values: Float[Array, "row column channel"], key: Key[Array, ""] | None = None
    ) -> Float[Array, "row column channel"]:
        """Values of a photograph as the sensor reports them; `key` is needed for the noise."""
        values = values * self._factor(values)
        if self.full_well is not None:
            if key is None:
                raise ValueError("this sensor is noisy: give expose a key.")
            well = self.full_well.astype(values.dtype)
            variance = jnp.maximum(values, 0.0) / well
            if self.read_noise is not None:
                variance = variance + (self.read_noise.astype(values.dtype) / well) ** 2
            # Black without read noise is black: the root's slope there is infinite.
            noise = jax.random.normal(key, values.shape, values.dtype)
            values = values + safe_sqrt(variance) * noise
        values = jnp.clip(values, 0.0, 1.0)
        if self.bits is None:
            return values
        steps = 2.0**self.bits - 1.0
        return jnp.round(values * steps) / steps

    def _factor(self, values) -> Float[Array, ""]:
        if self.exposure is not None:
            return self.exposure.astype(values.dtype)
        share = jnp.asarray(99.0, values.dtype)
        bright = jnp.max(jnp.percentile(values, share, axis=(0, 1), method="lower"))
        return 0.9 / jnp.where(bright > 0, bright, 1.0)
