"""Photographs and range maps from files, and the patches of charts in them."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

if TYPE_CHECKING:
    from fitting.observations.photo import Pixels

_RAW = {".nef", ".cr2", ".cr3", ".arw", ".dng", ".orf", ".raf", ".rw2", ".pef", ".srw"}
_JPEG = {".jpg", ".jpeg"}
# Largest picture read, pixels: beyond it 1.2 GB of memory are wanted.
_MOST = 60_000_000


@dataclasses.dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph as linear camera values.

    - `values`: (row, column, 3), 1 at full scale; `mask`: where a value may be used (finite,
      positive, below full scale).
    - `step`: rounding of the file, as a standard deviation; `relative`: relative standard
      deviation of one pixel (added by decoding a display curve, 0 otherwise).
    - `exif`: what the file says about itself.
    """

    values: Float[np.ndarray, "row column 3"]
    mask: Bool[np.ndarray, "row column 3"]
    step: float
    relative: float
    exif: Mapping[str, Any]
    source: str

    @property
    def exposure(self) -> float | None:
        """Time x ISO / f-number^2, relative to 1 s at ISO 100 and f/1; None if not recorded."""
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
        """The camera's name in the table of responses, None if it is not stated or not there."""
        from oceaninv.foundation.spectrum import camera_names

        model = str(self.exif.get("Model", "")).casefold()
        make = str(self.exif.get("Make", "")).split(" ")[0].casefold()
        for name in camera_names():
            if name.casefold() in (model, f"{make} {model}"):
                return name
        return None


def read_photograph(path: str | Path, encoding: str | None = None) -> Photograph:
    """A photograph as linear camera values.

    `encoding`: "linear" or "sRGB" (inverted, 5 % added to every pixel, for no camera follows the
    curve exactly); None takes EXR, 16-bit PNG and TIFF and raw files as linear, and refuses 8-bit
    files and JPEG, whose curve nobody knows.

    Raises ValueError with a sentence for what cannot be read as three linear channels.
    """
    path = _existing(path)
    if encoding not in (None, "linear", "sRGB"):
        raise ValueError(f'encoding is {encoding!r}; "linear" or "sRGB" wanted.')
    suffix = path.suffix.lower()
    if suffix in _JPEG and encoding != "sRGB":
        raise ValueError(
            f"{path}: JPEG is not linear: use the raw file, or ask for the sRGB curve by "
            'encoding="sRGB", which adds 5 % to every reading.'
        )
    if suffix in _RAW:
        values, full, exif, clipped = _read_raw(path)
    else:
        values, full, exif, clipped = *_read_image(path), None
    if values.ndim != 3 or values.shape[-1] not in (3, 4):
        channels = values.shape[2] if values.ndim == 3 else 1
        raise ValueError(f"{path} has {channels} channel(s); red, green and blue wanted.")
    values = values[:, :, :3]
    if min(values.shape[:2]) < 8:
        raise ValueError(
            f"{path} is {values.shape[1]} x {values.shape[0]} pixels; at least 8 x 8 are needed."
        )
    if full == 255 and encoding is None:
        raise ValueError(
            f'{path} has 8 bits: say encoding="linear" if its developer was set so, or "sRGB".'
        )
    step = 0.0 if full is None else 1.0 / full / np.sqrt(12.0)
    relative = 0.0
    if encoding == "sRGB":
        bright = ((np.maximum(values, 0.0) + 0.055) / 1.055) ** 2.4
        values = np.asarray(np.where(values <= 0.04045, values / 12.92, bright))
        relative, step = 0.05, 2.2 * step
    top = 1.0 if full is not None else np.inf
    mask = np.isfinite(values) & (values > 0) & (values < top)
    if clipped is not None:
        mask &= ~clipped[:, :, None]
    if not np.any(np.isfinite(values) & (values > 0)):
        raise ValueError(f"{path} is black: no pixel is above zero.")
    if not mask.any():
        raise ValueError(f"{path} is clipped everywhere: no pixel is below full scale.")
    return Photograph(values, mask, step, relative, exif, str(path))


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist or is no file.")
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty (0 bytes).")
    return path


def _read_image(path: Path) -> tuple[Any, int | None, dict[str, Any]]:
    """Values (1 at full scale), full scale in counts (None for floats), EXIF."""
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(str(path))
    if source is None:
        reason = oiio.geterror() or "unknown format"
        raise ValueError(f"{path} cannot be read as a picture: {reason.splitlines()[0]}")
    try:
        spec = source.spec()
        if spec.width * spec.height > _MOST:
            raise ValueError(
                f"{path} has {spec.width} x {spec.height} pixels; at most {_MOST // 10**6} "
                "megapixels are read: bin it down first."
            )
        values = source.read_image(oiio.FLOAT)
        if values is None or source.has_error:
            reason = (source.geterror() or "it ends early").splitlines()[0]
            raise ValueError(f"{path} is damaged or cut short: {reason}")
        full = {"uint8": 255, "uint16": 65535}.get(str(spec.format))
        names = {"ExposureTime": "ExposureTime", "FNumber": "FNumber", "Make": "Make"}
        names |= {"Model": "Model", "Exif:PhotographicSensitivity": "ISO", "Exif:Flash": "Flash"}
        names |= {"Exif:ISOSpeedRatings": "ISO", "DateTime": "DateTime"}
        found = ((short, spec.getattribute(long)) for long, short in names.items())
        exif = {short: value for short, value in found if value is not None}
    finally:
        source.close()
    return np.asarray(values, dtype=np.float64), full, exif


def _read_raw(path: Path) -> tuple[Any, int | None, dict[str, Any], np.ndarray]:
    """Linear camera channels at half size (no demosaicing), full scale, EXIF, clipped pixels."""
    try:
        import rawpy
    except ImportError:
        raise ValueError(f"{path}: raw files need rawpy: pip install 'oceaninv[raw]'.") from None
    try:
        with rawpy.imread(str(path)) as raw:
            if raw.sizes.width * raw.sizes.height > 4 * _MOST:  # read at half size
                raise ValueError(
                    f"{path} has {raw.sizes.width} x {raw.sizes.height} pixels; at most "
                    f"{4 * _MOST // 10**6} megapixels of raw files are read."
                )
            values = raw.postprocess(
                half_size=True,
                gamma=(1, 1),
                no_auto_bright=True,
                no_auto_scale=False,
                use_camera_wb=False,
                user_wb=[1.0, 1.0, 1.0, 1.0],
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                user_flip=0,
            )
            counts = raw.raw_image_visible >= raw.white_level
    except rawpy.LibRawError as error:
        raise ValueError(f"{path} cannot be read as a raw file: {error}") from None
    rows, columns = values.shape[0], values.shape[1]
    blocks = counts[: 2 * rows, : 2 * columns]
    blocks = np.pad(blocks, [(0, 2 * rows - blocks.shape[0]), (0, 2 * columns - blocks.shape[1])])
    clipped = blocks.reshape(rows, 2, columns, 2).any(axis=(1, 3))
    from fitting.images._raw_exif import raw_exif

    return values / 65535.0, 65535, raw_exif(path), np.asarray(clipped)


def read_range(path: str | Path, shape: tuple[int, int]) -> Float[np.ndarray, "row column"]:
    """A range map in metres at the pixels of a photograph of `shape` (row, column); NaN: missing.

    EXR and float TIFF are in metres, uint16 TIFF and PNG in millimetres, npz holds one array in
    metres, .bin is a COLMAP depth map.  0, negative, NaN and infinite are missing.  A map of
    another size is brought to the photograph's by its nearest pixel; it must have the same shape
    to 3 %.
    """
    path = _existing(path)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        values = _read_npz(path)
    elif suffix == ".bin":
        values = _read_colmap(path)
    else:
        values, full, _ = _read_image(path)
        values = values[:, :, 0] if values.ndim == 3 else values
        if full == 255:
            raise ValueError(f"{path} has 8 bits: a range map needs float metres or 16-bit mm.")
        if full == 65535:
            values = values * 65.535
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2:
        raise ValueError(f"{path}: a range map is one plane, not shape {values.shape}.")
    ratio = values.shape[0] / shape[0] / (values.shape[1] / shape[1])
    if abs(ratio - 1) > 0.03:
        raise ValueError(
            f"{path} is {values.shape[1]} x {values.shape[0]}, the photograph {shape[1]} x "
            f"{shape[0]}: another shape, so not of this photograph (or turned)."
        )
    values = np.where(np.isfinite(values) & (values > 0), values, np.nan)
    if not np.isfinite(values).any():
        raise ValueError(f"{path} holds no range: every pixel is 0, negative, NaN or infinite.")
    rows, columns = (
        np.minimum(((np.arange(n) + 0.5) * have / n).astype(int), have - 1)
        for n, have in zip(shape, values.shape, strict=True)
    )
    return values[np.ix_(rows, columns)]


def pixels_of(photograph: Photograph, distance: Any, **rest: Any) -> "Pixels":
    """All usable pixels of a photograph that have a range, as things of unknown reflectance.

    `distance`: (row, column) metres, NaN where missing (`read_range`); `rest` as in `Pixels`.
    """
    from fitting.observations.photo import Pixels

    distance = np.asarray(distance, dtype=np.float64)
    if distance.shape != photograph.values.shape[:2]:
        raise ValueError(
            f"distance has shape {distance.shape}, the photograph {photograph.values.shape[:2]}."
        )
    usable = np.isfinite(distance) & photograph.mask.all(axis=2)
    return Pixels(photograph.values[usable], distance[usable], **rest)


def _read_npz(path: Path) -> np.ndarray:
    import zipfile
    import zlib

    try:
        # A handle of our own: numpy leaves its own open when the archive is damaged.
        with open(path, "rb") as handle, np.load(handle, allow_pickle=False) as file:
            if len(file.files) != 1:
                raise ValueError(
                    f"{path} holds {len(file.files)} arrays ({', '.join(file.files)}); one wanted."
                )
            try:
                values = file[file.files[0]]
            except ValueError:  # objects, or an array cut short
                values = np.zeros(0, dtype=object)
            if values.dtype.kind not in "fiu":
                raise ValueError(f"{path} holds no array of numbers.")
            return values
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError) as error:
        raise ValueError(f"{path} is no readable npz file: {error}") from None


def _read_colmap(path: Path) -> np.ndarray:
    """COLMAP's dense maps: "width&height&channels&", then float32 in column-major order."""
    raw = path.read_bytes()
    parts = raw.split(b"&", 3)
    if len(parts) < 4 or not all(part.isdigit() for part in parts[:3]):
        raise ValueError(f"{path} does not begin like a COLMAP map: width&height&channels&.")
    width, height, channels = (int(part) for part in parts[:3])
    if channels != 1 or len(parts[3]) != 4 * width * height:
        raise ValueError(
            f"{path} should hold {width} x {height} x {channels} floats of one channel, but has "
            f"{len(parts[3])} bytes: cut short, or no depth map."
        )
    return np.frombuffer(parts[3], dtype="<f4").reshape((width, height), order="F").T
