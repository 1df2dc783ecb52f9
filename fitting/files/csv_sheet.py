"""Csv files with a header of `# key: value` lines."""

import csv
import dataclasses
import difflib
import fnmatch
from pathlib import Path

import numpy as np


@dataclasses.dataclass(frozen=True)
class Sheet:
    """A csv file: header lines by key, column names, rows of text."""

    path: Path
    header: dict[str, str]
    columns: list[str]
    rows: list[list[str]]
    comments: tuple[str, ...] = ()

    def numbers(self, column: str) -> np.ndarray:
        """A column as floats; blanks are NaN, other text is an error naming the row."""
        index = self.columns.index(column)
        values = []
        for line, row in enumerate(self.rows, start=1):
            text = row[index].strip()
            try:
                values.append(float(text) if text else np.nan)
            except ValueError:
                raise ValueError(
                    f"{self.path}: column {column!r}, data row {line}: {text!r} is not a number."
                ) from None
        return np.asarray(values)

    def texts(self, column: str) -> list[str]:
        """A column as text."""
        index = self.columns.index(column)
        return [row[index].strip() for row in self.rows]

    def require(self, *columns: str) -> None:
        """ValueError that names the missing columns and what is there instead."""
        missing = [name for name in columns if name not in self.columns]
        if missing:
            near = difflib.get_close_matches(missing[0], self.columns, n=3, cutoff=0.5)
            hint = f" Near it: {', '.join(near)}." if near else ""
            raise ValueError(
                f"{self.path}: column {', '.join(map(repr, missing))} is missing; the file has "
                f"{', '.join(self.columns)}.{hint}"
            )

    def stated_unit(self, column: str) -> str | None:
        """Unit of a column from the `# units:` line, None when it is not stated."""
        for pair in self.header.get("units", "").split(","):
            pattern, _, unit = pair.strip().partition("=")
            if unit and fnmatch.fnmatchcase(column, pattern):
                return unit
        return None

    def unit(self, column: str) -> str:
        """Unit of a column from the `# units:` line; ValueError when it is not stated."""
        unit = self.stated_unit(column)
        if unit is not None:
            return unit
        raise ValueError(
            f"{self.path}: the unit of column {column!r} is not stated; write a header line such "
            f"as '# units: {column}=...'."
        )


def read_sheet(path: str | Path) -> Sheet:
    """Read a csv file with comment header; ValueError says what is wrong and where."""
    path = Path(path)
    raw = path.read_bytes()
    if b"\x00" in raw:
        raise ValueError(
            f"{path} holds NUL bytes: it is not a text file, or was cut while written."
        )
    try:
        lines = raw.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 text (byte {error.start}).") from None
    header = {}
    for line in lines:
        if line.startswith("#"):
            key, _, value = line[1:].partition(":")
            header[key.strip()] = value.strip()
    table = list(csv.reader(line for line in lines if line.strip() and not line.startswith("#")))
    if len(table) < 2:
        raise ValueError(f"{path} holds no data: a row of column names and rows of values wanted.")
    columns = [name.strip() for name in table[0]]
    for number, row in enumerate(table[1:], start=1):
        if len(row) != len(columns):
            raise ValueError(
                f"{path}: data row {number} has {len(row)} values for {len(columns)} columns."
            )
    comments = tuple(line[1:].strip() for line in lines if line.startswith("#"))
    return Sheet(path, header, columns, table[1:], comments)


def header_number(sheet: Sheet, key: str, value: float | None, default: float | None):
    """The caller's value, else the header's, else the default."""
    if value is not None or key not in sheet.header:
        return default if value is None else value
    text = sheet.header[key]
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"header {key!r} is {text!r}, not a number.") from None
