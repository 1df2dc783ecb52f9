"""Saturation below full scale: the spike that it leaves in the histogram of a channel."""

import numpy as np


def saturation_spike(plane: np.ndarray) -> float | None:
    """The brightest value of a channel where it is a spike of its histogram, else None.

    A channel that is clipped below full scale has its brightest 0.1 % of values crowded with
    pixels: more than 50, more than 1 in 10,000, and more than 20 times as many as lie on average
    in each of the next 99 steps of 0.1 % below.  `plane`: any shape; values that are not finite
    or not positive are left out.
    """
    seen = plane[np.isfinite(plane) & (plane > 0)]
    if not seen.size:
        return None
    top = float(seen.max())
    at_top = int(np.sum(seen >= 0.999 * top))
    below = int(np.sum((seen >= 0.9 * top) & (seen < 0.999 * top))) / 99.0
    return top if at_top > max(50.0, 1e-4 * seen.size, 20.0 * below) else None
