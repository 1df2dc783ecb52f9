"""ColorCheckers found in a photograph by themselves, through colour-checker-detection."""

import warnings

import numpy as np
from jaxtyping import Float

from fitting.images.chart_reading import agreements
from fitting.images.chart_targets import target
from fitting.images.photograph_file import Photograph

# Rank agreement below which what was found is taken for no chart.
_LEAST = 0.5


def find_charts(photograph: Photograph) -> list[Float[np.ndarray, "4 2"]]:
    """Corners of the ColorCheckers of 24 patches in a photograph, the largest first.

    Each is (4, 2), column and row in pixels, in the chart's own order as
    `fitting.images.chart_reading.read_chart` takes them.  Outlines are found by segmentation in a
    copy for the
    screen (every channel to the same brightness, gamma 2.2); which corner is which is told by the
    known order of the patches' values, and what follows it in no orientation is left out.

    Raises ValueError where the extra is not installed or no chart is found.
    """
    try:
        from colour_checker_detection import (  # pyright: ignore[reportMissingImports]
            detect_colour_checkers_segmentation as detect,
        )
    except ImportError:
        raise ValueError(
            "finding charts needs colour-checker-detection: pip install 'oceaninv[detect]', or "
            "give the corners."
        ) from None
    values = np.nan_to_num(np.asarray(photograph.values, dtype=float))
    top = np.maximum(np.percentile(values, 99.5, axis=(0, 1)), 1e-12)
    proxy = np.clip(values / top, 0.0, 1.0) ** (1 / 2.2)
    rows, columns = proxy.shape[:2]
    upright = rows > columns  # which the library would turn by itself
    if upright:
        proxy = np.ascontiguousarray(np.rot90(proxy))
    with warnings.catch_warnings():
        # It warns of what it does not find; that is said below.
        warnings.simplefilter("ignore")
        found = detect(proxy.astype(np.float32), additional_data=True, working_width=1440)
    scale, chart = proxy.shape[1] / 1440.0, target("ColorChecker24")
    corners = []
    for one in found:
        places = (np.asarray(one.quadrilateral, dtype=float) + 0.5) * scale - 0.5
        if upright:
            places = np.stack([columns - 1.0 - places[:, 1], places[:, 0]], axis=1)
        places = np.clip(places, 0.0, [columns - 1.0, rows - 1.0])
        if _area(places) < 0:
            places = places[::-1]
        turned = [np.roll(places, -k, axis=0) for k in range(4)]
        scores = agreements(photograph, turned, chart)
        if max(scores) >= _LEAST:
            corners.append(turned[int(np.argmax(scores))])
    if not corners:
        raise ValueError(
            f"{photograph.source}: no ColorChecker of 24 patches was found: give its corners."
        )
    return sorted(corners, key=lambda c: -_area(c))


def _area(corners: np.ndarray) -> float:
    """Twice the area inside; positive when the corners go around clockwise on the screen."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
