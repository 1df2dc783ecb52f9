"""The curve between light and pixel values that an image file states about itself."""

import dataclasses
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

_MOST_PROFILE = 16_000_000  # bytes


@dataclasses.dataclass(frozen=True, eq=False)
class Encoding:
    """A curve between light and pixel values.

    - `name`: how it is spoken of.
    - `linear`: whether values are proportional to light.
    - `decode`: values of (row, column, 3), 1 at full scale, to linear light, 1 at full scale.
    """

    name: str
    linear: bool
    decode: Callable[[np.ndarray], np.ndarray]


def _unchanged(values: np.ndarray) -> np.ndarray:
    return values


def _srgb(values: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, inverted."""
    bright = ((np.maximum(values, 0.0) + 0.055) / 1.055) ** 2.4
    return np.asarray(np.where(values <= 0.04045, values / 12.92, bright))


LINEAR = Encoding("linear", True, _unchanged)
SRGB = Encoding("the sRGB curve", False, _srgb)


def power_law(exponent: float, source: str) -> Encoding:
    """Light is the value to the `exponent`; one within 0.5 % of 1 counts as linear."""
    if abs(exponent - 1.0) < 0.005:
        return Encoding(f"linear ({source})", True, _unchanged)
    return Encoding(
        f"a gamma of {exponent:.3g} ({source})",
        False,
        lambda values: np.maximum(values, 0.0) ** exponent,
    )


def stated_encoding(path: Path, attributes: Mapping[str, Any]) -> Encoding | None:
    """The encoding that a PNG, TIFF or JPEG states, None where it states none.

    PNG: chunks cICP, iCCP, sRGB and gAMA, of which the first counts, as its standard says.  TIFF
    and JPEG: an ICC profile (its red, green and blue tone curves).

    `attributes`: metadata by OpenImageIO's names, for the ICC profile.  ValueError for a statement
    that is not understood.
    """
    chunks = _png_chunks(path)
    if "cICP" in chunks:
        return _coding_independent(path, chunks["cICP"])
    profile = attributes.get("ICCProfile")
    if "iCCP" in chunks:
        return _profile_encoding(path, _unpacked(chunks["iCCP"]))
    if profile is not None:
        return _profile_encoding(path, np.asarray(profile, dtype=np.uint8).tobytes())
    if "sRGB" in chunks:
        return SRGB
    if len(chunks.get("gAMA", b"")) == 4:
        (gamma,) = struct.unpack(">I", chunks["gAMA"])
        if gamma == 0:
            raise ValueError(f"{path} states a gamma of zero, which means nothing: give encoding.")
        return power_law(1e5 / gamma, "chunk gAMA")
    return None


def _png_chunks(path: Path) -> dict[str, bytes]:
    """The chunks before the pixels of a PNG, without long texts; empty for other files."""
    found: dict[str, bytes] = {}
    with open(path, "rb") as file:
        if file.read(8) != b"\x89PNG\r\n\x1a\n":
            return found
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if kind == b"IDAT":
                break
            if length <= (_MOST_PROFILE if kind == b"iCCP" else 64):
                found[kind.decode("latin-1")] = file.read(length)
                file.seek(4, 1)
            else:
                file.seek(length + 4, 1)
    return found


def _unpacked(chunk: bytes) -> bytes:
    """The profile of an iCCP chunk: a name, a zero, the method, and what is compressed."""
    try:
        return zlib.decompressobj().decompress(chunk.partition(b"\0")[2][1:], _MOST_PROFILE)
    except zlib.error:
        return b""


def _coding_independent(path: Path, chunk: bytes) -> Encoding:
    """Transfer function of a cICP chunk, by the numbers of ITU-T H.273."""
    number = chunk[1] if len(chunk) == 4 else -1
    if number == 8:
        return LINEAR
    if number == 13:
        return SRGB
    raise ValueError(
        f"{path} states transfer function {number} of ITU-T H.273 (chunk cICP), which is not "
        'read: export it linear or as sRGB, or give encoding="linear" or "sRGB".'
    )


def _profile_encoding(path: Path, profile: bytes) -> Encoding:
    """The tone curves of an ICC profile (ICC.1:2022, 10.6 and 10.18)."""
    try:
        (count,) = struct.unpack_from(">I", profile, 128)
        tags = [struct.unpack_from(">4sII", profile, 132 + 12 * i) for i in range(min(count, 200))]
        places = {name: profile[start : start + size] for name, start, size in tags}
        curves = [_tone_curve(places[name]) for name in (b"rTRC", b"gTRC", b"bTRC")]
    except (struct.error, KeyError, ValueError, IndexError, ZeroDivisionError):
        raise ValueError(
            f"{path} carries an ICC profile without tone curves that can be read: export it with "
            'a matrix profile, or give encoding="linear" or "sRGB".'
        ) from None
    at = np.linspace(0.0, 1.0, 257)
    seen = [curve(at) for curve in curves]
    if all(np.max(np.abs(one - at)) < 0.002 for one in seen):
        return Encoding("linear (ICC profile)", True, _unchanged)
    if all(np.max(np.abs(one - _srgb(at))) < 0.002 for one in seen):
        return Encoding("the sRGB curve (ICC profile)", False, _srgb)

    def decode(values: np.ndarray) -> np.ndarray:
        planes = np.moveaxis(values, -1, 0)
        return np.stack([curve(v) for curve, v in zip(curves, planes, strict=True)], axis=-1)

    return Encoding("the tone curve of its ICC profile", False, decode)


def _tone_curve(tag: bytes) -> Callable[[np.ndarray], np.ndarray]:
    """A curve from values to light, both 0-1."""
    kind = tag[:4]
    if kind == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count == 0:
            return _unchanged
        if count == 1:
            exponent = struct.unpack_from(">H", tag, 12)[0] / 256.0
            return lambda v: np.maximum(v, 0.0) ** exponent
        table = np.frombuffer(tag, dtype=">u2", count=count, offset=12) / 65535.0
        at = np.linspace(0.0, 1.0, count)
        return lambda v: np.interp(v, at, table)
    if kind != b"para":
        raise ValueError
    (form,) = struct.unpack_from(">H", tag, 8)
    number = (1, 3, 4, 5, 7)[form]
    g, *rest = (p / 65536.0 for p in struct.unpack_from(f">{number}i", tag, 12))
    a, b, c, d, e, f = (*rest, *(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)[len(rest) :])
    if form in (1, 2):  # constant below the zero of a v + b; form 2 adds its c everywhere
        c, d, e, f = 0.0, -b / a, c, c
    return lambda v: np.where(v >= d, np.maximum(a * v + b, 0.0) ** g + e, c * v + f)
