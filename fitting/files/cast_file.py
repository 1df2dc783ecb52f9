"""Casts from files: csv of several makes, SeaBASS, BGC-Argo and plain netCDF, told by content."""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fitting.files import cast_netcdf, seabass
from fitting.files.csv_sheet import Sheet, header_number, read_sheet
from fitting.files.irradiance_units import (
    depth_kind,
    irradiance_factor,
    irradiance_units_in,
    par_factor,
)
from fitting.files.raw_cast import RawCast
from fitting.observations.profile import Profile

_IRRADIANCE = re.compile(
    r"(?i)(?P<kind>ed0|es|edz|ed|euz|eu|luz|lu|down_irradiance)[_ ]?\(?"
    r"(?P<nm>\d{3,4}(?:\.\d+)?)\)?$"
)
_KINDS = {"es": "surface", "ed0": "surface", "edz": "Ed", "ed": "Ed", "down_irradiance": "Ed"}
_KINDS |= {"euz": "Eu", "eu": "Eu", "luz": "Lu", "lu": "Lu"}
# Without pure water's, as SeaBASS names them (gelbstoff and particles).
_BEAM = re.compile(r"(?i)(?P<kind>[ac])gp[_ ]?\(?(?P<nm>\d{3}(?:\.\d+)?)\)?$")
_PER_METRE = ("1/m", "m-1", "m^-1", "/m", "m**-1")
_DEPTH = re.compile(r"(?i)(?:edz_?)?(depth|pres|pressure)(?: water)?(?:_(m|dbar))?$")
# PAR on the way down; that above the water (EsPAR, PAR_air, Ed0PAR) is no profile.
_PAR = re.compile(r"(?i)(?:edz?_?|down(?:welling)?_?)?par(?:_?(?:ed|z|water))?$")
_TIME = re.compile(r"(?i)(generalexceltime|date[ _]?time(?:[ _]?utc)?|date/time|time(?:stamp)?)$")
_BRACKET = re.compile(r"(.*?)\s*[\[(]([^\])\d][^\]]*)[\])]$")
# Argo's flags: 3 probably bad, 4 bad, 9 missing; 0 (no check yet), 1, 2, 5 and 8 are used.
_BAD_FLAGS = (3, 4, 9)
# W m-2 nm-1: twenty times the sun above the atmosphere, more than waves can focus.
_IMPOSSIBLE = 50.0
# nm: sensors whose centres differ by less than half of their usual bandwidth of 10 nm see one band.
_HALF_BAND = 5.0
_SATCON = re.compile(r"(?i)\s*SN\t(?:INTTIME\((\w+)\)|\S+-(MPR|PRO)\b)")


@dataclasses.dataclass(frozen=True)
class Reading:
    """What a file may leave open, told by the reader's user.

    - `solar_zenith`: degrees in air; overrides the file's.
    - `units`: unit by column name, `{"Ed": "uW cm-2 nm-1"}` for all bands of a kind, where the
      file states none.
    - `columns`: the file's column by the name that is wanted here: `{"depth": "z"}`.
    - `depth_offset`: metres from the pressure sensor down to the sensor of Ed.
    - `upward_offset`: the same to the sensors of Eu and Lu; None: as `depth_offset`.
    - `tilt_limit`: degrees; samples tilted further are left out.
    """

    solar_zenith: float | None = None
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)
    columns: Mapping[str, str] = dataclasses.field(default_factory=dict)
    depth_offset: float = 0.0
    upward_offset: float | None = None
    tilt_limit: float | None = None


def raw_casts(path: str | Path, reading: Reading | None = None) -> list[RawCast]:
    """All casts in a file, unchecked; its content, not its name, says which reader is right."""
    path, reading = Path(path), reading or Reading()
    with open(path, "rb") as file:
        head = file.read(512)
    if cast_netcdf.is_netcdf(head):
        return cast_netcdf.read(path, reading.columns)
    if seabass.is_seabass(head):
        return [_from_seabass(seabass.read_seabass(path))]
    satcon = _SATCON.match(head.decode("latin-1"))
    if satcon:
        sensor = (satcon[1] or satcon[2]).upper()
        raise ValueError(
            f"{path} is a table of one sensor ({sensor}) as SatCon writes it: light stands in the "
            "files of the radiometers, depth in that of the profiler (MPR).  Write ProSoft's level "
            "2s as SeaBASS or csv, in which light and depth stand together, and fit that."
        )
    return _from_sheet(read_sheet(path), reading)


def read_casts(path: str | Path, reading: Reading | None = None) -> list[Profile]:
    """All casts in a file; ValueError at the first that cannot be used."""
    return [profile_of(raw, reading) for raw in raw_casts(path, reading)]


def read_cast(path: str | Path, reading: Reading | None = None) -> Profile:
    """The one cast in a file."""
    casts = raw_casts(path, reading)
    if len(casts) != 1:
        raise ValueError(
            f"{path} holds {len(casts)} casts ({casts[0].name} ...); fit them together with "
            "fit_profiles, or as an archive."
        )
    return profile_of(casts[0], reading)


def _from_seabass(file: seabass.Seabass) -> RawCast:
    columns = dict(file.columns)
    if "depth" not in columns and "measurement_depth" in file.header:
        raise ValueError(
            f"{file.path}: no depth column, one measurement_depth: this is not a profile."
        )
    return RawCast(
        str(file.path),
        columns,
        file.units,
        latitude=file.degrees("north_latitude", "south_latitude"),
        counts=file.counts,
        time=columns.get("time"),
        longitude=file.degrees("west_longitude", "east_longitude"),
        began=file.began,
    )


def _from_sheet(sheet: Sheet, reading: Reading) -> list[RawCast]:
    renamed = {theirs: ours for ours, theirs in reading.columns.items()}
    sheet.require(*renamed)
    columns, units, flags = {}, {}, {}
    for column in sheet.columns:
        name, unit = renamed.get(column, column), None
        bracket = _BRACKET.fullmatch(column)
        if bracket:
            unit = bracket[2]
            name = name if column in renamed else bracket[1]
        plain = name.removesuffix("_QC")
        if not (_known(plain) or "tilt" in name.lower() or name in ("depth_good",)):
            continue
        if plain != name:
            flags[plain] = sheet.numbers(column)
            continue
        if name in columns:
            # Two columns of one name: the second band is caught as not increasing.
            name = f"{name} "
        columns[name] = sheet.numbers(column)
        stated = unit or sheet.stated_unit(column) or sheet.stated_unit(name)
        if stated:
            units[name] = stated
    if not any(_DEPTH.fullmatch(name) for name in columns):
        sheet.require("depth")
    comment, time = "\n".join(sheet.comments), _times(sheet)
    try:
        zenith = header_number(sheet, "solar_zenith", reading.solar_zenith, None)
        latitude = header_number(sheet, "latitude", None, None)
    except ValueError as error:
        raise ValueError(f"{sheet.path}: {error}") from None

    def part(name: str, rows) -> RawCast:
        return RawCast(
            name,
            {k: v[rows] for k, v in columns.items()},
            units,
            {k: v[rows] for k, v in flags.items()},
            comment,
            latitude,
            zenith,
            time=None if time is None else time[rows],
        )

    by = next((c for c in ("cast", "Station") if c in sheet.columns), None)
    if by is None:
        return [part(str(sheet.path), slice(None))]
    names = sheet.texts(by)
    for row in range(1, len(names)):  # ODV names a station in its first row alone
        names[row] = names[row] or names[row - 1]
    names = np.array(names)
    return [part(f"{sheet.path}:{name}", names == name) for name in dict.fromkeys(names.tolist())]


def _times(sheet: Sheet) -> np.ndarray | None:
    """(row,) of a column of times, in any unit; None where there is none that can be read."""
    for column in sheet.columns:
        if _TIME.fullmatch(column):
            texts = sheet.texts(column)
            try:
                return np.array([float(text) for text in texts])
            except ValueError:
                pass
            try:
                found = np.array([text.rstrip("Z") for text in texts], dtype="datetime64[ms]")
                return found.astype(np.float64)
            except ValueError:
                continue
    return None


def _known(name: str) -> bool:
    return any(kind.fullmatch(name) for kind in (_IRRADIANCE, _DEPTH, _BEAM, _PAR))


def _downwards(depth: np.ndarray, counts: dict[str, int]) -> np.ndarray:
    """Depths positive downwards; a file that counts heights has hardly a positive one."""
    below = depth[np.isfinite(depth)]
    if len(below) and np.mean(below <= 0) > 0.9 and below.min() < -1.0:
        counts["depths given as negative, turned"] = len(below)
        return -depth
    return depth


def _depth(raw: RawCast, reading: Reading, counts: dict[str, int]) -> np.ndarray:
    """Metres, from a depth column or by the equation of state from a pressure."""
    for name, values in raw.columns.items():
        found = _DEPTH.fullmatch(name)
        if not found:
            continue
        stated = reading.units.get(name) or raw.units.get(name) or found.group(2)
        if stated is None:
            raise ValueError(
                f"{raw.name}: the unit of column {name!r} is not stated; write a header line such "
                f"as '# units: {name}=m', or name the column depth_m or pres_dbar."
            )
        kind = depth_kind(stated)
        pressure = found.group(1).lower().startswith("pres")
        if kind is None or (kind == "dbar") != pressure:
            wanted = "dbar" if pressure else "m"
            raise ValueError(f"{raw.name}: {name} must be in {wanted}, not {stated!r}.")
        return _metres(values, raw) if pressure else _downwards(values, counts)
    raise ValueError(
        f"{raw.name}: column 'depth' is missing; the file has {', '.join(raw.columns)}."
        f"{_near('depth', raw.columns)}"
    )


def _near(name: str, columns) -> str:
    import difflib

    near = difflib.get_close_matches(name, list(columns), n=3, cutoff=0.5)
    return f" Near it: {', '.join(near)}." if near else ""


def _metres(pressure: np.ndarray, raw: RawCast) -> np.ndarray:
    """TEOS-10 depth.  Without a latitude that of 45 degrees, right to 0.3 % anywhere."""
    try:
        import gsw
    except ImportError:
        raise ValueError(
            f"{raw.name}: depth from pressure needs the package gsw; install oceaninv[casts]."
        ) from None
    latitude = 45.0 if raw.latitude is None else raw.latitude
    return -np.asarray(gsw.z_from_p(pressure, latitude))


def _factor(raw: RawCast, name: str, kind: str, reading: Reading) -> float:
    """Factor to W m-2 nm-1 of a column, from what its user, its header or its comment states."""
    stated = reading.units.get(name) or reading.units.get(kind) or raw.units.get(name)
    if stated is None:
        found = irradiance_units_in(raw.comment)
        if len({irradiance_factor(unit) for unit in found}) == 1:
            stated = found[0]
    if stated is None:
        raise ValueError(
            f"{raw.name}: the unit of column {name!r} is not stated; write a header line such as "
            f"'# units: {name}=W m-2 nm-1', or tell it (--unit 'uW cm-2 nm-1')."
        )
    factor = irradiance_factor(stated)
    if factor is None:
        raise ValueError(
            f"{raw.name}: {name} is in {stated!r}; known are W m-2 nm-1 and uW cm-2 nm-1 in their "
            "usual spellings."
        )
    return factor


def _flagged(raw: RawCast, name: str, values: np.ndarray, counts: dict[str, int]) -> np.ndarray:
    flags = raw.flags.get(name)
    if flags is None:
        return values
    bad = np.isin(flags, _BAD_FLAGS) & np.isfinite(values)
    if bad.any():
        counts["bad quality flag"] = counts.get("bad quality flag", 0) + int(bad.sum())
    return np.where(bad, np.nan, values)


def profile_of(raw: RawCast, reading: Reading | None = None) -> Profile:
    """A checked profile of what a file held; flags, tilt and units are dealt with here."""
    reading, counts, calibrated = reading or Reading(), dict(raw.counts), True
    depth = _depth(raw, reading, counts) + reading.depth_offset
    groups: dict[str, dict[float, np.ndarray]] = {}
    for name, values in raw.columns.items():
        found = _IRRADIANCE.fullmatch(name.strip())
        if found:
            kind = _KINDS[found.group("kind").lower()]
            try:
                factor = _factor(raw, name.strip(), kind, reading)
            except ValueError:
                # Of the light above, changes alone serve most purposes: they have no unit.
                if kind != "surface":
                    raise
                factor, calibrated = 1.0, False
            bands = groups.setdefault(kind, {})
            # A band that comes twice is told from its twin, and refused as not increasing.
            key = float(found.group("nm")) - (1e-9 if name.endswith(" ") else 0.0)
            light = factor * _flagged(raw, name, values, counts)
            bands[key] = _possible(light, counts) if calibrated else light
    if "Ed" not in groups:
        raise ValueError(
            f"{raw.name}: no irradiance column; name them Ed_<nm>, for instance Ed_490. The file "
            f"has {', '.join(raw.columns)}."
        )
    wavelength = np.round(list(groups["Ed"]), 6)
    keep = np.isfinite(depth)
    if (~keep).any():
        counts["no depth"] = int((~keep).sum())
    good = raw.columns.get("depth_good")
    if good is not None and np.any(good == 0):
        counts["depth not good"] = int(np.sum(good == 0))
        keep &= good != 0
    tilt = _tilt(raw)
    if tilt is not None and reading.tilt_limit is not None:
        steep = keep & (tilt > reading.tilt_limit)
        counts[f"tilt above {reading.tilt_limit:g} degrees"] = int(steep.sum())
        keep &= ~steep
    par, par_unit = _par(raw, reading, counts)
    rows = np.flatnonzero(keep)
    if raw.time is not None and np.isfinite(raw.time[rows]).all():
        rows = rows[np.argsort(raw.time[rows], kind="stable")]

    def table(kind: str):
        bands = groups.get(kind)
        if bands is None:
            return None
        partner, alone = _partners(list(groups["Ed"]), list(bands))
        if alone:
            named = ", ".join(f"{wl:g}" for wl in alone)
            reason = f"bands of {kind} without a band of Ed within {_HALF_BAND:g} nm ({named} nm)"
            counts[reason] = len(alone)
        blank = np.full(len(depth), np.nan)
        return np.stack([blank if w is None else bands[w] for w in partner], axis=1)[rows]

    try:
        return Profile(
            depth[rows],
            wavelength,
            table("Ed"),
            Eu=table("Eu"),
            Lu=table("Lu"),
            surface=table("surface"),
            PAR=None if par is None else par[rows],
            PAR_unit=par_unit,
            tilt=None if tilt is None else tilt[rows],
            solar_zenith=raw.solar_zenith if reading.solar_zenith is None else reading.solar_zenith,
            source=raw.name,
            station=raw.station,
            counts=counts,
            calibrated=calibrated,
            **_beams(raw, reading, rows),
            upward_below=0.0
            if reading.upward_offset is None
            else reading.upward_offset - reading.depth_offset,
        )
    except ValueError as error:
        known = str(error).startswith(raw.name)
        raise ValueError(str(error) if known else f"{raw.name}: {error}") from None


def _possible(light: np.ndarray, counts: dict[str, int]) -> np.ndarray:
    """Light without fill values (99999, 9.96921e36, 1e20): more than any sun gives."""
    absurd = light > _IMPOSSIBLE
    if absurd.any():
        reason = f"fill values or light above {_IMPOSSIBLE:g} W m-2 nm-1"
        counts[reason] = counts.get(reason, 0) + int(absurd.sum())
    return np.where(absurd, np.nan, light)


def _partners(wanted: list[float], given: list[float]) -> tuple[list[float | None], list[float]]:
    """For each wanted band the given one that is nearest, both ways round and within half a band;
    and the given bands that remain."""
    partner: list[float | None] = []
    for wl in wanted:
        nearest = min(given, key=lambda other: abs(other - wl))
        back = min(wanted, key=lambda other: abs(other - nearest))
        near = abs(nearest - wl) <= _HALF_BAND and back == wl
        partner.append(nearest if near else None)
    return partner, [wl for wl in given if wl not in partner]


def _par(
    raw: RawCast, reading: Reading, counts: dict[str, int]
) -> tuple[np.ndarray | None, str | None]:
    """PAR under water and its unit: umol m-2 s-1, W m-2, or None where none is stated."""
    for name, values in raw.columns.items():
        if not _PAR.fullmatch(name):
            continue
        values = _flagged(raw, name, values, counts)
        stated = reading.units.get("PAR") or raw.units.get(name)
        if stated is None:
            return values, None
        known = par_factor(stated)
        if known is None:
            raise ValueError(
                f"{raw.name}: {name} is in {stated!r}; known are umol m-2 s-1, uE cm-2 s-1, "
                "mol m-2 d-1, quanta cm-2 s-1 and W m-2 in their usual spellings."
            )
        return known[0] * values, known[1]
    return None, None


def _beams(raw: RawCast, reading: Reading, rows: np.ndarray) -> dict:
    """What a `Profile` takes of columns agp_<nm> and cgp_<nm>."""
    found: dict[str, dict[float, np.ndarray]] = {}
    for name, values in raw.columns.items():
        match = _BEAM.fullmatch(name.strip())
        if match:
            kind = match.group("kind").lower()
            unit = reading.units.get(f"{kind}gp") or raw.units.get(name.strip())
            if unit is None or unit.strip() not in _PER_METRE:
                raise ValueError(
                    f"{raw.name}: the unit of {name.strip()} is "
                    f"{'not stated' if unit is None else repr(unit)}; it must be 1/m."
                )
            found.setdefault(kind, {})[float(match.group("nm"))] = values[rows]
    if not found:
        return {}
    grid = np.array(sorted({wl for bands in found.values() for wl in bands}))
    blank = np.full(len(rows), np.nan)
    tables = {
        kind: np.stack([bands.get(wl, blank) for wl in grid], axis=1)
        for kind, bands in found.items()
    }
    return {"beam_wavelength": grid, **tables}


def _tilt(raw: RawCast) -> np.ndarray | None:
    named = {k.lower(): v for k, v in raw.columns.items() if "tilt" in k.lower()}
    for name in ("edz_tilt_deg", "edz_tilt", "tilt_deg", "tilt"):
        if name in named:
            return named[name]
    return None
