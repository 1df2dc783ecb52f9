"""Checked reading of toml tables: every error names the file, the key, the value and what fits."""

import csv
import difflib
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from oceaninv.foundation.colmap_file import read_depth
from oceaninv.foundation.image_file import read_image, read_numpy

_MISSING = object()
# Largest picture of a scene, pixels: three channels of it in float64 take 0.6 GB.
_MOST_PIXELS = 25_000_000


class Section:
    """One table of a toml file.  `finish` refuses keys that were not read.

    `files`: what the whole file has named so far, itself first; tables within share the list.
    """

    def __init__(
        self, path: Path, name: str, table: dict[str, Any], files: list[Path] | None = None
    ):
        self.path, self.name, self._table = path, name, table
        self.files = [path] if files is None else files
        self._asked: list[str] = []

    def error(self, key: str, came: Any, wanted: str) -> ValueError:
        """An error that states the file, the key, the value and what is allowed."""
        where = f"{self.name}.{key}" if self.name else key
        return ValueError(f"{self.path}: {where} is {came!r}; it must be {wanted}.")

    def has(self, key: str) -> bool:
        """Whether the key is there."""
        self._asked.append(key)
        return key in self._table

    def take(self, key: str, wanted: str, default: Any = _MISSING) -> Any:
        """The raw value of a key."""
        if not self.has(key):
            if default is _MISSING:
                where = f"{self.name}.{key}" if self.name else key
                raise ValueError(f"{self.path}: {where} is missing; it must be {wanted}.")
            return default
        return self._table[key]

    def number(self, key: str, low: float, high: float, default: Any = _MISSING) -> Any:
        """A number within [low, high]."""
        wanted = f"a number of at least {low:g}" + (f" and at most {high:g}" if high < 1e30 else "")
        value = self.take(key, wanted, default)
        if value is default:
            return value
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.error(key, value, wanted)
        if not low <= value <= high:
            raise self.error(key, value, wanted)
        return float(value)

    def integer(self, key: str, low: int, high: int, default: Any = _MISSING) -> Any:
        """A whole number within [low, high]."""
        wanted = f"a whole number between {low} and {high}"
        value = self.take(key, wanted, default)
        if value is default:
            return value
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.error(key, value, wanted)
        return value

    def flag(self, key: str, default: bool = False) -> bool:
        """true or false."""
        value = self.take(key, "true or false", default)
        if not isinstance(value, bool):
            raise self.error(key, value, "true or false")
        return value

    def text(self, key: str, allowed: Iterable[str] | None = None, default: Any = _MISSING) -> Any:
        """Text, one of `allowed` when given."""
        choices = None if allowed is None else list(allowed)
        wanted = "text" if choices is None else "one of " + ", ".join(choices)
        value = self.take(key, wanted, default)
        if value is default:
            return value
        if not isinstance(value, str):
            raise self.error(key, value, wanted)
        if choices is not None and value not in choices:
            near = difflib.get_close_matches(value, choices, n=1, cutoff=0.4)
            raise self.error(key, value, wanted + (f" (near it: {near[0]})" if near else ""))
        return value

    def vector(self, key: str, default: Any = _MISSING) -> Any:
        """Three numbers."""
        wanted = "three numbers"
        value = self.take(key, wanted, default)
        if value is default:
            return value
        numbers = isinstance(value, list) and all(
            isinstance(x, (int, float)) and not isinstance(x, bool) for x in value
        )
        if not numbers or len(value) != 3 or not np.all(np.isfinite(value)):
            raise self.error(key, value, wanted)
        return np.asarray(value, dtype=float)

    def file(self, key: str) -> Path:
        """An existing file, relative to the toml file."""
        path = self.path.parent / self.text(key)
        if not path.is_file():
            raise self.error(key, self.text(key), f"a file; {path} does not exist")
        self.files.append(path)
        return path

    def section(self, key: str) -> "Section":
        """A table inside this one."""
        value = self.take(key, "a table", {})
        if not isinstance(value, dict):
            raise self.error(key, value, f"a table, as [{key}]")
        return Section(self.path, f"{self.name}.{key}" if self.name else key, value, self.files)

    def sections(self, key: str) -> "list[Section]":
        """The tables of an array [[key]]."""
        value = self.take(key, "an array of tables", [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.error(key, value, f"an array of tables, each as [[{key}]]")
        name = f"{self.name}.{key}" if self.name else key
        return [
            Section(self.path, f"{name}[{i}]", item, self.files) for i, item in enumerate(value)
        ]

    def finish(self) -> None:
        """ValueError for a key that means nothing, with the near one."""
        for key in self._table:
            if key not in self._asked:
                near = difflib.get_close_matches(key, self._asked, n=1, cutoff=0.5)
                hint = f" Did you mean {near[0]}?" if near else ""
                known = ", ".join(sorted(set(self._asked)))
                where = f"{self.name}.{key}" if self.name else key
                raise ValueError(
                    f"{self.path}: {where} means nothing here.{hint} Allowed: {known}."
                )


def read(path: str | Path) -> Section:
    """A toml file as its outermost section."""
    path = Path(path)
    try:
        return Section(path, "", tomllib.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not a toml file: {error}.") from None


def spectra(path: Path, wavelength: np.ndarray, *columns: str) -> list[np.ndarray]:
    """Columns of a csv file (`wavelength_nm` and others; # begins a comment), interpolated.

    ValueError when a column is missing, a cell is no number or the file does not cover the
    wavelengths.
    """
    names, rows = numbers(path)
    for column in ("wavelength_nm", *columns):
        if column not in names:
            raise ValueError(f"{path}: column {column} is missing; it has {', '.join(names)}.")
    grid = rows[names.index("wavelength_nm")]
    if grid.size < 2 or np.any(np.diff(grid) <= 0):
        raise ValueError(f"{path}: wavelength_nm must increase from row to row, two rows or more.")
    if wavelength[0] < grid[0] or wavelength[-1] > grid[-1]:
        raise ValueError(
            f"{path} covers {grid[0]:g}-{grid[-1]:g} nm, but the bands reach from "
            f"{wavelength[0]:g} to {wavelength[-1]:g} nm."
        )
    return [np.interp(wavelength, grid, rows[names.index(column)]) for column in columns]


def numbers(path: Path) -> tuple[list[str], np.ndarray]:
    """Column names and columns of a csv file of numbers."""
    lines = path.read_text(encoding="utf-8").splitlines()
    table = list(csv.reader(line for line in lines if line.strip() and not line.startswith("#")))
    if len(table) < 2:
        raise ValueError(f"{path} holds no rows under its header.")
    names = [name.strip() for name in table[0]]
    try:
        rows = np.array([[float(cell) for cell in row] for row in table[1:]]).T
    except ValueError as error:
        raise ValueError(
            f"{path}: every cell under the header must be a number ({error})."
        ) from None
    if rows.shape[0] != len(names) or not np.all(np.isfinite(rows)):
        raise ValueError(f"{path}: every row must hold {len(names)} finite numbers.")
    return names, rows


def grid(path: Path) -> np.ndarray:
    """A csv file of nothing but numbers, row by row."""
    try:
        return np.loadtxt(path, delimiter=",", comments="#", ndmin=2)
    except ValueError as error:
        raise ValueError(f"{path} must hold rows of as many numbers each: {error}.") from None


def picture(path: Path) -> np.ndarray:
    """A picture, (row, column, channel): .npy, an .npz of one array, or what OpenImageIO reads
    (integers as shares of the largest; NaN where an EXR has no data).

    ValueError for what is no picture and, before it is decoded, for one of more than 25 megapixels.
    """
    if path.suffix.lower() in (".npy", ".npz"):
        pixels = read_numpy(path, 3 * _MOST_PIXELS)
        pixels = pixels[:, :, None] if pixels.ndim == 2 else pixels
    else:
        pixels = np.asarray(read_image(path, _MOST_PIXELS).values, dtype=float)
    if pixels.ndim != 3:
        raise ValueError(f"{path} must be (row, column) or (row, column, channel) numbers.")
    return pixels


def depths(path: Path) -> tuple[np.ndarray, float | None]:
    """The pixels of a map of depths, (row, column, channel), and the metres of a unit: 1 of floats,
    0.001 of 16-bit integers, `None` of COLMAP's maps (.bin).

    ValueError as of `picture`, and for integers of other than 16 bits.
    """
    if path.suffix.lower() == ".bin":
        return read_depth(path, _MOST_PIXELS).astype(float)[:, :, None], None
    if path.suffix.lower() in (".npy", ".npz"):
        return picture(path), 1.0
    image = read_image(path, _MOST_PIXELS)
    if image.largest not in (None, 65535):
        raise ValueError(
            f"{path} has integers up to {image.largest}: a range map needs float metres or 16-bit "
            "mm."
        )
    pixels = np.asarray(image.values, dtype=float)
    return (pixels, 1.0) if image.largest is None else (np.round(65535.0 * pixels), 0.001)
