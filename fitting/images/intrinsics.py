"""Where the pixels of a camera look: focal lengths, principal point and distortion."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float

from oceaninv.foundation.colmap_file import (
    PARAMETERS,
    ColmapCamera,
    read_cameras,
    read_image_cameras,
)

# Largest relative difference of two shapes that are taken as one: sizes are rounded.
SAME_SHAPE = 0.03
# Pixels that are worked on at once, so that temporaries stay small.
_AT_ONCE = 2**15
_NEWTON_STEPS = 30
# Largest error of a found direction, as a tangent; pixels of 20 megapixels are 2e-4 apart.
_CLOSE = 1e-9
_FISHEYE = {"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"}


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """A camera without its place: one of COLMAP's models, with its parameters.

    - `model`: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, FOV,
      OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE or THIN_PRISM_FISHEYE.
    - `width`, `height`: pixels of the picture that the parameters belong to.
    - `parameters`: f or fx and fy, the focal lengths in pixels; cx and cy, the principal point in
      pixels from the upper left corner, where the first pixel's centre is (0.5, 0.5); and the
      coefficients of the model.

    Of a camera behind a flat port these are the values in water, as a calibration in water or a
    reconstruction of pictures from there gives them.

    Source: the models are those of COLMAP (Schonberger and Frahm 2016); those without "PRISM" or
    "FOV" follow OpenCV.
    """

    model: str
    width: int
    height: int
    parameters: dict[str, float]

    @classmethod
    def of_field_of_view(cls, degrees: float, shape: tuple[int, int]) -> "Intrinsics":
        """A camera without distortion whose pixels are square, of a full horizontal field of view.

        `degrees`: above 0 and below 180, for a picture of `shape` (row, column) pixels.

        **Raises:** ValueError outside that range.

        >>> Intrinsics.of_field_of_view(90.0, (60, 80)).parameters["fx"].__round__(9)
        40.0
        """
        if not 0.0 < degrees < 180.0:
            raise ValueError(
                f"the field of view is {degrees:g} degrees; more than 0 and less than 180 wanted."
            )
        rows, columns = shape
        focal = 0.5 * columns / math.tan(math.radians(0.5 * degrees))
        at = {"fx": focal, "fy": focal, "cx": 0.5 * columns, "cy": 0.5 * rows}
        return cls("PINHOLE", columns, rows, at)

    @property
    def distorted(self) -> bool:
        """Whether the camera bends lines that are straight."""
        names = PARAMETERS[self.model].split()
        bends = [self.parameters[name] for name in names if name[0] not in "fc"]
        return self.model in _FISHEYE or any(bends)

    def fits(self, shape: tuple[int, int]) -> bool:
        """Whether a picture of `shape` (row, column) has the camera's ratio of sides, to 3 %."""
        return abs(shape[0] * self.width / (shape[1] * self.height) - 1.0) <= SAME_SHAPE

    def tangents(
        self, column: ArrayLike, row: ArrayLike, shape: tuple[int, int]
    ) -> tuple[Float[np.ndarray, "*point"], Float[np.ndarray, "*point"]]:
        """Tangents x/z (to the right) and y/z (down) of the lines of sight of pixels.

        `column`, `row`: of a picture of `shape` (row, column), where the first pixel's centre is
        (0, 0); they broadcast.  The distortion is inverted by Newton's method; NaN where no
        direction is seen at a pixel, or only one at 90 degrees or more from the axis.
        """
        p = self.parameters
        focal = p.get("fx", p.get("f", 0.0)), p.get("fy", p.get("f", 0.0))
        column, row = np.asarray(column, dtype=float), np.asarray(row, dtype=float)
        x = np.asarray(((column + 0.5) * (self.width / shape[1]) - p["cx"]) / focal[0])
        y = np.asarray(((row + 0.5) * (self.height / shape[0]) - p["cy"]) / focal[1])
        x, y = np.broadcast_arrays(x, y)
        if not self.distorted:
            return x, y
        with np.errstate(all="ignore"):
            if self.model == "FOV":
                return _of_fov(x, y, p["omega"])
            x, y = self._undistorted(x, y)
            if self.model not in _FISHEYE:
                return x, y
            # (x, y) are angles from the axis in the direction of the point.
            angle = np.hypot(x, y)
            stretch = np.where(angle < 1e-8, 1.0, np.tan(angle) / np.where(angle > 0, angle, 1.0))
            stretch = np.where(angle < 0.5 * np.pi, stretch, np.nan)
            return np.asarray(stretch * x), np.asarray(stretch * y)

    def range_over_depth(self, shape: tuple[int, int]) -> Float[np.ndarray, "row column"]:
        """Distance along the line of sight over depth along the axis, of every pixel of `shape`."""
        ratio = np.empty(shape)
        column = np.arange(shape[1], dtype=float)
        step = max(1, _AT_ONCE // shape[1])
        for first in range(0, shape[0], step):
            row = np.arange(first, min(first + step, shape[0]), dtype=float)
            x, y = self.tangents(column[None, :], row[:, None], shape)
            ratio[first : first + len(row)] = np.sqrt(1.0 + x**2 + y**2)
        return ratio

    def _distorted(self, x, y) -> tuple[Any, ...]:
        """Where a direction (tangents; angles of a fisheye) appears, in focal lengths: X and Y,
        and their derivatives dX/dx, dX/dy, dY/dx, dY/dy."""
        p = self.parameters
        r = x * x + y * y
        k = [p.get(f"k{number}", 0.0) for number in range(1, 7)]
        if self.model == "FULL_OPENCV":
            below = 1.0 + r * (k[3] + r * (k[4] + r * k[5]))
            factor = (1.0 + r * (k[0] + r * (k[1] + r * k[2]))) / below
            slope = k[0] + r * (2.0 * k[1] + 3.0 * r * k[2])
            slope = (slope - factor * (k[3] + r * (2.0 * k[4] + 3.0 * r * k[5]))) / below
        else:
            factor = 1.0 + r * (k[0] + r * (k[1] + r * (k[2] + r * k[3])))
            slope = k[0] + r * (2.0 * k[1] + r * (3.0 * k[2] + 4.0 * r * k[3]))
        p1, p2, s1, s2 = (p.get(name, 0.0) for name in ("p1", "p2", "sx1", "sy1"))
        mixed = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        return (
            x * factor + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x) + s1 * r,
            y * factor + 2.0 * p2 * x * y + p1 * (r + 2.0 * y * y) + s2 * r,
            factor + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * s1 * x,
            mixed + 2.0 * s1 * y,
            mixed + 2.0 * s2 * x,
            factor + 2.0 * y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y + 2.0 * s2 * y,
        )

    def _undistorted(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The direction that appears at (x, y), by Newton's method from there.

        NaN where it does not converge, or finds the far side of a fold, where points appear nearer
        to the axis the further from it they are.
        """
        u, v = x, y
        for _ in range(_NEWTON_STEPS):
            there_x, there_y, xu, xv, yu, yv = self._distorted(u, v)
            off_x, off_y, size = there_x - x, there_y - y, xu * yv - xv * yu
            u = u - (yv * off_x - xv * off_y) / size
            v = v - (xu * off_y - yu * off_x) / size
            if max(np.max(np.abs(off_x)), np.max(np.abs(off_y))) < _CLOSE:
                break
        there_x, there_y, xu, xv, yu, yv = self._distorted(u, v)
        close = np.hypot(there_x - x, there_y - y) < _CLOSE
        found = close & (xu * yv - xv * yu > 0) & (xu + yv > 0)
        return np.where(found, u, np.nan), np.where(found, v, np.nan)


def _of_fov(x: np.ndarray, y: np.ndarray, omega: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the model FOV (Devernay and Faugeras 2001, eq. 13)."""
    r = np.hypot(x, y)
    angle = r * omega
    stretch = np.tan(angle) / (2.0 * math.tan(0.5 * omega) * np.where(r > 0, r, 1.0))
    stretch = np.where(r > 0, stretch, omega / (2.0 * math.tan(0.5 * omega)))
    stretch = np.where(np.abs(angle) < 0.5 * np.pi, stretch, np.nan)
    return np.asarray(stretch * x), np.asarray(stretch * y)


def read_intrinsics(path: str | Path, image: str | None = None) -> Intrinsics:
    """The camera of a COLMAP model that took an image.

    **Arguments:**

    - `path`: cameras.bin, cameras.txt, or the folder of the model that holds one of them.
    - `image`: name of the image, with or without its ending and folders; needed, and looked up in
      the images.bin or images.txt beside, where the model has several cameras.

    **Raises:** ValueError with a sentence where the file is missing, damaged or of an unknown
    model, or does not tell which camera it was.
    """
    path = model_file(path)
    cameras = read_cameras(path)
    number = next(iter(cameras))
    if len(cameras) > 1:
        number = _camera_of(path, image, len(cameras))
        if number not in cameras:
            raise ValueError(f"{path} holds no camera {number}, which took {image}.")
    camera: ColmapCamera = cameras[number]
    return Intrinsics(camera.model, camera.width, camera.height, camera.parameters)


def model_file(path: str | Path) -> Path:
    """The cameras.bin or cameras.txt in a folder; a file as it is.

    **Raises:** ValueError where there is none.
    """
    path = Path(path)
    if path.is_dir():
        named = [path / "cameras.bin", path / "cameras.txt"]
        path = next((one for one in named if one.is_file()), named[0])
    if not path.is_file():
        raise ValueError(
            f"{path} does not exist: the cameras.bin or cameras.txt of a model wanted."
        )
    return path


def _camera_of(path: Path, image: str | None, count: int) -> int:
    beside = [path.parent / "images.bin", path.parent / "images.txt"]
    listed = next((one for one in beside if one.is_file()), None)
    if listed is None or image is None:
        raise ValueError(
            f"{path} holds {count} cameras: put the images.bin of its model beside it, which tells "
            "which of them took the photograph."
        )
    taken = {n: camera for n, camera in read_image_cameras(listed).items() if same_name(n, image)}
    if len(set(taken.values())) != 1:
        what = "no image" if not taken else "images of several cameras"
        raise ValueError(f"{listed} holds {what} of the name {image}.")
    return next(iter(taken.values()))


def same_name(first: str, second: str) -> bool:
    """Whether two names of images differ in nothing but folders, endings and large letters."""
    return _stem(first) == _stem(second)


def _stem(name: str) -> str:
    return Path(name.replace("\\", "/")).stem.casefold()
