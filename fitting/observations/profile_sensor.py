"""What a cast says about its own sensors: darkness, noise, the light above, too many samples."""

import numpy as np

MIN_DEPTHS = 5
MOST_SAMPLES = 2048
_DARKEST, _FADED = 0.01, 0.05
# Times its neighbours above which a value is no light.
_ISOLATED = 1000.0
# Share of the range by which a sensor comes back where it turns.
_TURN = 0.2
# Of ln light: half of it.
_SHADE = np.log(2.0)
# Bins of the range, and times the usual number of samples in one where the sensor stayed.
_BINS, _STAY, _FEW = 512, 10.0, 64


def noise_floor(light: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(wl,) scatter of the electronics of bands that come to an end in light, by their deepest
    tenth.

    There the scatter of the light, from differences of neighbours, is compared with what waves
    make of it, whose relative scatter the upper half of the cast shows: only what exceeds twice
    theirs is the electronics', and nothing where light does not fade to a twentieth of the
    brightest.
    """
    floors = []
    for values, kept in zip(light.T, mask.T, strict=True):
        seen = values[kept]
        part = seen[-max(2 * MIN_DEPTHS, len(seen) // 10) :]
        level = max(float(np.median(part)), 0.0)
        waves = _scatter(np.log(np.maximum(seen[: len(seen) // 2], 1e-30))) * level
        fades = level < _FADED * np.max(seen)
        floors.append(np.sqrt(max(_scatter(part) ** 2 - (2.0 * waves) ** 2, 0.0)) if fades else 0.0)
    # Never quite zero: a digital zero would claim perfect knowledge of darkness.
    return np.maximum(floors, 1e-12 * np.nanmax(np.where(mask, light, np.nan), axis=0))


def _scatter(values: np.ndarray) -> float:
    """Standard deviation of one sample, robust, from differences of neighbours less their trend."""
    steps = np.diff(values)
    if len(steps) == 0:
        return 0.0
    return float(1.4826 * np.median(np.abs(steps - np.median(steps))) / np.sqrt(2.0))


def isolated_values(Ed: np.ndarray) -> np.ndarray:
    """(depth, wl) values above 1,000 times all of the four neighbours on either side: no light
    falls so fast between samples, and fill values such as 1e20 or 99999 do."""
    filled = np.nan_to_num(Ed, nan=0.0)
    around = np.zeros_like(filled)
    for shift in range(1, 5):
        around[shift:] = np.maximum(around[shift:], filled[:-shift])
        around[:-shift] = np.maximum(around[:-shift], filled[shift:])
    return (filled / _ISOLATED > around) & (around > 0)


def segments(depth: np.ndarray) -> np.ndarray:
    """(depth,) which way down or up each sample belongs to, by `depth` in order of measurement.

    A way ends where the sensor comes back by a fifth of the cast's range; ways of fewer than
    `MIN_DEPTHS` samples, such as the jump from one cast to the next, count to the way after them.
    """
    back = _TURN * np.ptp(depth)
    label = np.zeros(len(depth))
    steps = np.diff(depth)
    # Depths in no order at all are not in that of measurement.
    if back == 0 or np.all(steps >= 0) or np.median(np.abs(steps)) > 0.5 * back:
        return label
    turns, extreme, direction = [0], 0, 0
    for i, z in enumerate(depth):
        ahead = (z - depth[extreme]) * (direction or 1)
        if direction == 0 and abs(z - depth[0]) > back:
            direction, extreme = (1 if z > depth[0] else -1), i
        elif direction and ahead > 0:
            extreme = i
        elif direction and -ahead > back:
            turns.append(extreme + 1)
            extreme, direction = i, -direction
    ends = [*turns[1:], len(depth)]
    number, start = 0, 0
    for end in ends:
        if end - start >= MIN_DEPTHS or end == len(depth):
            label[start:end] = number
            number, start = number + 1, end
    return label


def shaded(
    depth: np.ndarray, light: np.ndarray, mask: np.ndarray, segment: np.ndarray
) -> np.ndarray:
    """(depth,) samples near the surface with less light than there is further down.

    `light` (depth, wl) less darkness, over the light above.  A boat's shade, a covered sensor or
    a cloud: in most bands running medians lie below half of a deeper one on the same way.  All
    that lies above the brightest depth is left out then, and as far below it as the light took
    above it to halve.
    """
    found = np.zeros(len(depth), bool)
    for way in np.unique(segment):
        rows = np.flatnonzero((segment == way) & mask.any(axis=1))
        if len(rows) < 2 * MIN_DEPTHS:
            continue
        ends = []
        for values, seen in zip(light[rows].T, mask[rows].T, strict=True):
            if seen.sum() < 2 * MIN_DEPTHS:
                continue
            smooth = _running_median(np.log(np.maximum(values[seen], 1e-30)))
            brightest = int(np.argmax(smooth))
            dim = np.flatnonzero(smooth[:brightest] < smooth[brightest] - _SHADE)
            here = depth[rows][seen]
            reach = here[brightest] + (here[brightest] - here[dim[-1]] if len(dim) else 0.0)
            ends.append(reach if len(dim) >= 3 else -np.inf)
        if ends and np.mean(np.isfinite(ends)) > 0.5:
            end = np.median([e for e in ends if np.isfinite(e)])
            found[rows[depth[rows] <= end]] = True
    return found


def _running_median(values: np.ndarray) -> np.ndarray:
    """Medians of five neighbours, the ends as they are."""
    if len(values) < 5:
        return values
    windows = np.lib.stride_tricks.sliding_window_view(values, 5)
    return np.concatenate([values[:2], np.median(windows, axis=1), values[-2:]])


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


def thinned(data: dict) -> tuple[dict, dict[str, int]]:
    """Arrays along ascending depth as medians over bins of depth, where there are too many samples.

    Beyond some thousands of samples the waves, which stay correlated, set the error, and more
    samples only cost time.  Where the sensor stayed at one depth (a float at the surface, a winch
    that stopped), all that it saw there is one measurement.  Bins hold samples of one way, down or
    up.  The second: how many samples were merged, by reason.
    """
    depth, segment = data["depth"], data["segment"]
    count, span = len(depth), float(np.ptp(data["depth"]))
    if span == 0:
        return data, {}
    places = np.floor((depth - depth[0]) / span * (_BINS - 1)).astype(int)
    stays = False
    for way in np.unique(segment):
        numbers = np.bincount(places[segment == way])
        stays |= numbers.max() > _STAY * np.median(numbers[numbers > 0])
    if count <= MOST_SAMPLES and not (stays and count > _FEW):
        return data, {}
    if not stays:
        ways = max(len(np.unique(segment)), 1)
        places = np.floor((depth - depth[0]) / span * (MOST_SAMPLES // ways - 1)).astype(int)
    _, bins = np.unique(np.stack([places, segment]), axis=1, return_inverse=True)
    bins = bins.reshape(-1)
    order = np.argsort(bins, kind="stable")
    starts = np.flatnonzero(np.diff(bins[order], prepend=-1))
    sizes = np.diff(np.append(starts, count))
    inside = np.arange(sizes.max())[None, :] < sizes[:, None]
    rows = order[np.minimum(starts[:, None] + np.arange(sizes.max())[None, :], count - 1)]

    def medians(array: np.ndarray) -> np.ndarray:
        blocks = array[rows]
        missing = np.isnan(blocks) | ~inside.reshape(*inside.shape, *[1] * (array.ndim - 1))
        # nanmedian warns of empty blocks and is slow.
        ordered = np.sort(np.where(missing, np.inf, blocks), axis=1)
        number = (~missing).sum(axis=1, keepdims=True)
        low = np.take_along_axis(ordered, np.maximum(number - 1, 0) // 2, axis=1)[:, 0]
        high = np.take_along_axis(ordered, np.minimum(number // 2, len(ordered[0]) - 1), axis=1)
        middle = 0.5 * (low + high[:, 0])
        return np.where(number[:, 0] > 0, middle, np.nan)

    again = np.argsort(medians(depth), kind="stable")
    found = {n: None if array is None else medians(array)[again] for n, array in data.items()}
    reason = "samples in medians over depth" + (", as the sensor stayed there" if stays else "")
    return found, {reason: count - len(starts)}
