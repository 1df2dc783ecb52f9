"""Csv files with a header of `# key: value` lines."""

import csv
import dataclasses
import difflib
import fnmatch
import re
from pathlib import Path

import numpy as np

# How programs write that there is no value.
_MISSING = ("", "na", "n/a", "#n/a", "nan", "null", "none", "-", "--", "missing")


@dataclasses.dataclass(frozen=True)
class Sheet:
    """A csv file: header lines by key, column names, rows of text."""

    path: Path
    header: dict[str, str]
    columns: list[str]
    rows: list[list[str]]
    comments: tuple[str, ...] = ()

    def numbers(self, column: str) -> np.ndarray:
        """A column as floats; blanks and NA are NaN, other text is an error naming the row."""
        index = self.columns.index(column)
        values = []
        for line, row in enumerate(self.rows, start=1):
            text = row[index].strip()
            try:
                values.append(np.nan if text.lower() in _MISSING else float(text))
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
    """Read a table of text; ValueError says what is wrong and where.

    Commas, semicolons or tabs between cells, told by the line of column names; decimal commas
    where cells are parted otherwise.  Comments: lines that begin with # or // (ODV), what stands
    between /* and */ (PANGAEA), and a block from "Start of Header" to "End of Header" (C-OPS).
    UTF-8, UTF-16 with its mark, or Latin-1.
    """
    path = Path(path)
    lines, comments = _without_comments(_decoded(path))
    header = {}
    for line in comments:
        key, _, value = line.partition(":")
        header[key.strip()] = value.strip()
    if len(lines) < 2:
        raise ValueError(f"{path} holds no data: a row of column names and rows of values wanted.")
    delimiter = max("\t;,", key=lambda mark: re.sub(r'"[^"]*"', "", lines[0]).count(mark))
    table = list(csv.reader(lines, delimiter=delimiter))
    columns = [name.strip() for name in table[0]]
    while columns and not columns[-1]:
        columns.pop()  # a delimiter at the end of each line
    rows = []
    for number, row in enumerate(table[1:], start=1):
        cells = row[: len(columns)] if not any(map(str.strip, row[len(columns) :])) else row
        if len(cells) != len(columns):
            decimal = len(cells) > len(columns) and delimiter == ","
            raise ValueError(
                f"{path}: data row {number} has {len(cells)} values for {len(columns)} columns."
                + (" Decimal commas need ; or tabs between the values." if decimal else "")
            )
        rows.append(cells)
    if delimiter != ",":
        rows = [[_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in row] for row in rows]
    return Sheet(path, header, columns, rows, tuple(comments))


_DECIMAL_COMMA = re.compile(r"^(\s*[-+]?\d*),(\d+(?:[eE][-+]?\d+)?\s*)$")


def _decoded(path: Path) -> list[str]:
    raw = path.read_bytes()
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            return raw.decode("utf-16").splitlines()
        except UnicodeDecodeError as error:
            raise ValueError(
                f"{path} is not text (UTF-16 by its mark, byte {error.start})."
            ) from None
    if b"\x00" in raw:
        raise ValueError(
            f"{path} holds NUL bytes: it is not a text file, or was cut while written."
        )
    try:
        return raw.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        # Latin-1 reads anything: what holds control characters is no text.
        if any(byte < 32 and byte not in b"\t\n\r\f\x1a" for byte in raw):
            raise ValueError(f"{path} is not text (byte {error.start}).") from None
        return raw.decode("latin-1").splitlines()


def _without_comments(lines: list[str]) -> tuple[list[str], list[str]]:
    """Lines of the table, and comments without their marks."""
    table, comments, until = [], [], None
    for line in lines:
        plain = line.strip()
        if until is None and plain.startswith("/*"):
            until = "*/"
        elif until is None and plain.lower() == "start of header":
            until = "end of header"
        if until is not None:
            comments.append(plain.removeprefix("/*").removesuffix("*/").strip())
            until = None if until in plain.lower() else until
        elif plain.startswith(("#", "//")):
            comments.append(plain.lstrip("#/").strip())
        elif plain:
            table.append(line)
    return table, comments


def header_number(sheet: Sheet, key: str, value: float | None, default: float | None):
    """The caller's value, else the header's, else the default."""
    if value is not None or key not in sheet.header:
        return default if value is None else value
    text = sheet.header[key]
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"header {key!r} is {text!r}, not a number.") from None
