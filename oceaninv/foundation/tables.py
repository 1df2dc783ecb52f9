"""Published tables: small csv files with a citation, units and a range, and their one loader."""

import dataclasses
import difflib
import fnmatch
import functools
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax.core
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

# Anything that numpy accepts; `check_wavelength` refuses bad values.
Wavelengths = ArrayLike | Sequence[Any] | float | int

_DATA = Path(__file__).parents[1] / "data"
_HEADER = ("title", "citation", "units", "range", "note")


def unknown(kind: str, name: str, known: Iterable[str]) -> ValueError:
    """The error for an unknown name: it lists similar names, then all names."""
    known = sorted(known)
    # Names are compared without case and punctuation, so that "pope fry" finds "PopeFry1997".
    plain = {re.sub(r"\W", "", entry).lower(): entry for entry in known}
    wanted = re.sub(r"\W", "", name).lower()
    near = [plain[entry] for entry in difflib.get_close_matches(wanted, plain, cutoff=0.5)]
    near += [
        entry for key, entry in plain.items() if wanted and wanted in key and entry not in near
    ]
    hint = f" Near it: {', '.join(near)}." if near else ""
    return ValueError(f"{kind} {name!r} is unknown.{hint} Known: {', '.join(known)}.")


def check_wavelength(wavelength: Wavelengths) -> Float[np.ndarray, " wl"]:
    """Wavelengths as a concrete float64 vector.

    **Arguments:** `wavelength`: vacuum wavelengths in nm, one-dimensional, not empty, finite,
    positive, strictly increasing, and known outside jit.

    **Raises:** `ValueError`, one sentence for each of these that does not hold.

    >>> check_wavelength([400, 550, 700])
    array([400., 550., 700.])
    """
    if isinstance(wavelength, jax.core.Tracer):
        raise ValueError(
            "wavelength must be concrete numbers, but a traced JAX array came: pass a numpy array"
            " made outside jit, vmap and grad."
        )
    array = np.asarray(wavelength)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"wavelength must hold real numbers in nm, but came as {array.dtype}.")
    array = array.astype(np.float64)
    if array.ndim != 1:
        raise ValueError(
            f"wavelength must be one-dimensional, but came with shape {array.shape};"
            " write [550.0] for a single one."
        )
    if array.size == 0:
        raise ValueError("wavelength must hold at least one value, but came empty.")
    if not np.all(np.isfinite(array)):
        raise ValueError(
            f"wavelength must be finite, but holds {array[~np.isfinite(array)][0]}"
            f" at position {np.flatnonzero(~np.isfinite(array))[0]}."
        )
    if np.any(array <= 0):
        raise ValueError(f"wavelength must be positive (nm), but holds {array[array <= 0][0]:g}.")
    if np.any(np.diff(array) <= 0):
        i = int(np.argmax(np.diff(array) <= 0))
        raise ValueError(
            "wavelength must be strictly increasing, but"
            f" {array[i + 1]:g} nm follows {array[i]:g} nm."
        )
    return array


@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """A published table.

    **Attributes:**

    - `name`, `title`, `citation`, `range`, `note`: text; `range` in nm (or degrees).
    - `units`: unit of each column, `wavelength` (nm) included.
    - `wavelength`: nm, strictly increasing; empty when the table runs over something else,
      which is then an ordinary column (`angle` of `Petzold1972`).
    - `columns`: name -> values, read-only float64; a blank of the publication is NaN.
    """

    name: str
    title: str
    citation: str
    units: dict[str, str]
    range: str
    note: str
    wavelength: Float[np.ndarray, " wl"]
    columns: dict[str, np.ndarray]

    def column(self, name: str) -> np.ndarray:
        """One column as it stands; `ValueError` with the near names when there is none."""
        if name not in self.columns:
            raise unknown(f"Column of table {self.name}", name, self.columns)
        return self.columns[name]

    def at(self, wavelength: Wavelengths, column: str) -> Float[np.ndarray, " wl"]:
        """A column interpolated linearly to `wavelength` (nm), never extrapolated.

        **Raises:** `ValueError` for an unknown column, for a wavelength outside the table and
        for one whose neighbours in the table are blank.

        >>> load("PopeFry1997").at([500.0, 550.0], "a")
        array([0.0204, 0.0565])
        """
        values = self.column(column)
        if self.wavelength.size == 0:
            raise ValueError(f"Table {self.name} does not run over wavelength; use .columns.")
        wavelength = check_wavelength(wavelength)
        low, high = self.wavelength[0], self.wavelength[-1]
        out = (wavelength < low) | (wavelength > high)
        if np.any(out):
            raise ValueError(
                f"Table {self.name} covers {low:g}-{high:g} nm,"
                f" but {wavelength[out][0]:g} nm was asked for."
            )
        i = np.clip(np.searchsorted(self.wavelength, wavelength, "right") - 1, 0, None)
        j = np.minimum(i + 1, self.wavelength.size - 1)
        step = np.where(i == j, 1.0, self.wavelength[j] - self.wavelength[i])
        t = (wavelength - self.wavelength[i]) / step
        # A blank neighbour with no weight does no harm: at a node only that node counts.
        result = np.where(t == 0, values[i], (1 - t) * values[i] + t * values[j])
        if np.any(np.isnan(result)):
            raise ValueError(
                f"Table {self.name} has no value of {column!r} at"
                f" {wavelength[np.isnan(result)][0]:g} nm: the publication leaves it blank."
            )
        return result


def names() -> tuple[str, ...]:
    """Names of the tables, in alphabetical order."""
    return tuple(sorted(path.stem for path in _DATA.glob("*.csv")))


@functools.cache
def load(name: str) -> Table:
    """A table by its author-year name; read once, then shared.

    **Raises:** `ValueError` that lists near names when there is no such table.

    >>> load("MorelMaritorena2001").units["Kw"]
    '1/m'
    """
    if name not in names():
        raise unknown("Table", name, names())
    lines = (_DATA / f"{name}.csv").read_text(encoding="utf-8").splitlines()
    comments = [line[1:].split(":", 1) for line in lines if line.startswith("#")]
    header = {key.strip(): value.strip() for key, value in comments}
    first, *rest = [line.split(",") for line in lines if not line.startswith("#")]
    numbers = np.array([[float(cell or "nan") for cell in row] for row in rest]).T.copy()
    numbers.setflags(write=False)
    columns = dict(zip(first, numbers, strict=True))
    wavelength = columns.pop("wavelength", np.empty(0))
    title, citation, units, extent, note = (header[key] for key in _HEADER)
    return Table(name, title, citation, _units(units, first), extent, note, wavelength, columns)


def _units(text: str, columns: list[str]) -> dict[str, str]:
    """Unit of each column from `pattern=unit` pairs, the first pattern that fits."""
    pairs = [pair.strip().split("=", 1) for pair in text.split(",")]
    return {
        column: next(unit for pattern, unit in pairs if fnmatch.fnmatchcase(column, pattern))
        for column in columns
    }
