"""Range maps: the objects before a camera, given by the distance of every pixel."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from oceaninv.scene.camera import Camera
from oceaninv.water.iops import check_concrete

_JUMP = 0.1  # relative change of range from pixel to pixel that is an edge, not a slope


class Ranged(eqx.Module):
    """The point that every line of sight of a camera meets, row by row from the top left.

    `distance`: m; `normal`: unit vector towards the side of the camera; `met`: whether there is an
    object; `texture`: shares of the map's reflectances.
    """

    distance: Float[Array, " ray"]
    normal: Float[Array, "ray 3"]
    met: Bool[Array, " ray"]
    texture: Float[Array, "ray part"]


class RangeMap(eqx.Module):
    """Distances of objects along the lines of sight of a camera, and their reflectances.

    **Arguments:** concrete.

    - `distance`: (row, column) metres; 0 or nan where nothing is known: open water, or the scene's
      own floor.
    - `reflectance`: (part, wl) between 0 and 1.
    - `texture`: (row, column, part): the reflectance of a pixel is the sum of the parts times
      their shares here, each between 0 and 1; `None`: 1 of the only part.  The parts must not
      exceed 1 together.
    - `kind`: what `distance` is: "line", along the line of sight of a pixel; "z", along the optical
      axis of the camera, which is less by the cosine of the angle between them.

    **Raises:** `ValueError` when they do not fit together.
    """

    distance: np.ndarray
    reflectance: Float[Array, "part wl"]
    texture: np.ndarray | None
    kind: str = eqx.field(static=True)

    def __init__(self, distance, reflectance, texture=None, kind="line"):
        if kind not in ("line", "z"):
            raise ValueError(f'kind must be "line" or "z", not {kind!r}.')
        distance = np.asarray(distance, dtype=float)
        if distance.ndim != 2 or min(distance.shape) < 2:
            raise ValueError(
                f"distance must be (row, column), 2 x 2 at least, not {distance.shape}."
            )
        distance = np.nan_to_num(distance, nan=0.0, posinf=0.0)
        if distance.min() < 0:
            raise ValueError(f"distance must not be negative; the least is {distance.min():g} m.")
        check_concrete("reflectance", reflectance, 0.0, 1.0)
        self.reflectance = jnp.asarray(reflectance)
        parts = self.reflectance.shape[0] if self.reflectance.ndim == 2 else 0
        if parts < 1:
            raise ValueError(
                f"reflectance must have shape (part, wl), not {self.reflectance.shape}."
            )
        check_concrete(
            "the sum of the reflectances", jnp.sum(self.reflectance, axis=0), 0.0, 1.0 + 1e-6
        )
        if texture is None and parts > 1:
            raise ValueError(f"{parts} reflectances need a texture that says where they are.")
        if texture is not None:
            texture = np.asarray(texture, dtype=float)
            if texture.shape != (*distance.shape, parts):
                raise ValueError(
                    f"texture must have shape {(*distance.shape, parts)}, not {texture.shape}."
                )
            check_concrete("texture", texture, 0.0, 1.0)
        self.distance, self.texture, self.kind = distance, texture, kind

    def seen_by(self, camera: Camera) -> Ranged:
        """The points that the lines of sight of a camera meet, from the nearest pixel of the map,
        which covers the whole picture.  Normals are computed from neighbouring pixels; at an edge
        (a change of range of more than a tenth) surfaces face the camera."""
        rows, columns = (
            ((np.arange(n) + 0.5) / n * m).astype(int)
            for n, m in zip((camera.height, camera.width), self.distance.shape, strict=True)
        )
        picked = np.ix_(rows, columns)
        distance = self.distance[picked]
        rays = camera.rays()
        look = np.asarray(rays.direction).reshape(*distance.shape, 3)
        if self.kind == "z":
            axis = np.asarray(camera.direction, dtype=float)
            distance = distance / (look @ (axis / np.linalg.norm(axis)))
        point = np.asarray(rays.origin).reshape(*distance.shape, 3) + distance[..., None] * look
        smooth = distance > 0
        steps = []
        for axis in (0, 1):
            size = distance.shape[axis]
            last = np.clip(np.arange(size) + 1, 0, size - 1)
            first = np.clip(np.arange(size) - 1, 0, size - 1)
            near, far = np.take(distance, first, axis), np.take(distance, last, axis)
            for other in (near, far):
                smooth = smooth & (np.abs(other - distance) < _JUMP * distance)
            steps.append(np.take(point, last, axis) - np.take(point, first, axis))
        normal = np.cross(*steps)
        length = np.linalg.norm(normal, axis=2, keepdims=True)
        smooth = smooth[..., None] & (length > 0)
        normal = np.where(smooth, normal / np.where(length > 0, length, 1.0), -look)
        away = np.sum(normal * look, axis=2, keepdims=True) > 0
        normal = np.where(away, -normal, normal)
        texture = np.ones((*distance.shape, 1)) if self.texture is None else self.texture[picked]
        dtype = self.reflectance.dtype
        return Ranged(
            jnp.asarray(distance.ravel(), dtype),
            jnp.asarray(normal.reshape(-1, 3), dtype),
            jnp.asarray(distance.ravel() > 0),
            jnp.asarray(texture.reshape(distance.size, -1), dtype),
        )


def colour_parts(wavelength: np.ndarray) -> Float[np.ndarray, "part wl"]:
    """Three smooth reflectances that add up to 1 everywhere, for red, green and blue of a texture:
    they change over at 590 and 490 nm, within some 40 nm."""
    red = 1 / (1 + np.exp(-(wavelength - 590.0) / 10.0))
    blue = 1 / (1 + np.exp((wavelength - 490.0) / 10.0))
    return np.stack([red, 1 - red - blue, blue]).clip(0.0, 1.0)
