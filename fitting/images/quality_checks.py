"""Verdicts before a fit: on chart readings, pictures and range maps, each with a remedy."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from fitting.images.photograph_file import Photograph

# A patch whose value falls short of the darker ones' straight line by this share is clipped.
_SHORT = 0.08
_FEWEST = 3
# Shares of a channel's pixels: at or below zero, and at full scale, beyond which it is objected to.
_ZEROED, _FULL = 0.05, 0.01
# Ranges (m) outside of which a photograph's median is not believed, and the share of missing ones.
_NEAREST, _FURTHEST, _MISSING = 0.05, 100.0, 0.5

FLASH = (
    "a flash fired: natural-light fits do not apply to what it lit; where it sat at the camera and "
    "lit all, read the charts with --lamp"
)

# Whether it passed, and a sentence: what was found and, where it did not pass, what to do.
Verdict = tuple[bool, str]


@dataclasses.dataclass(frozen=True)
class Linearity:
    """How straight the values of the neutral patches of one chart are in reflectance.

    - `r2`: (channel,) of the straight line through all patches, and `r2_kept` through the kept.
    - `clipped`: (patch,) whether a patch falls short of the line of the darker ones.
    """

    r2: np.ndarray
    r2_kept: np.ndarray
    clipped: np.ndarray

    def sentence(self) -> str:
        """What was found and what to do."""
        if not self.clipped.any():
            return f"straight in reflectance, R2 {self.r2.min():.3f}"
        return (
            f"{int(self.clipped.sum())} of {len(self.clipped)} patches are clipped below full "
            f"scale (R2 {self.r2.min():.2f} with them, {self.r2_kept.min():.3f} without): leave "
            "them out, and expose less"
        )


def linearity(values, reflectance) -> Linearity:
    """Hidden clipping of a grey chart: `values` (patch, channel), neutral `reflectance` (patch,).

    Raw developers raise the exposure and mix channels after they clip, so that a clipped patch may
    read well below 1.  Seen from the darkest three upwards, a patch is clipped when any channel
    falls short of the straight line of the kept darker ones by 8 %; so is every brighter one.
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


def of_picture(photo: "Photograph") -> list[Verdict]:
    """Zeroed channels, clipping at full scale and below it, flash; one sentence each."""
    found = []
    for c, plane in zip("RGB", np.moveaxis(photo.values, 2, 0), strict=True):
        zero, full = float(np.mean(~(plane > 0))), float(np.mean(plane >= 1))
        text = f"{c}: {100 * zero:.2f} % at or below zero, {100 * full:.2f} % at full scale"
        if zero > _ZEROED:
            text += "; the channel was cut by the developer or is dark: lower its black level"
        if full > _FULL:
            text += "; expose less, and read no patch there"
        hidden = _heap(plane)
        if hidden is not None:
            text += (
                f"; values heap up at {hidden:.3f}, so it was clipped there before the exposure "
                "was changed: read no patch that bright"
            )
        found.append((zero <= _ZEROED and full <= _FULL and hidden is None, text))
    if photo.flash:
        found.append((False, FLASH))
    return found


def _heap(plane: np.ndarray) -> float | None:
    """The brightest value below full scale at which far more pixels lie than just below it."""
    seen = plane[np.isfinite(plane) & (plane > 0)]
    if not len(seen) or ((top := float(seen.max())) >= 1.0 and top < 1.001):
        return None
    at_top = int(np.sum(seen >= 0.999 * top))
    below = int(np.sum((seen >= 0.9 * top) & (seen < 0.999 * top))) / 99.0
    return top if at_top > max(50.0, 1e-4 * seen.size, 20.0 * below) else None


def of_range(distance: np.ndarray, what: str = "range map") -> list[Verdict]:
    """Missing ranges and units that look wrong; `distance` in metres, NaN where missing."""
    distance = np.asarray(distance, dtype=float)
    known = distance[np.isfinite(distance) & (distance > 0)]
    missing = 1.0 - known.size / max(distance.size, 1)
    text = f"{what}: {100 * missing:.1f} % missing"
    if not known.size:
        return [(False, f"{text}: give the ranges, without them no water can be told")]
    middle = float(np.median(known))
    text += f", {known.min():.3g} to {known.max():.3g} m, median {middle:.3g} m"
    if missing > _MISSING:
        return [(False, f"{text}; most is missing: only what has a range can be used")]
    if middle > _FURTHEST:
        unit = "millimetres" if middle > 10 * _FURTHEST else "centimetres or millimetres"
        return [(False, f"{text}; no water lets one see so far, these look like {unit}: "
                 "convert them to metres")]  # fmt: skip
    if middle < _NEAREST:
        return [(False, f"{text}; too near, these look like kilometres, a disparity or a relative "
                 "depth: convert them to metres")]  # fmt: skip
    return [(True, text)]
