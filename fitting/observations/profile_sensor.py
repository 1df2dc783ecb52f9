"""What a cast says about its own sensors: darkness, noise, the light above, too many samples."""

import numpy as np

MIN_DEPTHS = 5
MOST_SAMPLES = 2048
_DARKEST = 0.01


def noise_floor(Ed: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(wl,) scatter of the deepest tenth of each band, from the differences of neighbours."""
    floors = []
    for values, kept in zip(Ed.T, mask.T, strict=True):
        deep = values[kept][-max(MIN_DEPTHS, kept.sum() // 10) :]
        floors.append(1.4826 * np.median(np.abs(np.diff(deep))) / np.sqrt(2.0))
    # Never quite zero: a digital zero would claim perfect knowledge of darkness.
    return np.maximum(floors, 1e-12 * np.nanmax(np.where(mask, Ed, np.nan), axis=0))


def darkness(Ed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reading without light, its standard deviation and the scatter of one sample, each (wl,).

    `Ed` (depth, wl) by increasing depth.  From the deepest tenth, if it is dark there: below a
    hundredth of the brightest and no longer falling.  All 0 for bands that do not get so far.
    """
    bands = Ed.shape[1]
    level, error, scatter = np.zeros(bands), np.zeros(bands), np.zeros(bands)
    for i, column in enumerate(Ed.T):
        values = column[np.isfinite(column)]
        deep = values[-(len(values) // 10) :]
        if len(deep) < 2 * MIN_DEPTHS:
            continue
        middle = np.median(deep)
        spread = 1.4826 * np.median(np.abs(deep - middle))
        # Spearman's rank correlation with depth: light, however little, still falls.
        ranks = np.argsort(np.argsort(deep))
        flat = np.corrcoef(ranks, np.arange(len(deep)))[0, 1] > -1.645 / np.sqrt(len(deep) - 1)
        if spread > 0 and flat and abs(middle) + spread < _DARKEST * np.max(values):
            level[i], scatter[i] = middle, spread
            # Half as much again: neighbours in time drift together.
            error[i] = 1.5 * 1.2533 * spread / np.sqrt(len(deep))
    return level, error, scatter


def smooth_reference(surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slow changes of the light above relative to their median, (depth, wl) in order of time, and
    the median, (wl,), NaN where there is none.

    A running median over a quarter of the cast: a dip that ends within an eighth of the cast is a
    shadow on this sensor (a shadow band's arm), not on the water, and leaves no trace.
    """
    from scipy.ndimage import median_filter

    smooth, level = np.empty_like(surface), np.full(surface.shape[1], np.nan)
    for i, column in enumerate(surface.T):
        good = np.isfinite(column) & (column > 0)
        if good.sum() < MIN_DEPTHS:
            smooth[:, i] = 1.0
            continue
        index = np.arange(len(column))
        filled = np.interp(index, index[good], column[good])
        width = 2 * (len(column) // 8) + 1
        slow = median_filter(filled, width, mode="nearest")
        level[i] = np.median(slow)
        smooth[:, i] = slow / level[i]
    return smooth, level


def thinned(data: dict) -> tuple[dict, int]:
    """Arrays along depth as medians over groups of neighbours, and how many make one.

    Beyond some thousands of samples the waves, which stay correlated, set the error, and more
    samples only cost time.
    """
    count = len(data["depth"])
    if count <= MOST_SAMPLES:
        return data, 1
    group = -(-count // MOST_SAMPLES)
    extra = -count % group

    def medians(array):
        if array is None:
            return None
        padded = np.pad(array, [(0, extra), *[(0, 0)] * (array.ndim - 1)], constant_values=np.nan)
        blocks = padded.reshape(-1, group, *array.shape[1:])
        missing = np.isnan(blocks)
        # nanmedian warns of empty blocks and is slow.
        ordered = np.sort(blocks, axis=1)
        number = np.maximum((~missing).sum(axis=1, keepdims=True), 1)
        low = np.take_along_axis(ordered, (number - 1) // 2, axis=1)
        high = np.take_along_axis(ordered, number // 2, axis=1)
        middle = 0.5 * (low + high)
        return np.where((~missing).any(axis=1), middle[:, 0], np.nan)

    return {name: medians(array) for name, array in data.items()}, group
