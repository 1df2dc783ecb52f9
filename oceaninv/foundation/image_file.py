"""Pixels from image files and numpy files, with every size checked before anything is decoded."""

import contextlib
import dataclasses
import io
import lzma
import os
import threading
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

# Largest integer of each integer format that OpenImageIO names.
_LARGEST = {"uint8": 255, "uint16": 65535, "uint32": 2**32 - 1, "int8": 127, "int16": 32767}
# Images of one file that are looked at for the largest.
_MOST_IMAGES = 1000
_MOST_CHANNELS = 64
_LONGEST_HEADER = 10_000  # bytes, of an .npy file; numpy's own limit


@dataclasses.dataclass(frozen=True, eq=False)
class Image:
    """An image file.

    - `values`: (row, column, channel) float32; integers are shares of their largest value.  NaN
      where an EXR file has no data within its display window.
    - `names`: of the channels.
    - `largest`: largest value of the file's integers, None for floats.
    - `attributes`: the file's metadata by their OpenImageIO names.
    """

    values: np.ndarray
    names: tuple[str, ...]
    largest: int | None
    attributes: Mapping[str, Any]


Select = Callable[[tuple[str, ...]], tuple[int, int] | None]


def read_image(
    path: Path, most: int, select: Select | None = None, wanted: str = "at most 64"
) -> Image:
    """The largest image of a file, the channels that `select` wants.

    **Arguments:**

    - `most`: pixels.  A file whose header claims more is refused before it is decoded.
    - `select`: takes the names of the channels to (first, behind the last), or to None where the
      image does not hold what is `wanted` (words).  By default all channels are read.

    Of a file of several images (pages of a TIFF, parts of an EXR), the largest that holds the
    wanted channels is read.  An EXR whose data window differs from its display window is brought
    to the display window.  Alpha is left as a channel of its own and not multiplied into others.

    **Raises:** ValueError, naming the file, for what is no image, is cut short, is too large, has
    several images of the largest size, is deep or is a volume.
    """
    import OpenImageIO as oiio

    wish = oiio.ImageSpec()
    wish.attribute("oiio:UnassociatedAlpha", 1)
    with silenced():
        source = oiio.ImageInput.open(str(path), wish)
        if source is None:
            _forget_error(oiio)
            raise ValueError(
                f"{path} is no picture: it cannot be read, its format is unknown or its header "
                "damaged."
            )
        try:
            number, (first, last) = _largest_image(path, source, select, wanted)
            source.seek_subimage(number, 0)
            spec = source.spec()
            _check_size(path, spec, most)
            pixels = source.read_image(number, 0, first, last, oiio.FLOAT)
            if pixels is None or source.has_error:
                raise ValueError(f"{path} is damaged or cut short: its pixels cannot be decoded.")
            exr = source.format_name() == "openexr"
        finally:
            _forget_error(source)
            source.close()
    pixels = np.asarray(pixels, dtype=np.float32).reshape(spec.height, spec.width, last - first)
    if exr:
        pixels = _in_display_window(path, pixels, spec)
    names = _names(path, spec)[first:last]
    return Image(pixels, names, _LARGEST.get(str(spec.format)), _attributes(spec))


def _forget_error(source: Any) -> None:
    """Clear the stored error of OpenImageIO, whose words name libraries and folders."""
    with contextlib.suppress(UnicodeDecodeError):
        source.geterror()


def _names(path: Path, spec: Any) -> tuple[str, ...]:
    try:
        return tuple(str(name) for name in spec.channelnames)
    except UnicodeDecodeError:
        raise ValueError(f"{path} is damaged: the names of its channels cannot be read.") from None


def _attributes(spec: Any) -> dict[str, Any]:
    """The metadata, without texts that are not Unicode."""
    found = {}
    for number in range(len(spec.extra_attribs)):
        # A name that is not Unicode can be read, but not asked for: TypeError.
        with contextlib.suppress(UnicodeDecodeError, TypeError):
            name = spec.extra_attribs[number].name
            found[name] = spec.getattribute(name)
    return found


_silence = threading.Lock()


@contextlib.contextmanager
def silenced():
    """Nothing on the standard error of the process: libpng, libtiff and LibRaw print into it.

    One thread at a time, or the second would keep the silence of the first.
    """
    with _silence:
        try:
            kept = os.dup(2)
        except OSError:  # closed, so nothing can be printed
            yield
            return
        try:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def _largest_image(
    path: Path, source, select: Select | None, wanted: str
) -> tuple[int, tuple[int, int]]:
    """Number and channels of the largest image that holds what is wanted."""
    sizes, found, names = [], [], ()
    for number in range(_MOST_IMAGES):
        if number and not source.seek_subimage(number, 0):
            _forget_error(source)
            break
        spec = source.spec()
        if spec.deep:
            raise ValueError(
                f"{path} is a deep image, several samples at one pixel: flatten it to one sample "
                "each."
            )
        here = _names(path, spec)
        names = names or here
        every = (0, len(here)) if len(here) <= _MOST_CHANNELS else None
        channels = every if select is None else select(here)
        if channels is not None:
            sizes.append(spec.width * spec.height)
            found.append((number, channels))
    if not sizes:
        shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
        raise ValueError(f"{path} has {len(names)} channel(s) ({shown}); {wanted} wanted.")
    if sizes.count(max(sizes)) > 1:
        raise ValueError(
            f"{path} holds {sizes.count(max(sizes))} images of its largest size: save the one that "
            "is meant as a file of its own."
        )
    return found[int(np.argmax(sizes))]


def _check_size(path: Path, spec, most: int) -> None:
    if spec.depth > 1:
        raise ValueError(f"{path} is a volume of {spec.depth} layers, not a picture.")
    for width, height in ((spec.width, spec.height), (spec.full_width, spec.full_height)):
        if width * height > most:
            raise ValueError(
                f"{path} has {width} x {height} pixels; at most {most / 1e6:g} megapixels are "
                "read: bin it down first."
            )
    if int(spec.getattribute("tiff:subfiletype") or 0) & 1:
        raise ValueError(
            f"{path} holds nothing but a reduced preview of another image: export the full image."
        )


def _in_display_window(path: Path, pixels: np.ndarray, spec) -> np.ndarray:
    """The pixels of the display window; NaN where the data window does not reach."""
    top, left = spec.y - spec.full_y, spec.x - spec.full_x
    rows, columns = spec.full_height, spec.full_width
    if (top, left, rows, columns) == (0, 0, *pixels.shape[:2]):
        return pixels
    down = slice(max(top, 0), min(top + pixels.shape[0], rows))
    across = slice(max(left, 0), min(left + pixels.shape[1], columns))
    if down.start >= down.stop or across.start >= across.stop:
        raise ValueError(f"{path}: its data window lies outside of its display window.")
    whole = np.full((rows, columns, pixels.shape[2]), np.nan, dtype=np.float32)
    whole[down, across] = pixels[
        down.start - top : down.stop - top, across.start - left : across.stop - left
    ]
    return whole


def read_numpy(path: Path, most: int) -> np.ndarray:
    """The one array of numbers of an .npz or .npy file, as float64.

    `most`: numbers; a file whose header claims more, or more than the file holds, is refused
    before it is read.  ValueError, naming the file, for this and for anything else than one array
    of real numbers; nothing is unpickled.
    """
    try:
        # numpy would leave its own handle open when the archive is damaged.
        with open(path, "rb") as handle:
            if path.suffix.lower() != ".npz":
                return _read_array(path, handle, path.stat().st_size, most)
            with zipfile.ZipFile(handle) as archive:
                members = archive.infolist()
                if len(members) != 1:
                    named = ", ".join(m.filename.removesuffix(".npy") for m in members[:8])
                    raise ValueError(f"{path} must hold one array, not {len(members)} ({named}).")
                with archive.open(members[0]) as stream:
                    return _read_array(path, stream, members[0].file_size, most)
    except (PermissionError, FileNotFoundError):
        raise
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, OSError, RuntimeError):
        raise ValueError(f"{path} is no readable numpy file: it is damaged or cut short.") from None


def _read_array(path: Path, stream: BinaryIO | Any, size: int, most: int) -> np.ndarray:
    """The array of one .npy stream of `size` bytes."""
    import tokenize

    try:
        version = np.lib.format.read_magic(stream)
        read = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        counted = stream.read(2 if version == (1, 0) else 4)
        if (length := int.from_bytes(counted, "little")) > _LONGEST_HEADER:
            raise ValueError  # before it is read: a packed gigabyte of blanks is short
        shape, by_columns, dtype = read(io.BytesIO(counted + stream.read(length)))
    except (ValueError, KeyError, TypeError, SyntaxError, tokenize.TokenError, RecursionError):
        raise ValueError(f"{path} holds no numpy array that can be read.") from None
    if dtype.kind not in "fiu":
        raise ValueError(f"{path} holds no array of numbers.")
    count = 1
    for length in shape:
        count *= int(length)
    if count > most or any(length < 0 for length in shape):
        raise ValueError(
            f"{path} claims an array of shape {shape}; at most {most / 1e6:g} million numbers are "
            "read."
        )
    if count * dtype.itemsize > size:
        raise ValueError(f"{path} is cut short: its array of shape {shape} does not fit into it.")
    raw = stream.read(count * dtype.itemsize)
    if len(raw) < count * dtype.itemsize:
        raise ValueError(f"{path} is cut short: its array of shape {shape} does not fit into it.")
    values = np.frombuffer(raw, dtype=dtype)
    return values.reshape(shape, order="F" if by_columns else "C").astype(np.float64)
