"""SeaBASS files: a header of /key=value lines, then rows of fields."""

import dataclasses
import re
from pathlib import Path

import numpy as np

_CLOCK = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:\.\d+)?)")
_DELIMITERS = {"comma": ",", "tab": "\t", "space": None}


@dataclasses.dataclass(frozen=True)
class Seabass:
    """One file: header by key, field names in lower case, their units, columns of numbers.

    Missing values and values beyond the detection limits are NaN; `counts` says how many of each
    kind there were.
    """

    path: Path
    header: dict[str, str]
    units: dict[str, str]
    columns: dict[str, np.ndarray]
    counts: dict[str, int]

    def degrees(self, *keys: str) -> float | None:
        """Mean of the header's coordinates, which look like 6.036[DEG]; None if absent."""
        found = [re.match(r"\s*([-+.\d]+)\s*\[deg\]", self.header.get(k, ""), re.I) for k in keys]
        numbers = [float(f.group(1)) for f in found if f]
        return float(np.mean(numbers)) if numbers else None

    @property
    def began(self) -> str | None:
        """Date and time (UTC, ISO 8601) at which the header says that measuring began."""
        date = re.fullmatch(r"(\d{4})(\d{2})(\d{2})", self.header.get("start_date", ""))
        if date is None:
            return None
        clock = re.match(r"\d{2}:\d{2}:\d{2}(?=\[GMT\])", self.header.get("start_time", ""), re.I)
        return "-".join(date.groups()) + (f"T{clock[0]}Z" if clock else "")


def is_seabass(head: bytes) -> bool:
    """Whether a file that starts like this is a SeaBASS file."""
    return head.lstrip(b"\xef\xbb\xbf \r\n").lower().startswith(b"/begin_header")


def _header(path: Path, lines: list[str]) -> tuple[dict[str, str], int]:
    header = {}
    for number, line in enumerate(lines):
        text = line.strip()
        if text.lower().startswith("/end_header"):
            return header, number + 1
        if text.startswith("/") and "=" in text and not text.startswith("/!"):
            key, _, value = text[1:].partition("=")
            header[key.strip().lower()] = value.strip()
    raise ValueError(f"{path}: the SeaBASS header never ends; a line /end_header is wanted.")


def read_seabass(path: str | Path) -> Seabass:
    """Parse a SeaBASS file (.sb, .txt); ValueError says what is wrong and where."""
    path = Path(path)
    raw = path.read_bytes()
    if b"\x00" in raw:
        raise ValueError(f"{path} holds NUL bytes: it was cut or damaged while written.")
    lines = raw.decode("utf-8", errors="replace").splitlines()
    header, start = _header(path, lines)
    for key in ("fields", "units", "delimiter"):
        if key not in header:
            raise ValueError(f"{path}: the SeaBASS header lacks /{key}=.")
    kind = header["delimiter"].lower()
    if kind not in _DELIMITERS:
        raise ValueError(f"{path}: /delimiter={kind}; comma, space or tab is wanted.")
    fields = [name.strip().lower() for name in header["fields"].rstrip(", ").split(",")]
    units = [unit.strip() for unit in header["units"].rstrip(", ").split(",")]
    # Lists of different lengths say nothing about any one column: then no unit is stated.
    stated = dict(zip(fields, units, strict=True)) if len(fields) == len(units) else {}
    rows = []
    for number, line in enumerate(lines[start:], start=start + 1):
        if not line.strip() or line.startswith(("!", "#")):
            continue
        row = line.split(_DELIMITERS[kind])
        if len(row) != len(fields):
            raise ValueError(
                f"{path}: line {number} has {len(row)} values for {len(fields)} fields."
            )
        rows.append(row)
    if not rows:
        raise ValueError(f"{path} holds no data below its header.")
    codes = _codes(path, header)
    counts = dict.fromkeys(codes, 0)
    columns = {}
    for name, texts in zip(fields, zip(*rows, strict=True), strict=True):
        values = _numbers(texts)
        for code, number in codes.items():
            hit = values == number
            counts[code] += int(hit.sum())
            values = np.where(hit, np.nan, values)
        columns[name] = values
    named = {code: count for code, count in counts.items() if count}
    return Seabass(path, header, stated, columns, named)


def _codes(path: Path, header: dict[str, str]) -> dict[str, float]:
    codes = {"missing": "missing", "below_detection_limit": "below detection limit"}
    codes |= {"above_detection_limit": "above detection limit"}
    found = {}
    for key, label in codes.items():
        if key in header:
            try:
                found[label] = float(header[key])
            except ValueError:
                raise ValueError(f"{path}: /{key}={header[key]} is not a number.") from None
    return found


def _numbers(texts) -> np.ndarray:
    """A column as numbers, times of day in seconds; other text becomes NaN."""
    try:
        return np.array(texts, dtype=np.float64)
    except ValueError:
        values = np.full(len(texts), np.nan)
        for i, text in enumerate(texts):
            clock = _CLOCK.fullmatch(text.strip())
            if clock:
                hours, minutes, seconds = map(float, clock.groups())
                values[i] = 3600.0 * hours + 60.0 * minutes + seconds
                continue
            try:
                values[i] = float(text)
            except ValueError:
                continue
        return values


def seabass_text(fields, units, rows, header: dict[str, str], comments=()) -> str:
    """SeaBASS text of columns `rows` (row, field); -9999 stands for missing."""
    lines = ["/begin_header", *(f"/{key}={value}" for key, value in header.items())]
    lines += ["/missing=-9999", "/delimiter=comma"]
    lines += [f"! {comment}" for comment in comments]
    lines += [f"/fields={','.join(fields)}", f"/units={','.join(units)}", "/end_header"]
    for row in np.asarray(rows, dtype=np.float64):
        lines.append(",".join("-9999" if not np.isfinite(v) else f"{v:.8g}" for v in row))
    return "\n".join(lines) + "\n"
