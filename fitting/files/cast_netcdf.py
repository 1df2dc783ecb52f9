"""Casts in netCDF: BGC-Argo profiles, and plain datasets with dimensions depth and wavelength."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.files.raw_cast import RawCast

if TYPE_CHECKING:
    import xarray

_MAGIC = {b"\x89HDF": "h5netcdf", b"CDF\x01": "scipy", b"CDF\x02": "scipy"}


def is_netcdf(head: bytes) -> bool:
    """Whether a file that starts like this is netCDF, classic or 4."""
    return head[:4] in _MAGIC


def read(path: Path, columns: Mapping[str, str]) -> list[RawCast]:
    """All casts of a file; `columns`: its variable by the name that is wanted here."""
    import xarray as xr

    with open(path, "rb") as file:
        engine = _MAGIC[file.read(4)]
    try:
        with xr.open_dataset(path, engine=engine, decode_times=False) as data:
            data.load()
    except Exception as error:  # every library below has its own way to say "damaged"
        raise ValueError(
            f"{path} cannot be read as netCDF; it may be half-written or damaged ({error})."
        ) from None
    return casts_of(data, str(path), columns)


def casts_of(
    data: "xarray.Dataset", name: str, columns: Mapping[str, str] | None = None
) -> list[RawCast]:
    """All casts of a dataset: N_PROF of them in the Argo layout, else one."""
    renames = {theirs: ours for ours, theirs in (columns or {}).items()}
    missing = [theirs for theirs in renames if theirs not in data.variables]
    if missing:
        raise ValueError(
            f"{name}: no variable {missing[0]!r}; it has {', '.join(map(str, data.variables))}."
        )
    data = data.rename(renames)
    if any(str(v).startswith("DOWN_IRRADIANCE") for v in data.variables):
        return _argo(data, name)
    if "Ed" in data.variables and {"depth", "wavelength"} <= set(data["Ed"].dims):
        return [_plain(data, name)]
    raise ValueError(
        f"{name}: neither BGC-Argo (DOWN_IRRADIANCE...) nor a variable Ed over depth and "
        f"wavelength; it has {', '.join(map(str, data.variables))}."
    )


def _unit(variable, name: str, where: str) -> str:
    unit = variable.attrs.get("units")
    if not unit:
        raise ValueError(f"{where}: the unit of {name} is not stated (attribute units).")
    return str(unit)


def _plain(data: "xarray.Dataset", name: str) -> RawCast:
    columns = {"depth": np.asarray(data["depth"], dtype=np.float64)}
    units = {"depth": _unit(data["depth"], "depth", name)}
    for kind in ("Ed", "Eu", "Lu"):
        if kind in data.variables:
            table = data[kind].transpose("depth", "wavelength")
            for wl, values in zip(np.asarray(data["wavelength"]), np.asarray(table).T, strict=True):
                columns[f"{kind}_{wl:.9g}"] = np.asarray(values, dtype=np.float64)
                units[f"{kind}_{wl:.9g}"] = _unit(data[kind], kind, name)
    return RawCast(name, columns, units)


def _argo(data: "xarray.Dataset", name: str) -> list[RawCast]:
    count = data.sizes.get("N_PROF", 1)
    stems = sorted(
        str(v)
        for v in data.variables
        if str(v).removeprefix("DOWN_IRRADIANCE").isdigit() or v == "DOWNWELLING_PAR"
    )
    casts = []
    for i in range(count):
        one = data.isel(N_PROF=i) if "N_PROF" in data.sizes else data
        pressure, _ = _adjusted(one, "PRES")
        columns, units, flags = {"pres": pressure}, {}, {}
        units["pres"] = _unit(data["PRES"], "PRES", name)
        for stem in stems:
            values, quality = _adjusted(one, stem)
            if np.isfinite(values).any():
                column = "PAR" if stem == "DOWNWELLING_PAR" else stem
                columns[column], units[column] = values, _unit(data[stem], stem, name)
                if quality is not None:
                    flags[column] = quality
        # A float's file has profiles of other sensors beside those of light.
        if any(column.startswith("DOWN_IRRADIANCE") for column in columns) or count == 1:
            label = name if count == 1 else f"{name}:{i}"
            casts.append(RawCast(label, columns, units, flags, **_station(one)))
    if not casts:
        raise ValueError(f"{name}: every DOWN_IRRADIANCE value is missing.")
    return casts


def _station(one: "xarray.Dataset") -> dict[str, Any]:
    """Where, when and by which float one profile was measured, as far as the file says."""
    cycle, platform = _number(one, "CYCLE_NUMBER"), None
    if "PLATFORM_NUMBER" in one.variables:
        value = np.asarray(one["PLATFORM_NUMBER"]).reshape(-1)
        texts = [v.decode("ascii", "replace") if isinstance(v, bytes) else str(v) for v in value]
        platform = "".join(texts).strip() or None
    return {
        "latitude": _number(one, "LATITUDE"),
        "longitude": _number(one, "LONGITUDE"),
        "began": _time(one),
        "platform": platform,
        "cycle": None if cycle is None else int(cycle),
    }


def _number(one: "xarray.Dataset", name: str) -> float | None:
    """A scalar of one profile; None where it is absent or missing."""
    if name not in one.variables or one[name].size != 1 or one[name].dtype.kind not in "iuf":
        return None
    value = float(one[name])
    return value if np.isfinite(value) else None


def _time(one: "xarray.Dataset") -> str | None:
    """JULD, days since a date or decoded before, as ISO 8601 to the second."""
    if "JULD" not in one.variables or one["JULD"].size != 1:
        return None
    if one["JULD"].dtype.kind == "M":
        found = np.asarray(one["JULD"]).reshape(()).astype("datetime64[s]")
    else:
        days = _number(one, "JULD")
        since = re.match(r"days since (\d{4}-\d{2}-\d{2})", str(one["JULD"].attrs.get("units", "")))
        if days is None or since is None or not 0.0 <= days < 1e5:
            return None
        found = np.datetime64(since[1], "s") + np.timedelta64(round(days * 86400.0), "s")
    return None if np.isnat(found) else f"{found}Z"


def _adjusted(one: "xarray.Dataset", stem: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Values and flags, the adjusted ones where the file has any."""
    better = f"{stem}_ADJUSTED"
    if better in one.variables and np.isfinite(np.asarray(one[better], dtype=float)).any():
        stem = better
    values = np.asarray(one[stem], dtype=np.float64)
    if f"{stem}_QC" not in one.variables:
        return values, None
    return values, _flags(np.asarray(one[f"{stem}_QC"]))


def _flags(codes: np.ndarray) -> np.ndarray:
    """Flags are characters (bytes) or numbers; blanks count as missing."""
    if codes.dtype.kind in "SUO":
        texts = [c.decode() if isinstance(c, bytes) else str(c) for c in codes]
        return np.array([int(t) if t.strip().isdigit() else 9 for t in texts])
    return np.where(np.isfinite(codes), codes, 9).astype(int)
