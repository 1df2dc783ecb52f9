"""Quality checks before a fit: of chart readings, pictures and range maps, each with a remedy."""

import dataclasses
import warnings
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fitting.images.saturation import saturation_spike

if TYPE_CHECKING:
    from fitting.images.photograph_file import Photograph

# A patch whose value falls short of the darker ones' straight line by this share is clipped.
_SHORT = 0.08
_FEWEST = 3
# Colours: a value short of the colours' own line by this many of their standard deviations, and by
# this share at least, is a problem; so is a lower rank correlation than this with what is expected.
_SHORT_COLOUR_SD, _SHORT_COLOUR, _LEAST_AGREEMENT = 5.0, 0.15, 0.5
# Largest shares of a channel's pixels at or below zero and at full scale that are no problem.
_ZEROED, _FULL = 0.05, 0.01
# Range (m) within which a photograph's median distance is believed, and largest share of gaps.
_NEAREST, _FURTHEST, _MISSING = 0.05, 100.0, 0.5

FLASH = (
    "a flash fired: fits for daylight do not apply to what it lit; where it was at the camera and "
    "lit everything, read the charts with --lamp"
)


class QualityCheck(NamedTuple):
    """Whether a check passed, and a message: what was found and, where it failed, what to do."""

    passed: bool
    message: str


@dataclasses.dataclass(frozen=True)
class Linearity:
    """How well the values of the neutral patches of one chart follow a straight line.

    - `r2`: (channel,) R2 of the line through all patches over their reflectance.
    - `r2_kept`: (channel,) R2 of the line through the patches that are not clipped.
    - `clipped`: (patch,) whether a patch falls short of the line of the darker ones.
    """

    r2: np.ndarray
    r2_kept: np.ndarray
    clipped: np.ndarray

    def message(self) -> str:
        """What was found and what to do."""
        if not self.clipped.any():
            return f"straight in reflectance, R2 {self.r2.min():.3f}"
        return (
            f"{int(self.clipped.sum())} of {len(self.clipped)} patches are clipped below full "
            f"scale (R2 {self.r2.min():.2f} with them, {self.r2_kept.min():.3f} without): leave "
            "them out, and expose less"
        )

    def sentence(self) -> str:
        """Former name of `message`."""
        warnings.warn("sentence() is now message().", DeprecationWarning, stacklevel=2)
        return self.message()


def linearity(values, reflectance) -> Linearity:
    """Clipping below full scale of grey patches, found by their departure from a straight line.

    `values`: (patch, channel), any scale; `reflectance`: (patch,), of neutral patches, 0-1.

    Raw developers raise the exposure and mix channels after clipping, so a clipped patch may read
    well below 1.  From the darkest three upwards, a patch counts as clipped when a channel falls
    short of the straight line through the darker patches by 8 %; all brighter patches then count
    as clipped, too.

    **Raises:** ValueError for fewer than four patches or shapes that do not match.
    """
    values = np.asarray(values, dtype=float)
    reflectance = np.asarray(reflectance, dtype=float)
    if values.ndim != 2 or reflectance.shape != values.shape[:1] or len(values) <= _FEWEST:
        raise ValueError(
            f"linearity needs values (patch, channel) and a reflectance for each of at least "
            f"{_FEWEST + 1} patches, not shapes {values.shape} and {reflectance.shape}."
        )
    order = np.argsort(reflectance, kind="stable")
    clipped = np.zeros(len(values), dtype=bool)
    for place in range(_FEWEST, len(order)):
        darker, patch = order[:place], order[place]
        slope, offset = np.polyfit(reflectance[darker], values[darker], 1)
        expected = offset + slope * reflectance[patch]
        if np.any(values[patch] < (1.0 - _SHORT) * expected):
            clipped[order[place:]] = True
            break
    return Linearity(
        _r2(values, reflectance), _r2(values[~clipped], reflectance[~clipped]), clipped
    )


def _r2(values: np.ndarray, reflectance: np.ndarray) -> np.ndarray:
    fitted = np.polyval(np.polyfit(reflectance, values, 1)[:, None, :], reflectance[:, None])
    left = np.sum((values - fitted) ** 2, axis=0)
    return 1.0 - left / np.sum((values - values.mean(axis=0)) ** 2, axis=0)


def hidden_clipping(values, brightness, neutral) -> np.ndarray:
    """(patch,) whether patches of a chart with greys and colours are clipped below full scale.

    Greys by `linearity`; colours where any channel is as bright as in the darkest clipped grey.
    None are found where there are fewer than four greys.  `values`: (patch, channel);
    `brightness`: (patch,) mean reflectance; `neutral`: (patch,) which are grey.
    """
    values, clipped = np.asarray(values, dtype=float), np.zeros(len(values), dtype=bool)
    greys = np.flatnonzero(neutral)
    if len(greys) > _FEWEST:
        hidden = greys[linearity(values[greys], np.asarray(brightness)[greys]).clipped]
        if len(hidden):
            clipped = np.any(values >= values[hidden].min(axis=0), axis=1)
            clipped[hidden] = True
    return clipped


def of_chart(values, brightness, neutral, expected, marked, name: str) -> list[QualityCheck]:
    """Linearity of the greys of a chart, and scatter of its colours about a line of their own.

    - `values`: (patch, channel), all positive; `brightness`: (patch,) mean reflectance.
    - `neutral`: (patch,) which are grey; `marked`: (patch,) which the file says are clipped.
    - `expected`: (patch, channel) what the camera would see of each patch in white light, any
      scale; used for the colours.

    Colours are not proportional to their mean reflectance, nor, in coloured water, quite to
    `expected`: only patches that fall short of the line through the colours by five times the
    scatter of the others (and by 15 %), and colours in a wrong order, are problems.
    """
    values, marked = np.asarray(values, dtype=float), np.asarray(marked, dtype=bool)
    neutral = np.asarray(neutral, dtype=bool)
    clipped, checks = hidden_clipping(values, brightness, neutral), []
    if neutral.sum() > _FEWEST:
        found = linearity(values[neutral], np.asarray(brightness)[neutral])
        fresh = clipped & ~marked
        text = f"chart {name}: {found.message()}"
        if fresh[~neutral].any():
            text += f"; {int(fresh[~neutral].sum())} colours are as bright as these: clipped, too"
        if clipped.any() and not fresh.any():
            text += " (all marked so in the file)"
        checks.append(QualityCheck(not fresh.any(), text))
    else:
        few = f"chart {name}: {int(neutral.sum())} grey patches, too few to judge linearity"
        checks.append(QualityCheck(True, few))
    colours = np.flatnonzero(~neutral & ~clipped & ~marked)
    if len(colours) > 2 * _FEWEST:
        checks.append(_colours(values[colours], np.asarray(expected)[colours], colours, name))
    return checks


def _colours(values: np.ndarray, expected: np.ndarray, patch: np.ndarray, name: str):
    """Check of the colours of one chart by the line through them, channel by channel."""
    from scipy.stats import rankdata, theilslopes

    short, scatter, agreement = np.zeros(len(patch), dtype=bool), [], []
    for seen, wanted in zip(values.T, expected.T, strict=True):
        slope, offset, *_ = theilslopes(seen, wanted)
        line = offset + slope * wanted
        off = seen - line
        sd = 1.4826 * float(np.median(np.abs(off - np.median(off))))
        short |= off < -np.maximum(_SHORT_COLOUR_SD * sd, _SHORT_COLOUR * line)
        scatter.append(sd / float(np.median(seen)))
        agreement.append(np.corrcoef(rankdata(seen), rankdata(wanted))[0, 1])
    text = f"chart {name}: {len(patch)} colours scatter by {100 * max(scatter):.2g} % about a line"
    if np.mean(agreement) < _LEAST_AGREEMENT:
        text += (
            f", but in the wrong order (rank correlation {np.mean(agreement):.2f}): name the chart "
            "that was photographed, and its corners in its own order"
        )
        return QualityCheck(False, text)
    if short.any():
        text += (
            f"; patch {', '.join(str(p + 1) for p in patch[short])} falls short of it: clipped, "
            "shaded or dirty, leave it out"
        )
    return QualityCheck(not short.any(), text)


def of_picture(photo: "Photograph") -> list[QualityCheck]:
    """One check per channel, of dark pixels and of clipping at full scale and below; flash.

    More than 5 % of the pixels at or below zero, more than 1 % at full scale and a saturation
    spike (`fitting.images.saturation`) are problems.
    """
    checks = []
    for c, plane in zip("RGB", np.moveaxis(photo.values, 2, 0), strict=True):
        known = plane[np.isfinite(plane)]
        zero, full = float(np.mean(known <= 0)), float(np.mean(known >= 1))
        text = f"{c}: {100 * zero:.2f} % at or below zero, {100 * full:.2f} % at full scale"
        if known.size < plane.size:
            text += f", {100 * (1 - known.size / plane.size):.2f} % without a value and left out"
        if zero > _ZEROED:
            text += "; the channel was cut by the developer or is dark: lower its black level"
        if full > _FULL:
            text += f"; {_where(plane >= 1)}: expose less, and read no patch there"
        spike = saturation_spike(plane)
        if spike is not None and 1.0 <= spike < 1.001:  # counted above
            spike = None
        if spike is not None:
            text += (
                f"; the brightest pixels are all alike at {spike:.3f}, so the channel was clipped "
                "there before the exposure was changed: read no patch that bright"
            )
        checks.append(QualityCheck(zero <= _ZEROED and full <= _FULL and spike is None, text))
    if photo.flash:
        checks.append(QualityCheck(False, FLASH))
    return checks


def _where(saturated: np.ndarray) -> str:
    """How many connected regions are saturated, and where the largest is."""
    from skimage.measure import label, regionprops

    regions = regionprops(label(saturated, connectivity=2))
    largest = max(regions, key=lambda region: region.area)
    row, column = largest.centroid
    count = "one region" if len(regions) == 1 else f"{len(regions)} regions, the largest"
    return f"{count} of {largest.area:.0f} pixels around column {column:.0f}, row {row:.0f}"


def of_range(distance: np.ndarray, what: str = "range map") -> list[QualityCheck]:
    """Missing ranges and units that look wrong; `distance` in metres, NaN where missing."""
    distance = np.asarray(distance, dtype=float)
    known = distance[np.isfinite(distance) & (distance > 0)]
    missing = 1.0 - known.size / max(distance.size, 1)
    text = f"{what}: {100 * missing:.1f} % missing"
    if not known.size:
        text += ": give the ranges, for without them nothing can be said about the water"
        return [QualityCheck(False, text)]
    middle = float(np.median(known))
    text += f", {known.min():.3g} to {known.max():.3g} m, median {middle:.3g} m"
    if missing > _MISSING:
        text += "; most is missing: only what has a range can be used"
    elif middle > _FURTHEST:
        unit = "millimetres" if middle > 10 * _FURTHEST else "centimetres or millimetres"
        text += f"; no water is clear enough for this, these look like {unit}: convert to metres"
    elif middle < _NEAREST:
        text += (
            "; too near, these look like kilometres, a disparity or a relative depth: convert to "
            "metres"
        )
    else:
        return [QualityCheck(True, text)]
    return [QualityCheck(False, text)]
