"""Reading a chart in a photograph by its four corners, with a picture of what was read."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

import oceaninv as oi
from fitting.images.chart_targets import Target, target
from fitting.images.photograph_file import Photograph
from fitting.images.quality_checks import hidden_clipping
from fitting.observations.photo import WAVELENGTH
from oceaninv.foundation import provenance
from oceaninv.foundation.atomic_write import checksum_line, with_checksum
from oceaninv.foundation.figure_file import save_figure

if TYPE_CHECKING:
    from fitting.observations.photo import Chart

_ORDERS = ((0, 1, 2, 3), (1, 2, 3, 0), (2, 3, 0, 1), (3, 0, 1, 2),
           (1, 0, 3, 2), (0, 3, 2, 1), (3, 2, 1, 0), (2, 1, 0, 3))  # fmt: skip
_TURNED = ("as given", "turned by 90 degrees", "turned by 180 degrees", "turned by 270 degrees",
           "mirrored left-right", "mirrored and turned", "mirrored top-bottom",
           "mirrored and turned")  # fmt: skip
# A patch with more of its pixels at full scale or without value than this is left out.
_UNUSABLE = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class ChartReading:
    """What was read from one chart.

    - `values`, `sd`: (patch, channel) mean and its standard deviation (scatter and rounding).
    - `clipped`: (patch,) saturated, at full scale or below it.
    - `pixels`: (patch,) number of pixels that were averaged.
    - `outline`: (patch, 4, 2) corners of their area, column and row.
    - `agreement`: rank correlation of values and known reflectances, mean over channels.
    """

    target: Target
    corners: Float[np.ndarray, "4 2"]
    values: Float[np.ndarray, "patch channel"]
    sd: Float[np.ndarray, "patch channel"]
    clipped: Bool[np.ndarray, " patch"]
    pixels: np.ndarray
    outline: Float[np.ndarray, "patch 4 2"]
    agreement: float

    @property
    def kept(self) -> Bool[np.ndarray, " patch"]:
        """(patch,) not clipped, and of trusted reflectance."""
        return ~self.clipped & self.target.trusted

    def chart(self, distance: float, *, noise: float = 0.03, **rest: Any) -> "Chart":
        """The kept patches as a `Chart` at `distance` (m).

        `noise`: relative scatter added to `sd`, for caustics and uneven light; 3 % in the field.
        `rest`: further arguments of `Chart`.  A patch that is left out stays on the board.
        ValueError where no patch is kept.
        """
        from fitting.observations.photo import Chart

        keep = self.kept
        if not keep.any():
            raise ValueError("every patch of the chart is clipped: expose less.")
        sigma = np.hypot(self.sd, noise * self.values)[keep]
        name = str(rest.pop("name", self.target.name))
        if self.target.board is not None:
            rest = {"board": self.target.board, "place": np.flatnonzero(keep)} | rest
        spectra = self.target.reflectance[keep]
        return Chart(self.values[keep], spectra, distance, sigma, name=name, **rest)

    def message(self) -> str:
        """How many patches were kept, and how well they agree with the chart."""
        return (
            f"{self.target.name}: {int(self.kept.sum())} of {len(self.clipped)} patches kept, "
            f"{int(self.clipped.sum())} clipped; rank agreement {self.agreement:.2f}"
        )

    def sentence(self) -> str:
        """Former name of `message`."""
        warnings.warn("sentence() is now message().", DeprecationWarning, stacklevel=2)
        return self.message()


def read_chart(
    photograph: Photograph, corners: Any, name: str | Path | Target, *, window: float = 0.5
) -> ChartReading:
    """Mean values of the patches of a chart whose four corners are given.

    **Arguments:**

    - `corners`: (4, 2) column and row (pixels from the top left) of the corners of the area that
      the patches fill: top left, top right, bottom right, bottom left of the chart as printed.
    - `name`: "ColorChecker24", "DGK18", the path of a csv, or a
      `fitting.images.chart_targets.Target`.
    - `window`: share of a patch's width and height that is averaged, 0-1.

    The corners give the perspective, and the perspective the patches.  A patch is marked clipped
    when more than a tenth of its pixels are at full scale or unusable.  On charts with four greys
    or more, patches that are clipped below full scale are marked, too
    (`fitting.images.quality_checks.hidden_clipping`).

    Raises ValueError for corners outside the picture or out of order, and when the values follow
    the known reflectances better with the chart turned or mirrored.
    """
    chart = name if isinstance(name, Target) else target(name)
    rows, columns = photograph.values.shape[:2]
    corners = np.asarray(corners, dtype=np.float64)
    if corners.shape != (4, 2):
        raise ValueError(f"corners must be four points (column, row), not shape {corners.shape}.")
    inside = (corners >= -0.5) & (corners <= np.array([columns, rows]) - 0.5)
    if not np.all(inside):
        raise ValueError(
            f"corner {corners[~inside.all(axis=1)][0]} lies outside the picture of {columns} x "
            f"{rows} pixels."
        )
    if not 0 < window <= 1:
        raise ValueError(f"window must lie in (0, 1], not {window:g}.")
    sides = np.roll(corners, -1, axis=0) - corners
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    if not (np.all(turns > 0) or np.all(turns < 0)):
        raise ValueError(
            "corners must go around the chart: top left, top right, bottom right, bottom left."
        )
    values, sd, spoiled, pixels, outline = _read(photograph, corners, chart, window)
    found = agreements(photograph, [corners[list(order)] for order in _ORDERS], chart, window)
    best = int(np.argmax(found))
    if found[best] > found[0] + 1e-9:
        raise ValueError(
            f"the patches follow {chart.name} better {_TURNED[best]} (rank correlation "
            f"{found[best]:.2f}) than as given ({found[0]:.2f}): give the corners in the chart's "
            "own order, its top left first."
        )
    clipped = _clipped(values, spoiled, chart)
    return ChartReading(chart, corners, values, sd, clipped, pixels, outline, found[0])


def agreements(
    photograph: Photograph, places: Sequence[np.ndarray], chart: Target, window: float = 0.5
) -> list[float]:
    """How well what is read at each set of corners follows the chart's known values.

    Mean over the channels of the rank correlation with what an average camera sees in white light.
    """
    from scipy.stats import rankdata

    weights = np.asarray(oi.spectrum.generic_camera().weights(WAVELENGTH))
    expected = rankdata(chart.reflectance @ weights.T, axis=0).T
    found = []
    for corners in places:
        ranks = rankdata(_read(photograph, corners, chart, window)[0], axis=0).T
        pairs = zip(ranks, expected, strict=True)
        each = [np.corrcoef(a, b)[0, 1] if np.ptp(a) > 0 else 0.0 for a, b in pairs]
        found.append(float(np.mean(each)))
    return found


def perspective(corners: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Map of (point, 2) across and down in the unit square to column and row of the picture."""
    from skimage.transform import ProjectiveTransform

    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return ProjectiveTransform.from_estimate(unit, corners)


def _read(photograph: Photograph, corners: np.ndarray, chart: Target, window: float):
    """Means, standard deviations, unusable shares, numbers of pixels and outlines of all patches.

    A pixel belongs to a patch when its centre lies in the patch's outline.
    """
    from skimage.draw import polygon

    to_picture = perspective(corners)
    half = 0.5 * window * chart.size
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    places = chart.centre[:, None] + square * half[:, None]
    outline = to_picture(places.reshape(-1, 2)).reshape(places.shape)
    middles = to_picture(chart.centre)
    size = photograph.values.shape[:2]
    values, sd, spoiled, pixels = [], [], [], []
    for middle, border in zip(middles, outline, strict=True):
        rows, columns = polygon(border[:, 1], border[:, 0], size)
        if not len(rows):  # smaller than a pixel
            columns, rows = np.clip(np.round(middle), 0, [size[1] - 1, size[0] - 1]).astype(int)
            columns, rows = columns[None], rows[None]
        seen, usable = photograph.values[rows, columns], photograph.mask[rows, columns]
        spoiled.append(1.0 - np.mean(np.all(usable, axis=1)))
        values.append(np.mean(np.where(np.isfinite(seen), seen, 0.0), axis=0))
        scatter = seen.std(axis=0, ddof=1) if len(seen) > 1 else np.zeros(3)
        own = np.hypot(scatter, photograph.relative * values[-1]) / np.sqrt(len(seen))
        sd.append(np.hypot(own, photograph.step))
        pixels.append(len(seen))
    return np.stack(values), np.stack(sd), np.array(spoiled), np.array(pixels), outline


def _clipped(values: np.ndarray, spoiled: np.ndarray, chart: Target) -> np.ndarray:
    clipped = spoiled > _UNUSABLE
    return clipped | hidden_clipping(values, chart.brightness, chart.neutral & ~clipped)


def overlay(
    photograph: Photograph,
    readings: Sequence[ChartReading],
    path: str | Path,
    *,
    overwrite: bool = False,
) -> None:
    """Write a PNG that shows where each patch was read, numbered from 1.

    Patches that are not kept are red and crossed out.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon

    shown = display(photograph.values)
    figure = Figure(figsize=(6.0 * min(len(readings), 2), 4.6 * -(-len(readings) // 2)))
    FigureCanvasAgg(figure)
    across = min(len(readings), 2)
    for k, reading in enumerate(readings):
        axes = figure.add_subplot(-(-len(readings) // 2), across, k + 1)
        axes.imshow(shown, interpolation="nearest")
        for number, (polygon, bad) in enumerate(
            zip(reading.outline, ~reading.kept, strict=True), start=1
        ):
            colour = "tab:red" if bad else "black"
            axes.add_patch(Polygon(polygon, fill=False, color=colour, lw=1.0))
            x, y = polygon.mean(axis=0)
            axes.text(x, y, f"{number}", color=colour, fontsize=7, ha="center", va="center")
            if bad:
                axes.plot(*polygon[[0, 2]].T, color=colour, lw=0.7)
        axes.add_patch(Polygon(reading.corners, fill=False, color="white", lw=0.8))
        low, high = reading.corners.min(axis=0), reading.corners.max(axis=0)
        margin = 0.15 * (high - low).max()
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(high[1] + margin, low[1] - margin)
        axes.set_title(reading.message(), fontsize=8)
        axes.tick_params(labelsize=7)
    figure.tight_layout()
    save_figure(figure, path, dpi=130, overwrite=overwrite)


def display(values: np.ndarray) -> np.ndarray:
    """(row, column, 3) linear values for display: the 99th percentile is white, gamma 2.2."""
    finite = np.nan_to_num(np.asarray(values, dtype=float))
    top = max(float(np.percentile(finite, 99)), 1e-12)
    return np.clip(finite / top, 0.0, 1.0) ** (1 / 2.2)


def table_of(
    photograph: Photograph,
    charts: Sequence[tuple[str, str, float, ChartReading]],
    windows: Sequence[tuple[float, float, float, float, float]],
    zenith: float | Sequence[float],
    camera: str | None = None,
    lamp: bool = False,
) -> str:
    """Readings as the csv that `fitting.images.photo_csv.read_photo` reads.

    `charts`: (name, kind, range in m, reading); `windows` of open water: (x0, y0, x1, y1, zenith);
    `zenith`: angles of the lines of sight to the charts, degrees, one for all or one for each (10
    degrees change the veil before a chart by some 10 %); `camera`: None takes the photograph's
    camera if its response is known, else generic; `lamp`: whether a lamp at the camera lit all.
    Exposure and flash of the photograph are written into the header.
    """
    facts = [f"# camera: {camera or photograph.camera or 'generic'}"]
    if photograph.exposure is not None:
        facts.append(f"# relative_exposure: {photograph.exposure:.6g}")
    if photograph.flash is not None:
        facts.append(f"# flash: {'fired' if photograph.flash else 'not fired'}")
    if lamp:
        facts.append("# light: lamp")
    lines = [
        *(f"# {line}" for line in [checksum_line(), *provenance.current().lines]),
        f"# title: Readings of charts and open water in {Path(photograph.source).name}",
        "# units: kind=text, chart=text, target=text, range=m, zenith=degree, *=1",
        *facts,
        "kind,chart,target,patch,reflectance,range,zenith,R,G,B,R_sd,G_sd,B_sd,pixels,clipped",
    ]

    def numbers(values):
        return ",".join(f"{v:.6g}" for v in values)

    zeniths = np.broadcast_to(np.asarray(zenith, dtype=float), (len(charts),))
    for (name, kind, distance, reading), tilt in zip(charts, zeniths, strict=True):
        for i, kept in enumerate(reading.kept):
            grey = reading.target.brightness[i]
            cells = numbers([*reading.values[i], *reading.sd[i]])
            lines.append(
                f"chart,{name},{kind},{i + 1},{grey:.4f},{distance:.4g},{tilt:g},{cells},"
                f"{reading.pixels[i]},{int(not kept)}"
            )
    rows, columns = photograph.values.shape[:2]
    for x0, y0, x1, y1, angle in windows:
        if not (0 <= x0 <= x1 < columns and 0 <= y0 <= y1 < rows):
            raise ValueError(
                f"window {x0:g},{y0:g} {x1:g},{y1:g} of open water must lie in the picture of "
                f"{columns} x {rows} pixels, its upper left corner first."
            )
        part = slice(int(y0), int(y1) + 1), slice(int(x0), int(x1) + 1)
        seen = photograph.values[part][np.all(photograph.mask[part], axis=-1)]
        if len(seen) == 0:
            raise ValueError(f"window {x0:g},{y0:g} {x1:g},{y1:g} holds no usable pixel.")
        scatter = seen.std(axis=0) / np.sqrt(len(seen))
        cells = numbers([*seen.mean(axis=0), *np.hypot(scatter, photograph.step)])
        lines.append(f"background,,,,,,{angle:g},{cells},{len(seen)},0")
    return with_checksum("\n".join(lines) + "\n")
