"""Charts found in a photograph: square regions that lie in a grid of four rows of six."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from fitting.images.chart_reading import agreements
from fitting.images.chart_targets import target
from fitting.images.photograph_file import Photograph

# Rank agreement below which a grid of regions is no chart.
_LEAST_AGREEMENT = 0.6
# Patches of a chart that must be found as regions; the others follow from the grid.  The greys of
# a DGK18 are twice as high as wide, two rows of the grid, and are not among its 12 squares.
_FEWEST_PATCHES = {"ColorChecker24": 12, "DGK18": 9}
# Longer side of the copy that is searched, pixels.
_SEARCHED = 1000
_ROWS, _COLUMNS = 4, 6


def find_charts(
    photograph: Photograph, name: str = "ColorChecker24"
) -> list[Float[np.ndarray, "4 2"]]:
    """Corners of the charts of one kind in a photograph, the largest first.

    `name`: "ColorChecker24" or "DGK18".

    Each is (4, 2), column and row in pixels, in the chart's own order as
    `fitting.images.chart_reading.read_chart` takes them.

    Connected regions brighter than their surroundings, or free of edges, are collected in copies
    of at most 1,000 pixels a side: the mean of the channels, each scaled to its 99th percentile,
    with a gamma of 2.2, and each channel alone.  Neither white balance nor exposure matters.
    Square regions that lie in a grid give its perspective; the known order of the patches' values
    tells where in the grid the chart lies and how it is turned.  At least 12 patches of a
    ColorChecker24, or 9 of the 12 square ones of a DGK18, must be found, each at least 8 pixels
    wide in the copy.

    Raises ValueError where no chart is found, and for another kind of chart.
    """
    from skimage.transform import downscale_local_mean

    if name not in _FEWEST_PATCHES:
        raise ValueError(
            f"charts of the kind {name} cannot be found, only {' and '.join(_FEWEST_PATCHES)}: "
            "give the corners."
        )
    values = np.nan_to_num(np.asarray(photograph.values, dtype=float))
    step = -(-max(values.shape[:2]) // _SEARCHED)
    copy = downscale_local_mean(values, (step, step, 1)) if step > 1 else values
    found: list[tuple[float, np.ndarray]] = []
    chart = target(name)
    for mask in _masks(np.asarray(copy)):
        centres, sides = _square_regions(mask)
        for corners, count in _grids(centres, sides, _FEWEST_PATCHES[name]):
            placed = np.clip((corners + 0.5) * step - 0.5, 0.0, np.array(values.shape[1::-1]) - 1.0)
            scores = agreements(photograph, list(placed), chart, 0.3)
            best = int(np.argmax(scores))
            if scores[best] >= _LEAST_AGREEMENT:
                found.append((scores[best] * count[best], placed[best]))
    if not found:
        raise ValueError(f"{photograph.source}: no {name} was found: give its corners.")
    charts: list[np.ndarray] = []
    for _, corners in sorted(found, key=lambda one: -one[0]):
        if not any(_overlap(corners, other) for other in charts):
            charts.append(corners)
    return sorted(charts, key=lambda corners: -_area(corners))


def _masks(values: np.ndarray) -> Iterator[np.ndarray]:
    """(row, column) masks in whose connected regions patches may be."""
    from skimage.filters import gaussian, sobel, threshold_local

    top = np.maximum(np.percentile(values, 99, axis=(0, 1)), 1e-12)
    planes = np.moveaxis(np.clip(values / top, 0.0, 1.0) ** (1 / 2.2), 2, 0)
    planes = [gaussian(plane, 1.0) for plane in (planes.mean(axis=0), *planes)]
    for plane in planes:
        for share in (6, 12, 24):
            size = 2 * (max(plane.shape) // (2 * share)) + 1
            yield plane > threshold_local(plane, size)
    edges = np.max([sobel(plane) for plane in planes], axis=0)
    for level in (0.6, 0.75, 0.85):
        yield edges < np.quantile(edges, level)


def _square_regions(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (region, 2), column and row, and sides of the regions that may be patches."""
    from skimage.measure import label, regionprops
    from skimage.morphology import erosion

    regions = regionprops(label(erosion(mask, np.ones((3, 3), dtype=bool)), connectivity=1))
    most = mask.size / (_ROWS * _COLUMNS)
    good = [
        region
        for region in regions
        if 36 <= region.area <= most and region.eccentricity < 0.85 and region.solidity > 0.85
    ]
    centres = np.array([region.centroid[::-1] for region in good]).reshape(-1, 2)
    return centres, np.sqrt([region.area for region in good]) + 2.0  # what erosion took


def _grids(
    centres: np.ndarray, sides: np.ndarray, fewest: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(candidate, 4, 2) corners of charts in each grid of at least `fewest` regions, and
    (candidate,) how many regions each contains."""
    from skimage.transform import ProjectiveTransform

    used = np.zeros(len(centres), dtype=bool)
    for seed in np.argsort(-sides):
        if used[seed]:
            continue
        grid = _grown(int(seed), centres, sides)
        if len(grid) < fewest:
            continue
        used[list(grid.values())] = True
        at, members = np.array(list(grid), dtype=float), np.array(list(grid.values()))
        to_picture = ProjectiveTransform.from_estimate(at, centres[members])
        if not to_picture:
            continue
        off = np.linalg.norm(to_picture(at) - centres[members], axis=1)
        close = off < 0.15 * np.median(sides[members])
        if close.sum() < fewest:
            continue
        at = at[close]
        to_picture = ProjectiveTransform.from_estimate(at, centres[members][close])
        boxes = []
        for across, down in ((_COLUMNS, _ROWS), (_ROWS, _COLUMNS)):
            for u in range(int(at[:, 0].min()) - 2, int(at[:, 0].max()) + 1):
                for v in range(int(at[:, 1].min()) - 2, int(at[:, 1].max()) + 1):
                    inside = np.all((at >= (u, v)) & (at < (u + across, v + down)), axis=1)
                    boxes.append((int(inside.sum()), u, v, across, down))
        most = max(count for count, *_ in boxes)
        candidates, counts = [], []
        for count, u, v, across, down in boxes:
            if count >= max(most - 2, fewest):
                box = np.array([[u, v], [u + across, v], [u + across, v + down], [u, v + down]])
                corners = to_picture(box - 0.5)
                first = 0 if across == _COLUMNS else 1
                candidates += [np.roll(corners, -k, axis=0) for k in (first, first + 2)]
                counts += [count, count]
        if candidates:
            yield np.stack(candidates), np.array(counts)


def _grown(seed: int, centres: np.ndarray, sides: np.ndarray) -> dict[tuple[int, int], int]:
    """Place in the grid -> region, grown from one region by its neighbours' offsets.

    The offsets to the right and downwards are taken anew at every region, so that the grid may
    follow a perspective.
    """
    away = centres - centres[seed]
    far = np.linalg.norm(away, axis=1)
    alike = (sides > 0.6 * sides[seed]) & (sides < 1.7 * sides[seed])
    near = np.flatnonzero(alike & (far > 0.9 * sides[seed]) & (far < 1.8 * sides[seed]))
    best: dict[tuple[int, int], int] = {}
    for one in near:
        for other in near:
            a, b = away[one], away[other]
            turn = (a[0] * b[1] - a[1] * b[0]) / (far[one] * far[other])
            if turn < 0.85 or not 0.6 < far[one] / far[other] < 1.7:  # some 60 to 120 degrees
                continue
            grid = _followed(seed, a, b, centres, alike)
            if len(grid) > len(best):
                best = grid
        if len(best) >= _ROWS * _COLUMNS:
            break
    return best


def _followed(seed, right, down, centres, alike) -> dict[tuple[int, int], int]:
    grid, taken = {(0, 0): int(seed)}, {int(seed)}
    waiting = [((0, 0), right, down)]
    while waiting:
        (u, v), right, down = waiting.pop(0)
        here = centres[grid[u, v]]
        for step, offset in (((1, 0), right), ((-1, 0), -right), ((0, 1), down), ((0, -1), -down)):
            place = (u + step[0], v + step[1])
            if place in grid or max(abs(place[0]), abs(place[1])) > 2 * _COLUMNS:
                continue
            miss = np.linalg.norm(centres - (here + offset), axis=1)
            miss[~alike] = np.inf
            region = int(np.argmin(miss))
            if miss[region] < 0.25 * np.linalg.norm(offset) and region not in taken:
                grid[place] = region
                taken.add(region)
                moved = (centres[region] - here) * (step[0] + step[1])
                waiting.append((place, moved, down) if step[0] else (place, right, moved))
    return grid


def _overlap(corners: np.ndarray, other: np.ndarray) -> bool:
    """Whether the middle of one chart lies in the other."""
    from skimage.measure import points_in_poly

    return bool(
        points_in_poly(corners.mean(axis=0)[None], other)[0]
        or points_in_poly(other.mean(axis=0)[None], corners)[0]
    )


def _area(corners: np.ndarray) -> float:
    """Twice the area inside; positive when the corners go around clockwise on the screen."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
