"""Kd that changes smoothly with depth, beside the layers that would do as well."""

import dataclasses
import json

import numpy as np

from fitting.core.batched_least_squares import gauss_newton_with_noise
from fitting.core.result import Quantity
from fitting.observations.profile import Profile
from fitting.profile.kd.cast import FitWindow, cast_of, light_of
from fitting.profile.kd.layer_selection import piecewise_linear_fit

KNOTS = 20
# How far ln Kd bends, as the standard deviation of its second difference from knot to knot.
_BENDS = 10.0 ** np.linspace(-4.0, 0.5, 19)
# Of the search: steps at most, and the largest change of a coordinate (ln) in one.
_ROUNDS, _LONGEST = 30, 0.7
_CUT = 4.0


@dataclasses.dataclass(frozen=True)
class SmoothKd:
    """Kd at depths.

    - `depth`: (knot,) m, from the surface to the deepest sample used; between them Kd goes
      linearly.
    - `Kd`: a `Quantity` (knot, wl), 1/m.
    - `evidence`: how much likelier the samples are with a smooth Kd than with the layers of
      `fit_profile(layers=None)`, natural logarithm, all bands; beyond +-3 strong (Kass & Raftery
      1995).
    - `bend`: (wl,) standard deviation of the second difference of ln Kd between knots.
    - `interfaces`: m, of those layers.
    """

    depth: np.ndarray
    wavelength: np.ndarray
    Kd: Quantity
    evidence: float
    bend: np.ndarray
    interfaces: np.ndarray

    def content(self) -> tuple[dict, dict, dict]:
        """Variables, coordinates and attributes of a CF file."""
        low, high = self.Kd.interval()
        notes = {"units": self.Kd.unit, "long_name": self.Kd.long_name}
        axes = ("depth", "wavelength")
        data: dict = {"Kd": (axes, self.Kd.value, notes)}
        for name, words, value in (("Kd_low", "2.5 %", low), ("Kd_high", "97.5 %", high)):
            data[name] = (axes, value, notes | {"long_name": f"{self.Kd.long_name}, {words}"})
        text = "standard deviation of the second difference of ln Kd between depths"
        data["bend"] = (("wavelength",), self.bend, {"units": "1", "long_name": text})
        wave = {"units": "nm", "standard_name": "radiation_wavelength"}
        deep = {"units": "m", "standard_name": "depth", "positive": "down", "axis": "Z"}
        coords = {
            "depth": ("depth", self.depth, deep),
            "wavelength": ("wavelength", self.wavelength, wave),
        }
        attributes = {
            "title": "Kd that changes smoothly with depth by oceaninv",
            "evidence_against_layers": self.evidence,
            "interfaces_of_layers_m": json.dumps(self.interfaces.tolist()),
        }
        return data, coords, attributes


def smooth_kd(profile: Profile, depth_range: tuple[float, float] | None = None) -> SmoothKd:
    """Kd(z) of every band under a smoothness prior whose strength the data choose.

    ln Kd at `KNOTS` depths has independent normal second differences (a cubic smoothing spline's
    prior, Wahba 1978, in steps) and is otherwise free; their deviation is averaged over by its
    evidence, in Laplace's approximation.  Waves that are correlated over depth, as `fit_profile`
    finds them, are whitened, outliers left out.  No model of the water: for intervals of the mean
    Kd, and for upward light, take `fit_profile`.

    **Arguments:** as for `fit_profile`.
    """
    window = cast_of(profile, depth_range, None).window
    deepest = float(profile.depth[window.rows - 1])
    knots = np.linspace(0.0, deepest, KNOTS)
    columns = [_band(window, i, knots) for i in range(len(profile.wavelength))]
    ln_kd, sd, dof, bend, smooth, layered = (
        np.stack(rows, axis=-1) for rows in zip(*columns, strict=True)
    )
    text = "diffuse attenuation coefficient at a depth"
    wide = np.broadcast_to(dof, sd.shape)
    return SmoothKd(
        knots,
        profile.wavelength,
        Quantity(np.exp(ln_kd), sd, "m-1", text, dof=wide),
        float(np.sum(smooth - layered)),
        bend,
        window.interfaces,
    )


def _paths(depth: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """(depth, knot) integrals from the surface to each depth of the hats on the knots."""
    step = knots[1] - knots[0]
    place = np.clip((depth[:, None] - knots[None, :]) / step, -1.0, 1.0)
    rising = np.where(place < 0, 0.5 * (1.0 + place) ** 2, 0.5 + place - 0.5 * place**2)
    # Half of the first hat lies above the surface.
    rising[:, 0] -= 0.5
    return step * rising


def _band(window: FitWindow, band: int, knots: np.ndarray):
    """ln Kd and its deviation at the knots, degrees of freedom, bend, evidence of both models."""
    profile, keep = window.profile, window.mask[:, band]
    lines = piecewise_linear_fit(
        profile.depth,
        light_of(profile)[:, band : band + 1],
        profile.floor[band : band + 1],
        keep[:, None],
    )
    lines.estimate_correlation_length(window.interfaces)
    y, weight = lines.log_light[:, 0], np.sqrt(lines.weight[:, 0])
    path = _paths(profile.depth, knots)
    design, data, normal = lines.normal_equations(window.interfaces, lines.length)
    beta = np.linalg.solve(normal[0], design[0].T @ data[0])[:, 0]
    left = data[0][:, 0] - design[0] @ beta
    count, size = int(lines.count[0]), len(beta)
    square = float(left @ left)
    # With the interfaces as unknowns; both evidences lack the same constants.
    unknowns = size + len(window.interfaces)
    layered = -0.5 * (count * (np.log(square / count) + 1.0) + unknowns * np.log(count))

    def whitened(columns):
        scaled = lines.whiten((columns * weight[:, None])[:, None, :], lines.length)[:, 0]
        return np.where(lines.used[:, 0][:, None], scaled, 0.0)

    bends = np.diff(np.eye(len(knots)), 2, axis=0)
    start = np.full(len(knots), np.log(max(float(np.mean(beta[1:] * -1.0)), 1e-4)))
    x = np.concatenate([beta[:1], start])
    # What the prior leaves free: Ed(0-), and ln Kd's mean and trend.
    free_of = np.zeros((len(knots) + 1, 3))
    free_of[0, 0] = 1.0
    free_of[1:, 1:] = np.linalg.qr(np.vander(np.arange(float(len(knots))), 2))[0]
    # Its normalisation, without the bend's part.
    volume = 0.5 * np.linalg.slogdet(bends @ bends.T)[1]
    found = []
    for bend in _BENDS:
        rows = np.concatenate([np.zeros((len(bends), 1)), bends / bend], axis=1)
        x, covariance, evidence, free, told = _search(
            x, y, path, rows, whitened, count, square / count
        )
        # A prior worth one sample on what is free, as in the Bayes information criterion.
        unit = 0.5 * np.linalg.slogdet(free_of.T @ told @ free_of / count)[1]
        evidence += unit + volume - len(rows) * np.log(bend)
        found.append((x, covariance, evidence, free))
    evidence = np.array([f[2] for f in found])
    # Even prior over the logarithm of the bend.
    highest = evidence.max()
    share = np.exp(evidence - highest)
    total = highest + np.log(share.mean())
    share /= share.sum()
    mean = share @ np.stack([f[0] for f in found])
    spread = sum(
        s * (f[1] + np.outer(f[0] - mean, f[0] - mean)) for s, f in zip(share, found, strict=True)
    )
    sd = np.sqrt(np.diag(spread))[1:]
    dof = float(share @ [f[3] for f in found])
    return mean[1:], sd, dof, float(np.exp(share @ np.log(_BENDS))), total, layered


def _search(x, y, path, rows, whitened, count: int, variance: float):
    """The mode for one bend, its covariance, the evidence up to the prior's factor, degrees of
    freedom left, and what the samples tell."""

    def linear(x):
        Kd = np.exp(np.clip(x[1:], -12.0, 4.0))
        slopes = whitened(np.concatenate([np.ones((len(y), 1)), -path * Kd], axis=1))
        return slopes, whitened((y - x[0] + path @ Kd)[:, None])[:, 0]

    found = gauss_newton_with_noise(linear, x, rows, count, variance, _LONGEST, _ROUNDS)
    volume = np.linalg.slogdet(found.information)[1]
    pull = rows @ found.x
    square = float(found.left @ found.left) / found.variance
    evidence = -0.5 * (count * np.log(found.variance) + square + pull @ pull + volume)
    told = found.slopes.T @ found.slopes / found.variance
    return found.x, found.covariance, evidence, found.freedom, told
