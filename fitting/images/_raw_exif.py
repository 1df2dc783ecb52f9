"""EXIF tags of raw files, read from their TIFF directories."""

import struct
from pathlib import Path
from typing import Any, BinaryIO

# Tag numbers of TIFF 6.0 and EXIF 2.3.
_NAMES = {
    0x010F: "Make",
    0x0110: "Model",
    0x0132: "DateTime",
    0x829A: "ExposureTime",
    0x829D: "FNumber",
    0x8827: "ISO",
    0x9209: "Flash",
    0xA405: "FocalLengthIn35mmFilm",
}
_EXIF_DIRECTORY = 0x8769
_FORMATS = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II"}


def raw_exif(path: str | Path) -> dict[str, Any]:
    """Make, model, date, exposure time (s), f-number, ISO, flash word and focal length as if on
    35 mm film (mm) of a raw file.

    Most raw formats are TIFF files: NEF, CR2, ARW, DNG, PEF and SRW; ORF and RW2 are, too, but for
    their magic number.  Tags that are missing or damaged, and all tags of other formats, are left
    out.
    """
    found: dict[str, Any] = {}
    with open(path, "rb") as file:
        order = {b"II": "<", b"MM": ">"}.get(file.read(2))
        if order is None:
            return found
        try:
            (start,) = struct.unpack(order + "2xI", file.read(6))
            _directory(file, order, start, found)
            inner = found.pop("directory", None)
            if inner is not None:
                _directory(file, order, inner, found)
                found.pop("directory", None)
        except (struct.error, OverflowError):
            pass
    return found


def _directory(file: BinaryIO, order: str, start: int, found: dict[str, Any]) -> None:
    file.seek(start)
    (count,) = struct.unpack(order + "H", file.read(2))
    entries = file.read(12 * count)
    for at in range(0, 12 * count, 12):
        tag, kind, number = struct.unpack_from(order + "HHI", entries, at)
        name = "directory" if tag == _EXIF_DIRECTORY else _NAMES.get(tag)
        if name is None or kind not in _FORMATS or number > 1000:
            continue
        size = struct.calcsize(order + _FORMATS[kind]) * number
        raw = entries[at + 8 : at + 12]
        if size > 4:
            file.seek(struct.unpack(order + "I", raw)[0])
            raw = file.read(size)
        if kind == 2:
            found[name] = raw[:size].split(b"\0")[0].decode("latin-1").strip()
        elif kind == 5:
            top, bottom = struct.unpack_from(order + "II", raw)
            if bottom:
                found[name] = top / bottom
        else:
            found[name] = struct.unpack_from(order + _FORMATS[kind], raw)[0]
