"""Range maps in metres along the lines of sight, read from files."""

import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fitting.images.intrinsics import SAME_SHAPE, Intrinsics, read_intrinsics, same_name
from fitting.images.photograph_file import MOST_PIXELS, Photograph, existing
from oceaninv.foundation.colmap_file import read_depth
from oceaninv.foundation.image_file import read_image, read_numpy

# What COLMAP puts behind the name of the image that a map is of.
_OF_AN_IMAGE = (".geometric.bin", ".photometric.bin")
_DIAGONAL = math.hypot(36.0, 24.0)  # mm, of 35 mm film
_INDEX = 1.34  # of sea water


def read_range(
    path: str | Path,
    shape: tuple[int, int] | Photograph,
    *,
    kind: str | None = None,
    scale: float | None = None,
    known_length: Sequence[float | int] | None = None,
    intrinsics: Intrinsics | str | Path | float | None = None,
) -> Float[np.ndarray, "row column"]:
    """A range map in metres along the line of sight of each pixel of a photograph; NaN: missing.

    EXR and float TIFF are in metres, uint16 TIFF and PNG in millimetres, npz and npy hold one array
    in metres, .bin is a COLMAP depth map.  0, negative, NaN and infinite are missing, and so are
    markers: 65535 in 16-bit files, and the largest value where it is above 100 m and ten times
    any other (1e10, 65504, 9999 ...).  A map of another size is brought to the photograph's by
    its nearest pixel; it must have the same shape to 3 %.

    **Arguments:**

    - `shape`: the photograph, or its (row, column) alone.  Of a photograph, the name must be that
      of the image in the name of a COLMAP map (NAME.geometric.bin).
    - `kind`: "line", distance along the line of sight; "z", depth along the optical axis, which is
      less by the cosine of the angle between them.  None: "z" of COLMAP maps, "line" of others.
    - `scale`: metres per unit of the file's numbers.  COLMAP maps have no unit: they need this or
      `known_length`.
    - `known_length`: (x1, y1, x2, y2, metres): two pixels of the photograph, column and row from
      (0, 0), and the distance in space between what they show.  The range of each is the median
      over 3 x 3 pixels around it.
    - `intrinsics`: of the camera, needed for "z" and for `known_length`: `Intrinsics`; a
      cameras.bin, cameras.txt or the folder of a COLMAP model; or the full horizontal field of
      view in degrees, of square pixels without distortion.  COLMAP's dense maps are of undistorted
      pictures, so their camera is the PINHOLE of the dense model.

    **Raises:** ValueError with a sentence for what is no range map of this photograph, and for
    arguments that are missing, out of range or contradict each other.
    **Warns:** UserWarning with the count of marked pixels, where the size had to be changed (of an
    undistorted picture, a map fits the original photograph only after both are undistorted), where
    pixels lie beyond what the distortion can show, and where `intrinsics` are of no use.
    """
    return read_range_and_say(
        path, shape, kind=kind, scale=scale, known_length=known_length, intrinsics=intrinsics
    )[0]


def read_range_and_say(
    path: str | Path,
    shape: tuple[int, int] | Photograph,
    *,
    kind: str | None = None,
    scale: float | None = None,
    known_length: Sequence[float | int] | None = None,
    intrinsics: Intrinsics | str | Path | float | None = None,
) -> tuple[Float[np.ndarray, "row column"], str]:
    """What `read_range` gives, and a sentence that says how the file was taken."""
    path = existing(path)
    photograph = shape if isinstance(shape, Photograph) else None
    rows, columns = shape.values.shape[:2] if isinstance(shape, Photograph) else shape
    colmap = path.suffix.lower() == ".bin"
    kind = ("z" if colmap else "line") if kind is None else kind
    if kind not in ("z", "line"):
        raise ValueError(f'the kind of range is {kind!r}; "z" or "line" wanted.')
    if scale is not None and known_length is not None:
        raise ValueError("a scale and a known length contradict each other: give one of them.")
    if scale is not None and not 0.0 < scale < math.inf:
        raise ValueError(f"the scale is {scale:g} m per unit; a positive number wanted.")
    image = _image_of(path)
    if photograph is not None and image is not None and not same_name(image, photograph.source):
        raise ValueError(
            f"{path} is the map of {image}, not of {Path(photograph.source).name}: give that of "
            "this photograph, or rename it if it is."
        )
    values, integers = _read(path)
    ratio = values.shape[0] / rows / (values.shape[1] / columns)
    if abs(ratio - 1) > SAME_SHAPE:
        raise ValueError(
            f"{path} is {values.shape[1]} x {values.shape[0]}, the photograph {columns} x "
            f"{rows}: another shape, so not of this photograph (or turned)."
        )
    if colmap and scale is None and known_length is None:
        raise ValueError(
            f"{path} is a COLMAP map, whose unit is arbitrary: give the scale in m per unit, or a "
            "known length between two pixels."
        )
    camera = _camera(path, photograph, (rows, columns), image, kind, known_length, intrinsics)
    unit = scale or (0.001 if integers else 1.0)
    _drop_missing(path, values, integers, unit)
    values = _resized(path, values, (rows, columns))
    if kind == "z" and camera is not None:
        missing = np.count_nonzero(np.isnan(values))
        values *= camera.range_over_depth((rows, columns))
        if lost := np.count_nonzero(np.isnan(values)) - missing:
            warnings.warn(
                f"{path}: {lost} pixels lie beyond what the camera's distortion can show and are "
                "taken as missing.",
                stacklevel=3,
            )
    if known_length is not None and camera is not None:
        unit = _scale(path, values, camera, known_length)
    with np.errstate(over="ignore", under="ignore"):
        values *= unit
    if np.isinf(values).any() or np.any(values <= 0) or np.isnan(values).all():
        raise ValueError(f"{path} holds no ranges that can be used at {unit:g} m a unit.")
    what = "depths along the optical axis" if kind == "z" else "distances along the line of sight"
    return values, f"{path}: {what}, {unit:.6g} m a unit"


def _image_of(path: Path) -> str | None:
    """The image that a COLMAP map is of, by the map's name."""
    for ending in _OF_AN_IMAGE:
        if path.name.lower().endswith(ending):
            return path.name[: -len(ending)]
    return None


def _camera(
    path: Path,
    photograph: Photograph | None,
    shape: tuple[int, int],
    image: str | None,
    kind: str,
    known_length: Sequence[float | int] | None,
    intrinsics: Intrinsics | str | Path | float | None,
) -> Intrinsics | None:
    """The camera, where it is needed."""
    if intrinsics is None:
        if kind == "line" and known_length is None:
            return None
        need = "depths along the optical axis" if kind == "z" else "a known length"
        raise ValueError(
            f"{path}: {need} can only be turned into ranges with the camera's intrinsics: give the "
            f"cameras.bin of its model or the horizontal field of view.{_stated_view(photograph)}"
        )
    if kind == "line" and known_length is None:
        warnings.warn(
            f"{path} is taken as distances along the line of sight, for which no intrinsics are "
            'needed: say that its kind is "z" if they are depths along the optical axis.',
            stacklevel=4,
        )
    if isinstance(intrinsics, (str, Path)):
        name = image or (None if photograph is None else Path(photograph.source).name)
        camera = read_intrinsics(intrinsics, name)
    elif isinstance(intrinsics, Intrinsics):
        camera = intrinsics
    else:
        camera = Intrinsics.of_field_of_view(float(intrinsics), shape)
    if not camera.fits(shape):
        raise ValueError(
            f"{path}: the camera's pictures are {camera.width} x {camera.height}, the photograph "
            f"{shape[1]} x {shape[0]}: another shape, so not of this photograph (or turned)."
        )
    if camera.distorted and path.suffix.lower() == ".bin":
        raise ValueError(
            f"{path} is of an undistorted picture, but the camera ({camera.model}) is distorted: "
            "give the cameras.bin of the dense model, a PINHOLE, and the undistorted photograph."
        )
    return camera


def _stated_view(photograph: Photograph | None) -> str:
    """The field of view that the photograph's focal length stands for, as a sentence."""
    focal = None if photograph is None else photograph.exif.get("FocalLengthIn35mmFilm")
    if photograph is None or not focal:
        return ""
    rows, columns = photograph.values.shape[:2]
    half = math.atan(0.5 * _DIAGONAL * columns / math.hypot(rows, columns) / float(focal))
    behind = math.asin(math.sin(half) / _INDEX)  # Snell
    return (
        f"  The photograph states a focal length that gives {2.0 * math.degrees(half):.1f} degrees "
        f"in air and behind a dome, and some {2.0 * math.degrees(behind):.1f} behind a flat port."
    )


def _read(path: Path) -> tuple[np.ndarray, bool]:
    """(row, column) float64 numbers of a file, and whether they are 16-bit integers."""
    suffix = path.suffix.lower()
    integers = False
    if suffix in (".npz", ".npy"):
        values = read_numpy(path, MOST_PIXELS)
    elif suffix == ".bin":
        values = read_depth(path, MOST_PIXELS)
    else:
        image = read_image(path, MOST_PIXELS, _depth, "one plane of depths")
        values = image.values
        if np.any(values[:, :, :1] != values, where=~np.isnan(values)):
            raise ValueError(f"{path} is a picture in colours: a range map is one plane of depths.")
        values = values[:, :, 0]
        if image.largest == 255:
            raise ValueError(f"{path} has 8 bits: a range map needs float metres or 16-bit mm.")
        if image.largest not in (None, 65535):
            raise ValueError(
                f"{path} has integers up to {image.largest}: a range map needs float metres or "
                "16-bit mm."
            )
        integers = image.largest == 65535
    values = np.array(values, dtype=np.float64, order="C")
    if values.ndim != 2 or values.size == 0:
        raise ValueError(f"{path}: a range map is one plane, not shape {values.shape}.")
    if integers:
        values *= 65535.0
        np.round(values, out=values)
    return values, integers


def _depth(names: tuple[str, ...]) -> tuple[int, int] | None:
    """The channel of depths, by its name; else all of a picture of up to four equal channels."""
    short = [name.casefold().rsplit(".", 1)[-1] for name in names]
    for name in ("z", "depth", "distance", "range"):
        if name in short:
            return short.index(name), short.index(name) + 1
    colours = len(names) - (short[-1] == "a" and len(names) > 1)
    return (0, colours) if colours <= 3 else None


def _drop_missing(path: Path, values: np.ndarray, integers: bool, unit: float) -> None:
    """NaN, in place, where a file has no range; a warning that counts markers."""
    values[~(np.isfinite(values) & (values > 0))] = np.nan
    top = float(np.fmax.reduce(values, axis=None, initial=0.0))
    if integers:
        marked, marker = values >= 65535.0, "65535"
    else:
        others = float(np.fmax.reduce(values, axis=None, initial=0.0, where=values < top))
        far = top * unit > 100.0 and 0.0 < 10.0 * others <= top
        marked, marker = (values == top) & far, f"the marker {top:.6g}"
    if count := int(marked.sum()):
        warnings.warn(
            f"{path}: {count} of {values.size} pixels hold {marker} and are taken as missing.",
            stacklevel=4,
        )
        values[marked] = np.nan
    if not np.isfinite(values).any():
        raise ValueError(f"{path} holds no range: every pixel is 0, negative, NaN or a marker.")


def _resized(path: Path, values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The nearest pixel of a map at each pixel of a picture of the same view."""
    if values.shape == tuple(shape):
        return values
    warnings.warn(
        f"{path} is {values.shape[1]} x {values.shape[0]}, the photograph {shape[1]} x {shape[0]}: "
        "the map is resized to it by its nearest pixels.  If the map was made from an undistorted "
        "picture, give that picture, for its pixels lie elsewhere.",
        stacklevel=4,
    )
    nearest = (
        ((2 * np.arange(n) + 1) * m) // (2 * n) for n, m in zip(shape, values.shape, strict=True)
    )
    return values[np.ix_(*nearest)]


def _scale(
    path: Path, values: np.ndarray, camera: Intrinsics, known_length: Sequence[float | int]
) -> float:
    """Metres per unit of ranges along the line of sight, from a length between two pixels."""
    if len(known_length) != 5 or not np.all(np.isfinite(known_length)):
        raise ValueError(
            "a known length is five numbers: column and row of one pixel, of another, and metres."
        )
    *pixels, metres = (float(number) for number in known_length)
    if not metres > 0:
        raise ValueError(f"the known length is {metres:g} m; a positive number wanted.")
    rows, columns = values.shape
    points = []
    for column, row in (pixels[:2], pixels[2:]):
        if not (-0.5 <= column <= columns - 0.5 and -0.5 <= row <= rows - 0.5):
            raise ValueError(
                f"the known length ends at {column:g},{row:g}, outside the picture of {columns} x "
                f"{rows} pixels."
            )
        middle = min(round(row), rows - 1), min(round(column), columns - 1)
        around = tuple(slice(max(at - 1, 0), at + 2) for at in middle)
        seen = values[around][np.isfinite(values[around])]
        x, y = camera.tangents(np.array(column), np.array(row), values.shape)
        line = np.array([x, y, 1.0]) / np.sqrt(1.0 + x**2 + y**2)
        if seen.size == 0 or not np.all(np.isfinite(line)):
            raise ValueError(f"{path} has no range at {column:g},{row:g}, an end of the length.")
        points.append(np.median(seen) * line)
    length = float(np.linalg.norm(points[1] - points[0]))
    if not length > 0:
        raise ValueError("the known length begins and ends at the same point.")
    return metres / length
