"""Colour charts by name: positions and reflectances of their patches."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

import oceaninv as oi
from fitting.observations.photo import WAVELENGTH, Board
from oceaninv.foundation.tables import load, unknown

NAMES = ("ColorChecker24", "ColorCheckerPassport", "DGK18")
_MIDDLE = (WAVELENGTH > 450.0) & (WAVELENGTH < 650.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Target:
    """A colour chart.

    - `reflectance`: (patch, wl) at `fitting.photo.fit_photo.WAVELENGTH`.
    - `centre`, `size`: (patch, 2) across and down, as shares of the area that the patches fill.
    - `neutral`: (patch,) which are grey.
    - `trusted`: (patch,) which have the tabulated reflectance; the others are shown, not used.
    - `board`: the board that carries the patches.
    """

    name: str
    reflectance: Float[np.ndarray, "patch wl"]
    centre: Float[np.ndarray, "patch 2"]
    size: Float[np.ndarray, "patch 2"]
    neutral: Bool[np.ndarray, " patch"]
    trusted: Bool[np.ndarray, " patch"]
    board: Board | None = None

    def of_size(self, width: float, size_sd: float = 0.02) -> "Target":
        """The same chart with a board `width` metres wide, all its lengths in proportion.

        **Raises:** ValueError where the width is not between 0 and 20 m, and for a chart whose
        board has no proportions.
        """
        if self.board is None:
            raise ValueError(
                f"chart {self.name} has no board: add header lines '# board_width: m' and "
                "'# board_height: m' to its file."
            )
        old, scale = self.board, width / self.board.width
        board = Board(
            width,
            old.height * scale,
            size_sd,
            old.patches * scale,
            old.reflectance,
            old.ground,
        )
        return dataclasses.replace(self, board=board)

    @property
    def brightness(self) -> Float[np.ndarray, " patch"]:
        """(patch,) mean reflectance over 450-650 nm."""
        return self.reflectance[:, _MIDDLE].mean(axis=1)


def target(name: str | Path) -> Target:
    """A chart by name, or from a csv of your own.

    - "ColorChecker24": 4 rows of 6; reflectances of colour-science ("ISO 17321-1").
      Its board is 0.289 x 0.204 m (Classic).
    - "ColorCheckerPassport": the same patches on a case of 0.125 x 0.090 m.
    - "DGK18": 6 greys above two lower rows of 6 colours; reflectances of table `DGK18`.  Its last
      two patches (skin tones) are not trusted: four charts in one photograph show them brighter
      than tabulated by 0.05-0.25.  Its board is 0.216 x 0.140 m (the maker's 8.5 x 5.5 inches); in
      a photograph with a range map the patches alone are 0.19 m wide.
    - a csv: column `wavelength` (nm, 400-700 or wider) and one column of reflectance for each
      patch, in reading order; header lines `# rows: 4` and `# columns: 6`.  Patches that vary by
      less than 5 % over 450-650 nm count as grey.  With header lines `# board_width: 0.3` and
      `# board_height: 0.2` (m) the chart has a board that its patches fill.

    **Raises:** ValueError for an unknown name, with the most similar known ones, and for a csv that
    cannot be read as a chart.
    """
    if str(name) in ("ColorChecker24", "ColorCheckerPassport"):
        spectra = oi.spectrum._colour().SDS_COLOURCHECKERS["ISO 17321-1"].values()
        rows = [np.interp(WAVELENGTH, s.wavelengths, s.values) for s in spectra]
        chart = _grid(str(name), np.stack(rows), (1.0, 1.0, 1.0, 1.0), 6, range(18, 24))
        classic = str(name) == "ColorChecker24"
        # Patches of 40 mm every 45 mm on the classic board; the pages of a Passport are a third of
        # that, on the lower half of a case of the given size.
        size = (0.289, 0.204, 0.270, 0.180) if classic else (0.125, 0.090, 0.100, 0.066)
        return _on_board(chart, *size, fill=0.89)
    if str(name) == "DGK18":
        table = load("DGK18")
        rows = [table.at(WAVELENGTH, str(i)) for i in range(1, 19)]
        chart = _grid("DGK18", np.stack(rows), (2.0, 1.0, 1.0), 6, range(6), doubtful=(16, 17))
        return _on_board(chart, 0.216, 0.140, 0.190, 0.125, fill=0.95, size_sd=0.1)
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


def _on_board(
    chart: Target, width, height, across, down, fill: float, size_sd: float = 0.05
) -> Target:
    """The chart on a board of this size (m), whose patches lie in an area `across` x `down` in its
    middle and fill this share of their places in each direction."""
    area = np.array([across, down])
    middle = (chart.centre - 0.5) * area
    half = chart.size * area * fill / 2
    patches = np.concatenate([middle, half], axis=1)
    board = Board(width, height, size_sd, patches, chart.reflectance)
    return dataclasses.replace(chart, board=board)


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
    chart = _grid(path.stem, spectra, (1.0,) * int(rows), int(columns), grey)
    width, height = (header_number(sheet, f"board_{k}", None, None) for k in ("width", "height"))
    if width is None and height is None:
        return chart
    if width is None or height is None:
        raise ValueError(f"{path}: give both '# board_width' and '# board_height', in metres.")
    try:
        return _on_board(chart, width, height, width, height, fill=0.9)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
