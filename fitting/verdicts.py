"""Verdicts on readings before a fit: which patches are clipped though they look harmless."""

import dataclasses

import numpy as np

# A patch whose value falls short of the darker ones' straight line by this share is clipped.
_SHORT = 0.08
_FEWEST = 3


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
