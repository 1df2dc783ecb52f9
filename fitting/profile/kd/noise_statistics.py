"""Statistics of noise along depth: medians, runs, correlation."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fitting.observations.profile_sensor import MIN_DEPTHS

# Waves that are correlated more would leave hardly an independent sample.
MOST_CORRELATED = 0.98


def running_median(values: np.ndarray) -> np.ndarray:
    """Running median of three medians of three samples each, along axis 0 (Tukey 1978).

    Up to one bright or dark sample in each three leaves no trace; unlike means it does not bend
    a monotonic curve.  `scipy.ndimage.median_filter` takes four times as long and 0.12 s to
    import, a tenth of a warm fit.
    """
    padded = np.pad(values, [(4, 4), *[(0, 0)] * (values.ndim - 1)], mode="reflect")

    def middle(a, b, c):
        return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))

    threes = middle(padded[:-2], padded[1:-1], padded[2:])
    return middle(threes[:-6], threes[3:-3], threes[6:])


def forward_fill(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Masked values replaced by the valid one before (or, at the start, after) along axis 0."""
    rows = np.arange(len(values))[:, None]
    before = np.maximum.accumulate(np.where(mask, rows, -1), axis=0)
    first = np.argmax(mask, axis=0)
    return np.take_along_axis(values, np.where(before < 0, first[None, :], before), axis=0)


def runs_p(residual: np.ndarray) -> float:
    """Probability that independent noise has as few or as many runs of one sign (two-sided).

    Wald & Wolfowitz 1940, normal approximation; small where a fit bends away from the data.
    """
    signs = np.sign(residual[np.isfinite(residual) & (residual != 0)])
    plus, minus = int((signs > 0).sum()), int((signs < 0).sum())
    total = plus + minus
    if plus == 0 or minus == 0:
        return 0.0 if total > MIN_DEPTHS else 1.0
    runs = 1 + int(np.sum(signs[1:] != signs[:-1]))
    mean = 2.0 * plus * minus / total + 1.0
    variance = (mean - 1.0) * (mean - 2.0) / (total - 1.0)
    return math.erfc(abs(runs - mean) / math.sqrt(2.0 * max(variance, 1e-12)))


def previous_used(used):
    """Of each sample along axis 0 the used sample before it: (its index, 0 where there is none;
    whether there is none).  numpy in, numpy out; JAX in, JAX out."""
    xp: Any = np if isinstance(used, np.ndarray) else jnp
    index = xp.arange(len(used)).reshape(-1, *[1] * (used.ndim - 1))
    rows = xp.where(used, index, -1)
    last = np.maximum.accumulate(rows, axis=0) if xp is np else jax.lax.cummax(rows)
    before = xp.concatenate([xp.full_like(last[:1], -1), last[:-1]])
    return xp.maximum(before, 0), before < 0


def correlation_of_neighbours(gap, length):
    """Correlation of AR(1) noise (first-order autoregressive, continuous in depth) over a `gap`.

    exp(-gap/length), at most `MOST_CORRELATED`; 0 where the `length` is 0.  Both in m.
    """
    xp: Any = np if isinstance(gap, np.ndarray) else jnp
    safe = xp.where(length > 0, length, 1.0)
    return xp.where(length > 0, xp.minimum(xp.exp(-gap / safe), MOST_CORRELATED), 0.0)


def whiten(columns, before, rho):
    """`columns` (depth, ...) of AR(1) noise less what the sample before tells, at unit variance.

    `before` and `rho`: as of `previous_used` and `correlation_of_neighbours`, (depth,) or
    (depth, wl), `rho` 0 where there is no sample before.
    """
    xp: Any = np if isinstance(columns, np.ndarray) else jnp
    rho = rho.reshape(*rho.shape, *[1] * (columns.ndim - rho.ndim))
    if before.ndim == 1:
        told = columns[before]
    else:
        index = before.reshape(rho.shape)
        told = np.take_along_axis(columns, np.broadcast_to(index, columns.shape), axis=0)
    return (columns - rho * told) / xp.sqrt(1.0 - rho**2)


def whitened(residual: np.ndarray, depth: np.ndarray, length: np.ndarray) -> np.ndarray:
    """(depth, wl) residuals, NaN where unused, less what waves of a `length` (wl,) m explain."""
    used = np.isfinite(residual)
    before, rho = _before(used, depth, length)
    return np.where(used, whiten(np.nan_to_num(residual), before, rho), np.nan)


def correlation_inflation(depth: np.ndarray, mask: np.ndarray, length: np.ndarray) -> np.ndarray:
    """(depth, wl) factors on the deviations of samples whose noise is correlated over depth.

    Waves of a `length` (wl,) m leave n (1 - rho)/(1 + rho) independent samples of n, rho the
    correlation of neighbours: what a smooth curve through them is known by.
    """
    _, rho = _before(mask, depth, np.nan_to_num(length))
    return np.sqrt((1.0 + rho) / (1.0 - rho))


def _before(used, depth, length) -> tuple[np.ndarray, np.ndarray]:
    """(depth, wl) index of the used sample before, and the correlation with it."""
    before, first = previous_used(used)
    rho = correlation_of_neighbours(depth[:, None] - depth[before], np.asarray(length))
    return before, np.where(first, 0.0, rho)
