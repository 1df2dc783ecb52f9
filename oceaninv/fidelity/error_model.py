"""What each rung of the ladder is expected to get wrong, fitted to random scenes.

The logarithm of a rung's error in one band is a smooth function of nine cheap numbers of the water
and the light: a plane, and Gaussians about bands of random scenes that are spread over all that
occur (a Gaussian process with few inducing points; Quinonero-Candela & Rasmussen 2005).  That of a
scene is the worst or the mean over bands, plus a margin with which plans for scenes that a fit had
not seen kept their tolerance in 96 % or more.  `tests/acceptance/plan.py` fits the numbers, and
tests them on scenes of another seed.
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
LEAST = 5e-4  # errors below it are not told apart


class Bands(NamedTuple):
    """Cheap numbers of a water under a light, each (wl,) unless said."""

    a: np.ndarray
    b: np.ndarray
    bb: np.ndarray
    cosine: float  # of the sun in the water
    sky: np.ndarray  # its share of Ed(0-)
    kd: np.ndarray  # effective, 1/m
    light: np.ndarray  # Ed(0-)


class Model(NamedTuple):
    """The error of one rung: coefficients of the features, and the margin in ln."""

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


class Look(NamedTuple):
    """One water of a scene, and where it is looked at: (wl,) m, see `depths_of`."""

    bands: Bands
    at: np.ndarray

    def of(self, pick: np.ndarray) -> "Look":
        """Some of the bands."""
        a, b, bb, cosine, sky, kd, light = self.bands
        some = Bands(a[pick], b[pick], bb[pick], cosine, sky[pick], kd[pick], light[pick])
        return Look(some, self.at[pick])


def looks(
    scene: Scene, quantity: str, depth: float | None, known: Sequence[Look] = ()
) -> list[Look]:
    """One for each water of a scene; `known`: those of the same waters under another light."""
    waters = (scene.water,) if isinstance(scene.water, IOPs) else scene.water.iops
    optics = [look.bands[:3] for look in known] or map(_optics, waters)
    parts = [_lit(scene, *three) for three in optics]
    return [Look(bands, depths_of(bands, scene, quantity, depth)) for bands in parts]


def bands_of(scene: Scene, water: IOPs) -> Bands:
    """The numbers that everything here is made of, in numpy: nothing to compile."""
    return _lit(scene, *_optics(water))


def _optics(water: IOPs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a, b and bb."""
    a = concrete(water.a_components, "the water").sum(axis=0)
    rows = concrete(water.b_components, "the water")
    ratios = np.array([_backscatter(phase) for phase in water.phases])
    return a, rows.sum(axis=0), ratios @ rows


def _lit(scene: Scene, a: np.ndarray, b: np.ndarray, bb: np.ndarray) -> Bands:
    # Attributes of modules are slow to look up, and a plan must cost little beside one cheap run.
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
    """Backscatter ratio of a phase function taken apart: waters share them, choices recur."""
    arrays = [np.frombuffer(content).reshape(shape) for shape, content in leaves]
    return float(backscatter_ratio_of(jax.tree.unflatten(tree, arrays)))


def floor_reach(bands: Bands, scene: Scene, depth: np.ndarray) -> np.ndarray:
    """(wl,) light that the floor sends back to `depth`, per downward light there."""
    if scene.floor is None:
        return np.zeros_like(bands.a)
    bottom = float(concrete(scene.floor.depth, "the floor"))
    reflectance = concrete(scene.floor.reflectance, "the floor")
    return reflectance * np.exp(-2.0 * bands.kd * np.maximum(bottom - depth, 0.0))


def features(bands: Bands, scene: Scene, depth: np.ndarray) -> np.ndarray:
    """(wl, feature) for light looked at from `depth` (wl,) m, or down to it."""
    x = cheap_numbers(bands, scene, depth)
    return np.concatenate([np.ones((len(x), 1)), x, gaussians(x, centres())], axis=1)


def cheap_numbers(bands: Bands, scene: Scene, depth: np.ndarray) -> np.ndarray:
    """(wl, 9) numbers of which errors are functions, about 0 and of spread 1."""
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


# About the mean and the standard deviation of the cheap numbers over random scenes.
_MIDDLE = np.array([0.7, -1.0, -4.0, 1.2, 0.1, 2.0, -4.0, 0.8, 0.7])
_SPREAD = np.array([0.25, 1.0, 0.5, 0.15, 0.15, 1.5, 0.8, 1.2, 1.6])


def gaussians(x: np.ndarray, about: np.ndarray) -> np.ndarray:
    """(row, centre) of numbers x (row, 9) and centres (centre, 9)."""
    squares = (x**2).sum(axis=1)[:, None] + (about**2).sum(axis=1) - 2.0 * x @ about.T
    return np.exp(-0.5 / WIDTH**2 * squares)


@functools.cache
def centres() -> np.ndarray:
    """(centre, 9) cheap numbers of bands that are spread over all that occur."""
    return np.loadtxt(CENTRES, delimiter=",", comments="#", ndmin=2)


@functools.cache
def _covered() -> float:
    """The least that a Gaussian about the nearest centre is in scenes like those of the fit.

    Every band there lies as near to a centre as the two nearest centres to one another; here half
    as far again counts as alike.
    """
    about = centres()
    squares = ((about[:, None, :] - about) ** 2).sum(axis=2) + np.diag(np.full(len(about), np.inf))
    return float(np.exp(-0.5 * (1.5 / WIDTH) ** 2 * squares.min()))


def unlike(views: list["View"]) -> bool:
    """Whether some band has numbers far from those of all bands in which errors were measured."""
    count = len(centres())
    return any(float(rows[:, -count:].max(axis=1).min()) < _covered() for _, rows in views)


View = tuple[Look, np.ndarray]  # and its features


def views(scene: Scene, found: list[Look]) -> list[View]:
    """Looks with their features, which are the same for every rung."""
    return [(look, features(look.bands, scene, look.at)) for look in found]


def depths_of(bands: Bands, scene: Scene, quantity: str, depth: float | None) -> np.ndarray:
    """(wl,) where the light is looked at, m: to the 1 % level or the floor, or the eye's depth."""
    deepest = LEVEL / bands.kd
    if scene.floor is not None:
        deepest = np.minimum(deepest, float(concrete(scene.floor.depth, "the floor")))
    if quantity == "irradiance" or depth is None:
        return deepest
    return np.full_like(deepest, depth)


def weights_of(bands: Bands, depth: np.ndarray, channels: np.ndarray) -> np.ndarray:
    """(channel, wl) share of each band in what a channel sees, roughly."""
    seen = bands.light * np.exp(-np.minimum(bands.kd * depth, 50.0)) * bands.bb
    seen = seen / np.maximum(bands.a + bands.bb, 1e-300)
    part = np.abs(channels) * seen[None, :]
    return part / np.maximum(part.sum(axis=1, keepdims=True), 1e-300)


def combine(log_error: np.ndarray, bands: Bands, depth, quantity: str, channels) -> float:
    """ln of a scene's error from that of its bands."""
    if quantity == "photograph":
        return float(np.log(np.max(weights_of(bands, depth, channels) @ np.exp(log_error))))
    if quantity == "radiance":
        # Bands that have less than 1 % of their light there are not looked at.
        lit = bands.kd * depth <= 1.05 * LEVEL
        log_error = log_error[lit] if lit.any() else log_error
    return float(np.max(log_error))


@functools.cache
def models() -> dict[tuple[str, str], Model]:
    """By quantity and rung, as `repr` writes it."""
    found = {}
    with DATA.open(newline="") as file:
        for row in csv.reader(line for line in file if not line.startswith("#")):
            margin, seconds, *coefficients = (float(x) for x in row[2:])
            found[row[0], row[1]] = Model(np.array(coefficients), margin, seconds)
    return found


def predicted(quantity: str, rung: str, views: list[View], channels) -> float:
    """The expected error of the worst layer, with its margin."""
    model = models()[quantity, rung]
    worst = 0.0
    for (bands, at), rows in views:
        scene_error = combine(rows @ model.coefficients, bands, at, quantity, channels)
        worst = max(worst, float(np.exp(np.clip(scene_error + model.margin, -16.0, 3.0))))
    return worst
