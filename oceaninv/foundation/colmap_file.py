"""Files of COLMAP: dense depth maps, and the cameras and images of a model.

Source: the formats are those that COLMAP's documentation states under "Output Format" and "Dense
Reconstruction", with the numbers and parameters of its camera models.
"""

import dataclasses
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float

# Names of the parameters of each camera model, by COLMAP's number of the model.
PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
}
# Most bytes of a list of cameras that is read; 100,000 cameras take less.
_MOST_BYTES = 20_000_000
_LONGEST_NAME = 4096
_LONGEST_SIDE = 1_000_000  # pixels


@dataclasses.dataclass(frozen=True)
class ColmapCamera:
    """A camera of a model: `model` and `parameters` (by name, as `PARAMETERS` lists them), and the
    `width` and `height` in pixels of the pictures that they belong to."""

    model: str
    width: int
    height: int
    parameters: dict[str, float]


def read_depth(path: Path, most: int) -> Float[np.ndarray, "row column"]:
    """A dense depth map, float32: depths along the optical axis in the model's unit, 0 if missing.

    "width&height&1&", then floats in column-major order.  `most`: pixels.

    **Raises:** ValueError, naming the file, where the header is damaged, claims more pixels than
    `most`, or another number of bytes than the file holds; before any pixel is read.
    """
    with open(path, "rb") as file:
        parts = file.read(64).split(b"&", 3)
        if len(parts) < 4 or not all(part.isdigit() for part in parts[:3]):
            raise ValueError(f"{path} does not begin like a COLMAP map: width&height&channels&.")
        width, height, channels = (int(part) for part in parts[:3])
        start = sum(len(part) + 1 for part in parts[:3])
        size = path.stat().st_size - start
        if channels != 1 or width * height == 0 or size != 4 * width * height:
            raise ValueError(
                f"{path} should hold {width} x {height} x {channels} floats of one channel, but "
                f"has {size} bytes: cut short, or no depth map."
            )
        if width * height > most:
            raise ValueError(
                f"{path} has {width} x {height} pixels; at most {most / 1e6:g} megapixels are read."
            )
        file.seek(start)
        raw = file.read(size)
    if len(raw) != size:
        raise ValueError(f"{path} became shorter while it was read.")
    return np.frombuffer(raw, dtype="<f4").reshape((width, height), order="F").T


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """The cameras of a model by their numbers, from cameras.bin or cameras.txt.

    **Raises:** ValueError, naming the file, for a file that is damaged or cut short, a model that
    is not in `PARAMETERS`, and for a size or focal length that is not positive.
    """
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise ValueError(f"{path} has {size} bytes: this is no list of cameras.")
    read = _cameras_of_text if path.suffix.lower() == ".txt" else _cameras_of_bytes
    cameras: dict[int, ColmapCamera] = {}
    for number, model, width, height, values in read(path):
        camera = ColmapCamera(
            model, width, height, dict(zip(PARAMETERS[model].split(), values, strict=True))
        )
        focal = [camera.parameters[name] for name in ("f", "fx", "fy") if name in camera.parameters]
        sized = min(width, height) >= 1 and max(width, height) <= _LONGEST_SIDE
        if not sized or not all(map(math.isfinite, values)) or min(focal) <= 0:
            raise ValueError(
                f"{path}: camera {number} has {width} x {height} pixels and the parameters "
                f"{', '.join(f'{value:g}' for value in values)}: sizes and focal lengths must be "
                "positive, and all finite."
            )
        cameras[number] = camera
    if not cameras:
        raise ValueError(f"{path} holds no camera.")
    return cameras


_Entry = tuple[int, str, int, int, tuple[float, ...]]


def _cameras_of_bytes(path: Path) -> Iterator[_Entry]:
    raw, models = path.read_bytes(), list(PARAMETERS)
    try:
        (count,) = struct.unpack_from("<Q", raw)
        at = 8
        for _ in range(count):
            number, index, width, height = struct.unpack_from("<IiQQ", raw, at)
            if not 0 <= index < len(models):
                raise ValueError(
                    f"{path}: camera {number} is of model number {index}, which is not known; "
                    f"known are 0 to {len(models) - 1}."
                )
            form = f"<{len(PARAMETERS[models[index]].split())}d"
            values = struct.unpack_from(form, raw, at + 24)
            at += 24 + struct.calcsize(form)
            yield number, models[index], width, height, values
    except struct.error:
        raise ValueError(f"{path} is cut short, or no list of cameras.") from None
    if at != len(raw):
        raise ValueError(f"{path} holds {len(raw) - at} bytes more than its {count} cameras.")


def _cameras_of_text(path: Path) -> Iterator[_Entry]:
    for line_number, line in enumerate(_text(path).splitlines(), start=1):
        cells = line.split()
        if not cells or cells[0].startswith("#"):
            continue
        names = PARAMETERS.get(cells[1], "").split() if len(cells) > 1 else []
        try:
            number, width, height = int(cells[0]), int(cells[2]), int(cells[3])
            values = tuple(float(cell) for cell in cells[4:])
            if not names or len(values) != len(names):
                raise ValueError
        except (ValueError, IndexError):
            raise ValueError(
                f"{path}: line {line_number} is no camera: number, model, width, height and its "
                f"parameters wanted, the model one of {', '.join(PARAMETERS)}."
            ) from None
        yield number, cells[1], width, height, values


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path} is no text in UTF-8.") from None


def read_image_cameras(path: Path) -> dict[str, int]:
    """The number of the camera of each image of a model, by the image's name, from images.bin or
    images.txt.

    **Raises:** ValueError, naming the file, for a file that is damaged or cut short.
    """
    if path.suffix.lower() == ".txt":
        return _images_of_text(path)
    size, found = path.stat().st_size, {}
    with open(path, "rb") as file:
        count = _number(path, file, "<Q")
        for _ in range(count):
            file.seek(4 + 7 * 8, 1)
            camera = _number(path, file, "<I")
            place = file.tell()
            name, end, _ = file.read(_LONGEST_NAME).partition(b"\0")
            if not end:
                raise ValueError(f"{path} is cut short, or no list of images.")
            file.seek(place + len(name) + 1)
            points = _number(path, file, "<Q")
            if file.tell() + 24 * points > size:
                raise ValueError(f"{path} is cut short, or no list of images.")
            file.seek(24 * points, 1)
            found[name.decode("utf-8", "replace")] = camera
        if file.tell() != size:
            raise ValueError(f"{path} holds {size - file.tell()} bytes more than its images.")
    return found


def _number(path: Path, file: BinaryIO, form: str) -> int:
    raw = file.read(struct.calcsize(form))
    if len(raw) < struct.calcsize(form):
        raise ValueError(f"{path} is cut short, or no list of images.")
    return struct.unpack(form, raw)[0]


def _images_of_text(path: Path) -> dict[str, int]:
    """Two lines for each image; the second holds its points and may be empty."""
    found, of_points = {}, False
    try:
        with open(path, encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                if of_points:
                    of_points = False
                elif line.strip() and not line.startswith("#"):
                    cells = line.strip().split(maxsplit=9)
                    if len(cells) != 10 or not cells[8].isdecimal() or len(cells[8]) > 10:
                        raise ValueError(
                            f"{path}: line {number} is no image: number, four numbers of its "
                            "rotation, three of its place, camera and name wanted."
                        )
                    found[cells[9]], of_points = int(cells[8]), True
    except UnicodeDecodeError:
        raise ValueError(f"{path} is no text in UTF-8.") from None
    return found
