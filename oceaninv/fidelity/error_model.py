"""The expected error of each candidate transport, fitted to random scenes.

The logarithm of a transport's error in one band is a smooth function of nine cheap numbers of the
water and the light: a plane, plus Gaussians about bands that represent all random scenes (a
Gaussian process with few inducing points; Quinonero-Candela & Rasmussen 2005).  The error of a
scene is the maximum or the mean over its bands, plus a margin.  With this margin, plans for scenes
that were not used in the fit kept their tolerance in 96 % of cases or more.
`tests/acceptance/plan.py` fits the numbers and tests them on scenes of another seed.
"""

import csv
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from oceaninv.scene.scene import Scene
from oceaninv.water.iops import IOPs
from oceaninv.water.phase import AbstractPhase, backscatter_ratio_of

DATA = Path(__file__).with_name("errors.csv")
CENTRES = Path(__file__).with_name("centres.csv")
WIDTH = 3.0  # of a Gaussian, in spreads
LEVEL = np.log(100.0)  # irradiance counts down to the 1 % level
ERROR_FLOOR = 5e-4  # added to each error before its logarithm is fitted


class Bands(NamedTuple):
    """Cheap numbers of a water under a light; arrays are (wl,)."""

    a: np.ndarray
    b: np.ndarray
    bb: np.ndarray
    cosine: float  # of the sun in the water
    sky: np.ndarray  # its share of Ed(0-)
    kd: np.ndarray  # effective, 1/m
    light: np.ndarray  # Ed(0-)


class ErrorModel(NamedTuple):
    """The error of one transport: coefficients of the features, and the margin of ln(error)."""

    coefficients: np.ndarray
    margin: float
    seconds: float  # per scene of the training set


def concrete(value, name: str) -> np.ndarray:
    """A concrete array as numpy; ValueError inside jit."""
    try:
        return np.asarray(value, dtype=float)
    except Exception as error:
        raise ValueError(
            f"plan needs the values of {name}: call it outside jit, vmap and grad."
        ) from error


class ObservedWater(NamedTuple):
    """One water of a scene, and the depths at which its light is asked for: (wl,) m, as
    `depths_of` gives them."""

    bands: Bands
    at: np.ndarray

    def select(self, pick: np.ndarray) -> "ObservedWater":
        """The same for some of the bands."""
        a, b, bb, cosine, sky, kd, light = self.bands
        some = Bands(a[pick], b[pick], bb[pick], cosine, sky[pick], kd[pick], light[pick])
        return ObservedWater(some, self.at[pick])


def observed_waters(
    scene: Scene, quantity: str, depth: float | None, known: Sequence[ObservedWater] = ()
) -> list[ObservedWater]:
    """One for each water of a scene; `known`: those of the same waters under another light."""
    waters = (scene.water,) if isinstance(scene.water, IOPs) else scene.water.iops
    optics = [one.bands[:3] for one in known] or map(_absorption_and_scattering, waters)
    parts = [_band_numbers(scene, *three) for three in optics]
    return [ObservedWater(bands, depths_of(bands, scene, quantity, depth)) for bands in parts]


def bands_of(scene: Scene, water: IOPs) -> Bands:
    """The numbers from which the features are computed, in numpy, so that nothing compiles."""
    return _band_numbers(scene, *_absorption_and_scattering(water))


def _absorption_and_scattering(water: IOPs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a, b and bb."""
    a = concrete(water.a_components, "the water").sum(axis=0)
    rows = concrete(water.b_components, "the water")
    ratios = np.array([_backscatter(phase) for phase in water.phases])
    return a, rows.sum(axis=0), ratios @ rows


def _band_numbers(scene: Scene, a: np.ndarray, b: np.ndarray, bb: np.ndarray) -> Bands:
    # Attribute access on modules is slow, and a plan must cost little beside one cheap run.
    light, surface = scene.light, scene.surface
    direct, diffuse = concrete(light.direct, "the light"), light.diffuse
    cosine = float(np.cos(np.radians(concrete(light.zenith, "the light"))))
    through, inside = 1.0, cosine
    if surface is not None:
        index = concrete(surface.index, "the surface")
        inside = float(np.sqrt(1.0 - (1.0 - cosine**2) / index**2))
        through = 0.97
    sun = through * cosine * direct
    sky = np.zeros_like(sun)
    if diffuse is not None:
        sky = np.pi * 0.93 * concrete(diffuse, "the light")
    total = sun + sky
    share = np.where(total > 0, sky / np.where(total > 0, total, 1.0), 0.0)
    w = b / np.maximum(a + b, 1e-300)
    steep = (1 - share) / inside + 1.162 * share
    near = (1.005 * a + 2.407 * bb) * steep
    deep = (1 + 0.634 * w) * np.sqrt(a * (a + 0.569 * w * a + 1.163 * bb + 0.032 * w * b))
    return Bands(a, b, bb, inside, share, np.maximum(0.5 * (near + deep), 1e-9), total)


def _backscatter(phase: AbstractPhase) -> float:
    leaves, tree = jax.tree.flatten(phase)
    arrays = (concrete(leaf, "the phase functions") for leaf in leaves)
    return _ratio(tree, tuple((array.shape, array.tobytes()) for array in arrays))


@functools.lru_cache(maxsize=256)
def _ratio(tree, leaves: tuple[tuple[tuple[int, ...], bytes], ...]) -> float:
    """Backscatter ratio of a flattened phase function, cached because scenes share them."""
    arrays = [np.frombuffer(content).reshape(shape) for shape, content in leaves]
    return float(backscatter_ratio_of(jax.tree.unflatten(tree, arrays)))


def floor_reach(bands: Bands, scene: Scene, depth: np.ndarray) -> np.ndarray:
    """(wl,) light that the floor reflects back to `depth`, over the downward light there."""
    if scene.floor is None:
        return np.zeros_like(bands.a)
    bottom = float(concrete(scene.floor.depth, "the floor"))
    reflectance = concrete(scene.floor.reflectance, "the floor")
    return reflectance * np.exp(-2.0 * bands.kd * np.maximum(bottom - depth, 0.0))


def features(bands: Bands, scene: Scene, depth: np.ndarray) -> np.ndarray:
    """(wl, feature) for light seen from `depth` (wl,) m, or computed down to it."""
    x = cheap_numbers(bands, scene, depth)
    return np.concatenate([np.ones((len(x), 1)), x, gaussians(x, centres())], axis=1)


def cheap_numbers(bands: Bands, scene: Scene, depth: np.ndarray) -> np.ndarray:
    """(wl, 9) inputs of the error models, scaled to a mean of about 0 and a spread of about 1."""
    b = np.maximum(bands.b, 1e-12)
    w = b / (bands.a + b)
    below = np.inf if scene.floor is None else float(concrete(scene.floor.depth, "the floor"))
    base = (
        w,
        np.log(1.0 - w + 1e-2),
        np.log(np.clip(bands.bb / b, 1e-3, 0.5)),
        np.full_like(w, 1.0 / bands.cosine),
        bands.sky,
        np.clip(bands.kd * depth, 0.0, LEVEL),
        np.log(floor_reach(bands, scene, depth) + 1e-2),
        np.log(np.clip((bands.a + b) * depth, 0.0, 100.0) + 0.05),
        np.log(np.clip(bands.kd * (below - depth), 0.0, 10.0) + 0.05),
    )
    return (np.stack(base, axis=1) - _MIDDLE) / _SPREAD


# Approximate mean and standard deviation of the cheap numbers over random scenes.
_MIDDLE = np.array([0.7, -1.0, -4.0, 1.2, 0.1, 2.0, -4.0, 0.8, 0.7])
_SPREAD = np.array([0.25, 1.0, 0.5, 0.15, 0.15, 1.5, 0.8, 1.2, 1.6])


def gaussians(x: np.ndarray, about: np.ndarray) -> np.ndarray:
    """(row, centre) of numbers x (row, 9) and centres (centre, 9)."""
    squares = (x**2).sum(axis=1)[:, None] + (about**2).sum(axis=1) - 2.0 * x @ about.T
    return np.exp(-0.5 / WIDTH**2 * squares)


@functools.cache
def centres() -> np.ndarray:
    """(centre, 9) cheap numbers of bands that represent all random scenes."""
    return np.loadtxt(CENTRES, delimiter=",", comments="#", ndmin=2)


@functools.cache
def _calibration_limit() -> float:
    """The smallest value of the Gaussian about the nearest centre that is within calibration.

    No band of the calibration scenes is farther from a centre than the two closest centres are
    from each other.  Bands up to 1.5 times that distance away count as within calibration.
    """
    about = centres()
    squares = ((about[:, None, :] - about) ** 2).sum(axis=2) + np.diag(np.full(len(about), np.inf))
    return float(np.exp(-0.5 * (1.5 / WIDTH) ** 2 * squares.min()))


def out_of_calibration_range(waters: list["WaterFeatures"]) -> bool:
    """Whether the numbers of some band are far from those of all calibration scenes."""
    count = len(centres())
    return any(
        float(rows[:, -count:].max(axis=1).min()) < _calibration_limit() for _, rows in waters
    )


WaterFeatures = tuple[ObservedWater, np.ndarray]  # and its features


def features_of_waters(scene: Scene, found: list[ObservedWater]) -> list[WaterFeatures]:
    """The waters with their features, which are the same for every transport."""
    return [(one, features(one.bands, scene, one.at)) for one in found]


def depths_of(bands: Bands, scene: Scene, quantity: str, depth: float | None) -> np.ndarray:
    """(wl,) depth at which the light is asked for, m: the 1 % level or the floor, whichever is
    shallower, or the depth of the eye."""
    deepest = LEVEL / bands.kd
    if scene.floor is not None:
        deepest = np.minimum(deepest, float(concrete(scene.floor.depth, "the floor")))
    if quantity == "irradiance" or depth is None:
        return deepest
    return np.full_like(deepest, depth)


def weights_of(bands: Bands, depth: np.ndarray, channels: np.ndarray) -> np.ndarray:
    """(channel, wl) approximate share of each band in the signal of a channel."""
    seen = bands.light * np.exp(-np.minimum(bands.kd * depth, 50.0)) * bands.bb
    seen = seen / np.maximum(bands.a + bands.bb, 1e-300)
    part = np.abs(channels) * seen[None, :]
    return part / np.maximum(part.sum(axis=1, keepdims=True), 1e-300)


def combine(log_error: np.ndarray, bands: Bands, depth, quantity: str, channels) -> float:
    """ln of the error of a scene from those of its bands."""
    if quantity == "photograph":
        return float(np.log(np.max(weights_of(bands, depth, channels) @ np.exp(log_error))))
    if quantity == "radiance":
        # Bands with less than 1 % of their light at that depth are ignored.
        lit = bands.kd * depth <= 1.05 * LEVEL
        log_error = log_error[lit] if lit.any() else log_error
    return float(np.max(log_error))


@functools.cache
def error_models() -> dict[tuple[str, str], ErrorModel]:
    """The error models by quantity and label of the transport (`model_label`)."""
    found = {}
    with DATA.open(newline="") as file:
        for row in csv.reader(line for line in file if not line.startswith("#")):
            margin, seconds, *coefficients = (float(x) for x in row[2:])
            found[row[0], row[1]] = ErrorModel(np.array(coefficients), margin, seconds)
    return found


def predicted(quantity: str, model_label: str, waters: list[WaterFeatures], channels) -> float:
    """The expected error in the worst layer, margin included."""
    model = error_models()[quantity, model_label]
    worst = 0.0
    for (bands, at), rows in waters:
        scene_error = combine(rows @ model.coefficients, bands, at, quantity, channels)
        worst = max(worst, float(np.exp(np.clip(scene_error + model.margin, -16.0, 3.0))))
    return worst
