"""Cameras: from a pose to lines of sight, from spectral radiance to channel values."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv.iops import check_concrete
from oceaninv.optics import Rays
from oceaninv.spectrum import Response


class Camera(eqx.Module):
    """A pinhole camera under water.

    **Arguments:**

    - `position`: (3,) metres; x and y horizontal, z the depth.
    - `direction`: (3,) the way it looks; need not be of unit length.
    - `up`: (3,) which way is up in the picture, for instance (0, 0, -1); not along `direction`.
    - `fov`: full horizontal field of view in the water, degrees, 0 < fov < 180.
    - `width`, `height`: pixels.
    - `response`: spectral response, one row per channel.
    """

    position: Float[Array, "3"]
    direction: Float[Array, "3"]
    up: Float[Array, "3"]
    fov: Float[Array, ""]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    response: Response

    def __init__(self, position, direction, up, fov, width, height, response):
        check_concrete("fov", fov, 1e-3, 179.0)
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
        direction = (
            forward[None, :]
            + across.reshape(-1, 1) * right[None, :]
            + along.reshape(-1, 1) * top[None, :]
        )
        direction = direction / jnp.linalg.norm(direction, axis=1, keepdims=True)
        return Rays(self.position, direction)
