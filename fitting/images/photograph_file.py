"""Photographs as linear camera values, read from files."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from fitting.images.saturation import saturation_spike
from fitting.images.stated_encoding import LINEAR, SRGB, Encoding, stated_encoding
from oceaninv.foundation.image_file import read_image, silenced

if TYPE_CHECKING:
    from fitting.observations.photo import Pixels

_RAW = {".nef", ".cr2", ".cr3", ".arw", ".dng", ".orf", ".raf", ".rw2", ".pef", ".srw"}
_JPEG = {".jpg", ".jpeg"}
# Largest picture that is read, pixels; reading takes 50 bytes of memory for each.
MOST_PIXELS = 60_000_000
# Share of a raw file's white level above which a spike of its counts is taken for saturation.
_LEAST_SATURATION = 0.7


@dataclasses.dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph as linear camera values.

    - `values`: (row, column, 3), 1 at full scale.
    - `mask`: (row, column, 3), where a value may be used: finite, positive, below full scale.
    - `step`: standard deviation of the rounding of the file's numbers, in units of `values`.
    - `relative`: relative standard deviation of one pixel that comes from decoding a display
      curve; 0 for linear files.
    - `exif`: metadata by the names Make, Model, DateTime, ExposureTime (s), FNumber, ISO, Flash,
      FocalLengthIn35mmFilm (mm).
    - `source`: path of the file.
    """

    values: Float[np.ndarray, "row column 3"]
    mask: Bool[np.ndarray, "row column 3"]
    step: float
    relative: float
    exif: Mapping[str, Any]
    source: str

    @property
    def exposure(self) -> float | None:
        """Time x ISO / f-number^2, relative to 1 s at ISO 100 and f/1; None if not stated."""
        needed = [self.exif.get(k) for k in ("ExposureTime", "ISO", "FNumber")]
        if any(not v for v in needed):
            return None
        time, iso, number = (float(v) for v in needed if v)
        return time * iso / 100.0 / number**2

    @property
    def flash(self) -> bool | None:
        """Whether the file says that a flash fired; None if it does not say."""
        word = self.exif.get("Flash")
        return None if word is None else bool(int(word) & 1)

    @property
    def camera(self) -> str | None:
        """The camera's name in the table of responses; None if not stated or not in the table."""
        from oceaninv.foundation.spectrum import camera_names

        model = str(self.exif.get("Model", "")).casefold()
        make = str(self.exif.get("Make", "")).split(" ")[0].casefold()
        for name in camera_names():
            if name.casefold() in (model, f"{make} {model}"):
                return name
        return None


def read_photograph(path: str | Path, encoding: str | None = None) -> Photograph:
    """A photograph as linear camera values.

    `encoding`: "linear" or "sRGB" (inverted).  None takes raw files and EXR as linear, a 16-bit
    PNG or TIFF by what it states (chunks cICP, iCCP, sRGB, gAMA; ICC profile) and as linear where
    it states nothing, and refuses 8-bit files and JPEG, whose curve is seldom what they state.
    Decoding a curve adds 5 % to every pixel, for no camera follows such a curve exactly.

    Values of raw files are the counts above the stated black level as shares of the stated white
    level; two by two counts (three by three of an X-Trans sensor) become one pixel, without
    demosaicing.  Pixels at the white level, or in a spike of the histogram below it, are masked.
    So are pixels that are transparent, and those of an EXR outside its data window.

    **Raises:** ValueError with a sentence for what cannot be read as three linear channels, and for
    more than 60 megapixels (240 of a raw file) before they are decoded.
    **Warns:** UserWarning where the file contradicts `encoding`, for transparent pixels, and where
    a raw file is saturated below its stated white level.
    """
    path = existing(path)
    if encoding not in (None, "linear", "sRGB"):
        raise ValueError(f'encoding is {encoding!r}; "linear" or "sRGB" wanted.')
    suffix = path.suffix.lower()
    if suffix in _JPEG and encoding != "sRGB":
        raise ValueError(
            f"{path}: JPEG is not linear: use the raw file, or ask for the sRGB curve by "
            'encoding="sRGB", which adds 5 % to every reading.'
        )
    if suffix in _RAW:
        values, step, exif, usable = _read_raw(path)
        largest, curve = None, SRGB if encoding == "sRGB" else LINEAR
        top = 1.0
    else:
        image = read_image(path, MOST_PIXELS, _colours, "red, green and blue")
        values, usable = _opaque(path, image.values.astype(np.float64))
        largest, exif = image.largest, _exif(image.attributes)
        if largest not in (None, 255, 65535):
            raise ValueError(f"{path} has integers up to {largest}; 8 or 16 bits are read.")
        step = 0.0 if largest is None else 1.0 / largest / np.sqrt(12.0)
        top = np.inf if largest is None else 1.0
        if largest == 255 and encoding is None:
            raise ValueError(
                f'{path} has 8 bits: say encoding="linear" if its developer was set so, or "sRGB".'
            )
        curve = _curve(path, encoding, image.attributes)
    if min(values.shape[:2]) < 8:
        raise ValueError(
            f"{path} is {values.shape[1]} x {values.shape[0]} pixels; at least 8 x 8 are needed."
        )
    relative = 0.0
    unsaturated = values < top  # of the encoded values: a curve may end below 1
    if not curve.linear:
        values = curve.decode(values)
        relative, step = 0.05, 2.2 * step
    mask = np.isfinite(values) & (values > 0) & unsaturated & usable[:, :, None]
    if not np.any(np.isfinite(values) & (values > 0)):
        raise ValueError(f"{path} is black: no pixel is above zero.")
    if not usable.any():
        raise ValueError(f"{path} has no pixel that can be used: all are transparent or clipped.")
    if not mask.any():
        raise ValueError(f"{path} is clipped everywhere: no pixel is below full scale.")
    return Photograph(values, mask, step, relative, exif, str(path))


def existing(path: str | Path) -> Path:
    """The path of a file; ValueError where it does not exist or is empty."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist or is no file.")
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty (0 bytes).")
    return path


def _colours(names: tuple[str, ...]) -> tuple[int, int] | None:
    """Red, green, blue and, where it follows, alpha."""
    short = [name.casefold() for name in names]
    if short[:3] != ["r", "g", "b"] or (len(names) > 4 and short[4].startswith("channel")):
        return None
    return 0, 4 if short[3:4] == ["a"] else 3


def _opaque(path: Path, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(row, column, 3) colours, and which pixels are not transparent."""
    if values.shape[2] == 3:
        return values, np.ones(values.shape[:2], dtype=bool)
    opaque = values[:, :, 3] >= 1.0 - 1e-3
    left_out = int(np.sum(~opaque))
    if not opaque.any():
        raise ValueError(
            f"{path}: alpha is below 1 in every pixel, so none shows the scene alone: save it "
            "without alpha."
        )
    if left_out:
        warnings.warn(
            f"{path}: {left_out} pixels are transparent (alpha below 1) and left out.",
            stacklevel=3,
        )
    return values[:, :, :3], opaque


def _curve(path: Path, encoding: str | None, attributes: Mapping[str, Any]) -> Encoding:
    """The encoding asked for, else the stated one, else linear; a contradiction is warned of."""
    asked = {None: None, "linear": LINEAR, "sRGB": SRGB}[encoding]
    try:
        stated = stated_encoding(path, attributes)
    except ValueError:
        if asked is None:
            raise
        return asked
    if asked is None:
        return LINEAR if stated is None else stated
    alike = stated is None or (stated.linear if asked.linear else stated.name.startswith(SRGB.name))
    if stated is not None and not alike:
        warnings.warn(
            f"{path} states {stated.name}, which contradicts the encoding {encoding!r} that was "
            f"asked for; it is read as {encoding}.",
            stacklevel=3,
        )
    return asked


def _exif(attributes: Mapping[str, Any]) -> dict[str, Any]:
    names = {"ExposureTime": "ExposureTime", "FNumber": "FNumber", "Make": "Make"}
    names |= {"Model": "Model", "Exif:PhotographicSensitivity": "ISO", "Exif:Flash": "Flash"}
    names |= {"Exif:ISOSpeedRatings": "ISO", "DateTime": "DateTime"}
    names |= {"Exif:FocalLengthIn35mmFilm": "FocalLengthIn35mmFilm"}
    return {short: attributes[long] for long, short in names.items() if long in attributes}


def _read_raw(path: Path) -> tuple[np.ndarray, float, dict[str, Any], np.ndarray]:
    """Linear camera channels of blocks of counts, step, EXIF, and which pixels are not clipped.

    Scaled by the stated black and white levels alone: LibRaw's own development scales by the
    brightest pixel of a frame where this is above 0.75 of the white level, and leaves red and blue
    of X-Trans mosaics without a value at half size.
    """
    try:
        import rawpy
    except ImportError:
        raise ValueError(f"{path}: raw files need rawpy: pip install 'oceaninv[raw]'.") from None
    below: dict[float, int] = {}
    try:
        with silenced(), rawpy.imread(str(path)) as raw:
            if raw.sizes.width * raw.sizes.height > 4 * MOST_PIXELS:  # read at half size
                raise ValueError(
                    f"{path} has {raw.sizes.width} x {raw.sizes.height} pixels; at most "
                    f"{4 * MOST_PIXELS // 10**6} megapixels of raw files are read."
                )
            black, white = raw.black_level_per_channel, int(raw.white_level)
            if not max(black) < white:
                raise ValueError(
                    f"{path} states a white level of {white}, not above its black level of "
                    f"{max(black)}: its counts cannot be scaled."
                )
            step = 1.0 / (white - max(black)) / np.sqrt(12.0)
            pattern = raw.raw_pattern
            if pattern is None and raw.num_colors == 3 and raw.raw_type == rawpy.RawType.Stack:
                # No mosaic: three counts at every pixel.
                counts = raw.raw_image_visible[:, :, :3].astype(np.float64)
                values = (counts - np.array(black[:3])) / (white - np.array(black[:3]))
                usable = np.asarray(np.all(counts < white, axis=2))
            else:
                # Bayer and X-Trans mosaics hold every colour in each block of this size.
                size = 2 if pattern is not None and pattern.shape == (2, 2) else 3
                if pattern is None or pattern.size not in (4, 36) or raw.color_desc != b"RGBG":
                    raise ValueError(
                        f"{path} is no Bayer or X-Trans mosaic of red, green and blue: of raw "
                        "mosaics, only these are read."
                    )
                colours = raw.raw_colors_visible
                values, usable, below = _binned(raw.raw_image_visible, colours, size, black, white)
    except (rawpy.LibRawError, OSError, MemoryError):
        raise ValueError(
            f"{path} cannot be read as a raw file: it is damaged, cut short, or of a format that "
            "LibRaw does not know."
        ) from None
    if below:
        named = ", ".join(f"{n} at {level:g}" for level, n in sorted(below.items()))
        warnings.warn(
            f"{path}: the sensor saturates below the stated white level of {white} counts; "
            f"{named} are left out.",
            stacklevel=3,
        )
    from fitting.images._raw_exif import raw_exif

    return values, step, raw_exif(path), usable


def _binned(
    counts: np.ndarray, colours: np.ndarray, size: int, black: Sequence[int], white: int
) -> tuple[np.ndarray, np.ndarray, dict[float, int]]:
    """Blocks of size x size counts as pixels of shares of the white level, and which are usable.

    `colours`: (row, column) LibRaw's number of the colour of each count, 1 and 3 both green; every
    block holds all three colours.  The third result is the number of counts that are clipped at
    each level below the white level.
    """
    rows, columns = counts.shape[0] // size, counts.shape[1] // size
    sums, number = np.zeros((rows, columns, 3)), np.zeros((rows, columns, 3))
    usable = np.ones((rows, columns), dtype=bool)
    below: dict[float, int] = {}
    for down in range(size):
        for across in range(size):
            part = slice(down, size * rows, size), slice(across, size * columns, size)
            plane, colour = counts[part].astype(np.float64), colours[part]
            for one in np.unique(colour):
                here = colour == one
                share = (plane - black[one]) / (white - black[one])
                clipped = here & (plane >= white)
                spike = None if clipped.any() else saturation_spike(share[here])
                if spike is not None and spike >= _LEAST_SATURATION:
                    clipped = here & (share >= 0.999 * spike)
                    level = float(plane[here].max())
                    below[level] = below.get(level, 0) + int(clipped.sum())
                usable &= ~clipped
                channel = 1 if one == 3 else int(one)
                sums[:, :, channel] += np.where(here, share, 0.0)
                number[:, :, channel] += here
    return sums / number, usable, below


def pixels_of(photograph: Photograph, distance: Any, **rest: Any) -> "Pixels":
    """The usable pixels of a photograph that have a range, as surfaces of unknown reflectance.

    `distance`: (row, column) metres, NaN where missing (`fitting.read_range`).  `rest`: further
    arguments of `Pixels`.  ValueError where its shape is not that of the photograph.
    """
    from fitting.observations.photo import Pixels

    distance = np.asarray(distance, dtype=np.float64)
    if distance.shape != photograph.values.shape[:2]:
        raise ValueError(
            f"distance has shape {distance.shape}, the photograph {photograph.values.shape[:2]}."
        )
    usable = np.isfinite(distance) & photograph.mask.all(axis=2)
    return Pixels(photograph.values[usable], distance[usable], **rest)
