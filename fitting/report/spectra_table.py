"""Spectra of a fit as csv or SeaBASS, for those who do not read netCDF."""

from pathlib import Path

import numpy as np

from fitting.core.result import LEVEL, Fit
from fitting.files.seabass import seabass_text
from oceaninv.foundation import provenance
from oceaninv.foundation.atomic_write import atomic_write, checksum_line, with_checksum

# As SeaBASS spells them.
_UNITS = {
    "m-1": "1/m",
    "W m-2 nm-1": "W/m^2/nm",
    "W m-2 nm-1 sr-1": "W/m^2/nm/sr",
    "sr-1": "1/sr",
    "1": "none",
}


def write_spectra(
    path: str | Path, fit: Fit, constituents: Fit | None = None, *, overwrite: bool = False
) -> None:
    """Every spectral quantity of a fit with its 95 % interval, a row per wavelength.

    The name's ending decides the format: .csv, with units in a comment line as
    `fitting.files.cast_file` reads them, or .sb for SeaBASS (required header entries that the fit
    does not know are NA).  Scalars and constituents are comments.  ValueError for other endings.
    """
    path = Path(path)
    if path.suffix not in (".csv", ".sb"):
        raise ValueError(f"{path}: spectra are written as .csv or .sb (SeaBASS).")
    fields, units, columns = ["wavelength"], ["nm"], [fit.wavelength]
    for name, quantity in fit.quantities.items():
        if quantity.value.ndim == 1:
            low, high = quantity.interval(LEVEL, None)
            for suffix, column in (("", quantity.value), ("_low", low), ("_high", high)):
                fields.append(name + suffix)
                units.append(_UNITS.get(quantity.unit, quantity.unit))
                columns.append(column)
    table = np.stack(columns, axis=1)
    comments = [*_scalars(fit), *(_scalars(constituents) if constituents is not None else [])]
    comments += [
        f"Kd: {fit.metadata['kd_definition']}",
    ]
    comments.append(f"source: {provenance.without_folders(fit.metadata['source'])}")
    comments[:0] = [checksum_line(), *provenance.current().lines]
    if path.suffix == ".sb":
        unknown = ("investigators", "affiliations", "contact", "experiment", "cruise")
        header = dict.fromkeys(unknown, "NA") | {"data_type": "cast", "data_status": "final"}
        text = seabass_text(fields, units, table, header, comments)
    else:
        pairs = ", ".join(f"{f}={u}" for f, u in zip(fields, units, strict=True))
        lines = [f"# units: {pairs}", *(f"# {text}" for text in comments), ",".join(fields)]
        for row in table:
            lines.append(",".join(f"{v:.8g}" if np.isfinite(v) else "" for v in row))
        text = "\n".join(lines) + "\n"
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_text(with_checksum(text))


def _scalars(fit: Fit) -> list[str]:
    """A line for each number that stands in no column."""
    lines = []
    for number in fit.numbers():
        if number.wavelength is None:
            ends = f"({number.low:.6g} to {number.high:.6g})"
            mark = "" if number.identifiable else ", not identifiable"
            lines.append(f"{number.name}: {number.value:.6g} {ends} {number.unit}{mark}")
    return lines
