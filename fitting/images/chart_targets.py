"""Colour charts by name: positions and reflectances of their patches."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

import oceaninv as oi
from fitting.observations.photo import WAVELENGTH
from oceaninv.foundation.tables import load, unknown

NAMES = ("ColorChecker24", "DGK18")
_MIDDLE = (WAVELENGTH > 450.0) & (WAVELENGTH < 650.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Target:
    """A colour chart.

    - `reflectance`: (patch, wl) at `fitting.photo.fit_photo.WAVELENGTH`.
    - `centre`, `size`: (patch, 2) across and down, as shares of the area that the patches fill.
    - `neutral`: (patch,) which are grey.
    - `trusted`: (patch,) which have the tabulated reflectance; the others are shown, not used.
    """

    name: str
    reflectance: Float[np.ndarray, "patch wl"]
    centre: Float[np.ndarray, "patch 2"]
    size: Float[np.ndarray, "patch 2"]
    neutral: Bool[np.ndarray, " patch"]
    trusted: Bool[np.ndarray, " patch"]

    @property
    def brightness(self) -> Float[np.ndarray, " patch"]:
        """(patch,) mean reflectance over 450-650 nm."""
        return self.reflectance[:, _MIDDLE].mean(axis=1)


def target(name: str | Path) -> Target:
    """A chart by name, or from a csv of your own.

    - "ColorChecker24": 4 rows of 6; reflectances of colour-science ("ISO 17321-1").
    - "DGK18": 6 greys above two lower rows of 6 colours; reflectances of table `DGK18`.  Its last
      two patches (skin tones) are not trusted: four charts in one photograph show them brighter
      than tabulated by 0.05-0.25.
    - a csv: column `wavelength` (nm, 400-700 or wider) and one column of reflectance for each
      patch, in reading order; header lines `# rows: 4` and `# columns: 6`.  Patches that vary by
      less than 5 % over 450-650 nm count as grey.

    **Raises:** ValueError for an unknown name, with the most similar known ones, and for a csv that
    cannot be read as a chart.
    """
    if str(name) == "ColorChecker24":
        spectra = oi.spectrum._colour().SDS_COLOURCHECKERS["ISO 17321-1"].values()
        rows = [np.interp(WAVELENGTH, s.wavelengths, s.values) for s in spectra]
        return _grid("ColorChecker24", np.stack(rows), (1.0, 1.0, 1.0, 1.0), 6, range(18, 24))
    if str(name) == "DGK18":
        table = load("DGK18")
        rows = [table.at(WAVELENGTH, str(i)) for i in range(1, 19)]
        return _grid("DGK18", np.stack(rows), (2.0, 1.0, 1.0), 6, range(6), doubtful=(16, 17))
    if Path(name).suffix.lower() == ".csv":
        return _own(Path(name))
    raise unknown("colour chart", str(name), (*NAMES, "a csv of your own"))


def _grid(name, reflectance, heights, columns, neutral, doubtful=()) -> Target:
    """Rows of the given relative heights, each of as many patches, in reading order."""
    share = np.asarray(heights) / np.sum(heights)
    middle = np.cumsum(share) - share / 2
    across = (np.arange(columns) + 0.5) / columns
    centre = np.array([[x, y] for y in middle for x in across])
    size = np.array([[1.0 / columns, h] for h in share for _ in across])
    number = np.arange(len(reflectance))
    grey, trusted = np.isin(number, list(neutral)), ~np.isin(number, doubtful)
    return Target(name, reflectance, centre, size, grey, trusted)


def _own(path: Path) -> Target:
    from fitting.files.csv_sheet import header_number, read_sheet

    if not path.is_file():
        raise ValueError(f"{path} does not exist or is no file.")
    sheet = read_sheet(path)
    sheet.require("wavelength")
    rows, columns = (header_number(sheet, key, None, None) for key in ("rows", "columns"))
    patches = [c for c in sheet.columns if c != "wavelength"]
    if rows is None or columns is None or int(rows) * int(columns) != len(patches):
        raise ValueError(
            f"{path}: header lines '# rows: R' and '# columns: C' must say how the "
            f"{len(patches)} patches are laid out."
        )
    wavelength = sheet.numbers("wavelength")
    values = np.stack([sheet.numbers(c) for c in patches])
    inside = wavelength[0] <= WAVELENGTH[0] and wavelength[-1] >= WAVELENGTH[-1]
    if np.any(np.diff(wavelength) <= 0) or not inside:
        raise ValueError(
            f"{path}: wavelengths must increase and cover {WAVELENGTH[0]:.0f}-"
            f"{WAVELENGTH[-1]:.0f} nm."
        )
    if not np.all((values >= 0) & (values <= 1.5)):
        raise ValueError(f"{path}: reflectances must lie between 0 and 1.5, without gaps.")
    spectra = np.stack([np.interp(WAVELENGTH, wavelength, row) for row in values])
    seen = spectra[:, _MIDDLE]
    grey = np.flatnonzero(seen.std(axis=1) < 0.05 * seen.mean(axis=1))
    return _grid(path.stem, spectra, (1.0,) * int(rows), int(columns), grey)
