"""How many layers a cast holds, and whether what a fit leaves over looks like noise."""

import numpy as np

from fitting.observations.profile_sensor import MIN_DEPTHS
from fitting.profile.kd.band_fit import RELATIVE_NOISE
from fitting.profile.kd.noise_statistics import (
    correlation_of_neighbours,
    forward_fill,
    previous_used,
    running_median,
    runs_p,
    whiten,
)

_MAX_LAYERS = 4
_CANDIDATES = 60
_OUTLIER = 5.0
_STEPS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
_THINNEST = 0.1
_STRONG = 6.0
_LEAST_P = 0.01


def choose_interfaces(
    depth: np.ndarray, light: np.ndarray, floor: np.ndarray, mask: np.ndarray, layers: int | None
) -> np.ndarray:
    """Depths (m) between `layers` layers, None: the fewest that suffice, up to four.

    They suffice when more would not lower the Bayes information criterion by more than 6 (strong
    evidence: Kass & Raftery 1995) and the residuals pass the runs test (p > 0.01).

    `light` (depth, wl): Ed less darkness, over the light above; `mask` (depth, wl).  All bands
    share the interfaces.  A layer holds at least `MIN_DEPTHS` samples and a tenth of the range:
    thinner ones would describe single waves.  Greedy forward selection with coordinate-wise
    refinement on sample depths, then one-dimensional minimisation between them.  Waves are
    correlated over depth and shared by the bands: the criterion whitens the noise with the length
    that the residuals of the most layers show, and counts the independent bands.

    **Raises** ValueError if the samples do not suffice for so many layers.
    """
    used = depth[mask.any(axis=1)]
    cast = piecewise_linear_fit(depth, light, floor, mask)
    found = _search(cast, used, layers or _MAX_LAYERS)
    cast.estimate_correlation_length(found[-1])
    if cast.length > 0:
        found = _search(cast, used, layers or _MAX_LAYERS)
    if layers is not None:
        if len(found) < layers:
            raise ValueError(
                f"layers is {layers}, but {len(used)} usable depths allow {len(found)}: each "
                f"layer needs at least {MIN_DEPTHS} and a tenth of the range."
            )
        return _refine_between_samples(cast, used, found[-1])
    scores = np.array([cast.criterion(one) for one in found])
    fewest = int(np.argmax(scores <= scores.min() + _STRONG))
    for one in found[fewest:]:
        if cast.looks_random(one):
            return _refine_between_samples(cast, used, one)
    return _refine_between_samples(cast, used, found[fewest])


def line_fit(depth, light, floor, mask, interfaces) -> tuple[np.ndarray, np.ndarray, float]:
    """Intercept and slope of ln light in each layer of one band, their covariance, and degrees of
    freedom; (depth, 1) arrays, weighted and whitened as in `choose_interfaces`."""
    cast = piecewise_linear_fit(depth, light, floor, mask)
    cast.estimate_correlation_length(interfaces)
    design, y, normal = cast.normal_equations(interfaces, cast.length)
    inverse = np.linalg.inv(normal[0])
    beta = inverse @ (design[0].T @ y[0])[:, 0]
    left = y[0][:, 0] - design[0] @ beta
    dof = max(float(cast.count[0]) - len(beta), 1.0)
    return beta, inverse * (left @ left) / dof, dof


def piecewise_linear_fit(depth, light, floor, mask) -> "PiecewiseLinearFit":
    safe = np.where(mask & (light > 0), light, 1.0)
    weight = np.where(mask & (light > 0), safe**2, 0.0)
    weight = weight / (safe**2 + (floor / RELATIVE_NOISE) ** 2)
    weight = np.where(_outliers(np.log(safe), weight > 0), 0.0, weight)
    return PiecewiseLinearFit(depth, np.log(safe), weight)


def _search(cast: "PiecewiseLinearFit", used: np.ndarray, most: int) -> list[list[float]]:
    """The best interfaces for 1, 2 ... layers, as far as layers stay thick enough."""
    places = _places(used)
    found: list[list[float]] = [[]]
    while len(found) < most:
        better = _forward_selection(cast, used, found[-1], places)
        if not better:
            break
        found.append(better)
    return found


def _places(used: np.ndarray) -> np.ndarray:
    places = np.unique(used)[MIN_DEPTHS:-MIN_DEPTHS]
    if len(places) > _CANDIDATES:
        places = places[np.linspace(0, len(places) - 1, _CANDIDATES).round().astype(int)]
    return places


def _refine_between_samples(
    cast: "PiecewiseLinearFit", used: np.ndarray, interfaces: list[float]
) -> np.ndarray:
    """Each interface moved, between the candidates beside it, to where the misfit is least."""
    places, best = _places(used), list(interfaces)
    for i in [*range(len(best))] * (2 if len(best) > 1 else 1):
        at = int(np.argmin(np.abs(places - best[i])))
        low, high = places[max(at - 1, 0)], places[min(at + 1, len(places) - 1)]
        place = _least(_with(cast, best, i), low, high)
        moved = [*best[:i], place, *best[i + 1 :]]
        if _layers_thick_enough(used, moved) and cast.misfit(moved) <= cast.misfit(best):
            best = moved
    return np.array(best)


def _with(cast: "PiecewiseLinearFit", interfaces: list[float], i: int):
    return lambda place: cast.misfit([*interfaces[:i], place, *interfaces[i + 1 :]])


def _least(function, low: float, high: float) -> float:
    """Where a function is least between two places, to a fiftieth of their distance (Brent)."""
    from scipy.optimize import fminbound

    return float(np.asarray(fminbound(function, low, high, xtol=0.02 * (high - low))))


def _outliers(log_light: np.ndarray, mask: np.ndarray) -> np.ndarray:
    if len(log_light) < 9:
        return np.zeros_like(mask)
    flat = forward_fill(log_light, mask)
    apart = np.where(mask, np.abs(flat - running_median(flat)), np.nan)
    # Half of the samples are their own neighbourhood's median: the scale comes from the rest.
    apart = np.where(apart == 0, np.nan, apart)
    scale = [1.4826 * np.nanmedian(a) if np.isfinite(a).any() else np.inf for a in apart.T]
    return np.nan_to_num(apart) > _OUTLIER * np.array(scale)


def _forward_selection(cast: "PiecewiseLinearFit", used, interfaces, places) -> list[float]:
    """The best interfaces with one more; [] where layers would be too thin."""

    def best_place(others) -> tuple[float, list[float]]:
        tried = [sorted([*others, float(place)]) for place in places]
        tried = [one for one in tried if _layers_thick_enough(used, one)]
        scores = [cast.misfit(one) for one in tried]
        return min(zip(scores, tried, strict=True), default=(np.inf, []))

    found = best_place(interfaces)
    for _ in range(2 if interfaces else 0):
        for i in range(len(found[1])):
            found = min(found, best_place(found[1][:i] + found[1][i + 1 :]))
    return found[1]


def _layers_thick_enough(used, interfaces) -> bool:
    edges = [used[0], *interfaces, used[-1]]
    counts = np.histogram(used, [-np.inf, *interfaces, np.inf])[0]
    thick = np.min(np.diff(edges)) >= _THINNEST * (used[-1] - used[0])
    return bool(np.all(counts >= MIN_DEPTHS)) and bool(thick)


class PiecewiseLinearFit:
    """Continuous straight lines through ln Ed of all bands, bent at shared interfaces.

    `length`: m over which the noise is correlated, found by `estimate_correlation_length`.
    """

    def __init__(self, depth, log_light, weight):
        self.depth, self.log_light, self.weight = depth, log_light, weight
        self.used = weight > 0
        self.count = np.maximum(self.used.sum(axis=0), 1)
        self.length, self.bands = 0.0, float(len(self.count))
        self.before, self.first = previous_used(self.used)
        self.gap = depth[:, None] - depth[self.before]

    def _rho(self, length):
        rho = correlation_of_neighbours(self.gap, np.asarray(length))
        return np.where(self.first | ~self.used, 0.0, rho)

    def whiten(self, columns, length):
        """`columns` (depth, wl, ...) with the part that the sample before tells removed."""
        return whiten(columns, self.before, self._rho(length))

    def normal_equations(self, interfaces, length):
        """Whitened design (wl, depth, unknown) and data (wl, depth, 1), and normal matrices."""
        edges = np.array([0.0, *interfaces, np.inf])
        path = np.clip(self.depth[:, None] - edges[None, :-1], 0.0, np.diff(edges)[None, :])
        columns = np.concatenate([np.ones_like(path[:, :1]), path], axis=1)
        root = np.sqrt(self.weight)
        all_columns = np.concatenate(
            [columns[:, None, :] * root[:, :, None], (root * self.log_light)[:, :, None]], axis=2
        )
        if length > 0:
            all_columns = np.where(self.used[:, :, None], self.whiten(all_columns, length), 0.0)
        by_band = all_columns.transpose(1, 0, 2)
        design, y = by_band[:, :, :-1], by_band[:, :, -1:]
        turned = design.transpose(0, 2, 1)
        normal, size = turned @ design, len(edges)
        ridge = 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(size)
        return design, y, normal + ridge

    def _solved(self, interfaces, length):
        """Whitened residual (depth, wl) and ln det of each band's normal matrix."""
        design, y, normal = self.normal_equations(interfaces, length)
        left = y - design @ np.linalg.solve(normal, design.transpose(0, 2, 1) @ y)
        return left[:, :, 0].T, np.linalg.slogdet(normal)[1]

    def misfit(self, interfaces) -> float:
        """Minus twice the log likelihood, the noise of each band free."""
        left, _ = self._solved(interfaces, self.length)
        square = (left**2).sum(axis=0) / self.count
        return float(np.sum(self.count * np.log(np.maximum(square, 1e-12))))

    def estimate_correlation_length(self, interfaces) -> None:
        """Find the length by restricted likelihood, then the number of independent bands."""
        spacing = np.median(self.gap[self.used & ~self.first & (self.gap > 0)])
        reach = self.depth[self.used.any(axis=1)]
        lengths = [
            s * spacing for s in _STEPS if s * spacing <= (reach[-1] - reach[0]) / 8 or not s
        ]
        scores = []
        for length in lengths:
            left, volume = self._solved(interfaces, length)
            freedom = np.maximum(self.count - 2.0 - 2.0 * len(interfaces), 1.0)
            square = np.maximum((left**2).sum(axis=0), 1e-24)
            rest = np.log1p(-(self._rho(length) ** 2)).sum(axis=0)
            scores.append(float(np.sum(freedom * np.log(square) + rest + volume)))
        self.length = lengths[int(np.argmin(scores))]
        left, _ = self._solved(interfaces, self.length)
        scaled = left / np.maximum(np.sqrt((left**2).sum(axis=0)), 1e-300)
        count = len(self.count)
        shared = np.sum((scaled.T @ scaled) ** 2) - count - count * (count - 1) / self.count.mean()
        self.bands = count**2 / (count + max(shared, 0.0))

    def criterion(self, interfaces) -> float:
        """Bayes information criterion of the independent samples and bands."""
        unknowns = self.bands * (2 + len(interfaces)) + len(interfaces)
        telling = self.bands / len(self.count)
        return telling * self.misfit(interfaces) + unknowns * np.log(telling * self.count.sum())

    def looks_random(self, interfaces) -> bool:
        """Whether the residuals of every band pass the runs test, bands counted as independent."""
        left, _ = self._solved(interfaces, self.length)
        worst = min(
            runs_p(np.where(used, r, np.nan)) for r, used in zip(left.T, self.used.T, strict=True)
        )
        return bool(worst > _LEAST_P / self.bands)
