"""The cheapest model of a scene that is good enough, and why."""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from oceaninv.fidelity import error_model as errors
from oceaninv.fidelity.scene_terms import Term, channel_weights, reduced_bands, reduced_scene
from oceaninv.foundation.spectrum import Response, generic_camera
from oceaninv.scene.camera import Camera
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import AbstractTransport
from oceaninv.transport.closed_form.four_stream import FourStream
from oceaninv.transport.closed_form.two_stream import TwoStream
from oceaninv.transport.monte_carlo.monte_carlo import MonteCarlo
from oceaninv.transport.plane_parallel.plane_parallel import PlaneParallel
from oceaninv.water.iops import IOPs

QUANTITIES = ("irradiance", "radiance", "photograph")
# Cheapest first.  KdTransport costs as much as TwoStream and is less accurate; it serves waters of
# which only Kd is known.
_CLOSED = (TwoStream(), FourStream())
CANDIDATES: Mapping[str, tuple[AbstractTransport, ...]] = {
    # Without lines of sight four streams cost half as much as two.
    "irradiance": (*_CLOSED[::-1], *(PlaneParallel(n, 1) for n in (4, 8, 16, 24, 32))),
    # Many steps of cost: with half as many orders as streams most scenes get a smaller error for
    # the same cost, and some a much larger one.
    "radiance": (
        *_CLOSED,
        *(PlaneParallel(n, m) for n, m in ((8, 6), (12, 6), (10, 10), (16, 8), (12, 12), (14, 12))),
        *(PlaneParallel(n, m) for n, m in ((16, 12), (20, 10), (20, 20), (28, 14), (24, 24))),
        *(PlaneParallel(n, m) for n, m in ((28, 28), (40, 20), (40, 40))),
    ),
    # A camera looks near the horizon, where half as many orders of azimuth suffice.
    "photograph": (
        *_CLOSED,
        *(PlaneParallel(n, m) for n, m in ((8, 6), (12, 6), (16, 8), (20, 10), (28, 14), (40, 20))),
    ),
}


@dataclasses.dataclass(frozen=True)
class Plan:
    """A choice and its reasons.

    - `transport`: the cheapest one that is expected to keep the tolerance.
    - `scene`: the scene to give it, without the terms and bands that do not matter.
    - `bands`: (wl,) nm of the remaining bands.
    - `terms`: by name, the most that each term of the scene contributes, and whether it is kept.
    - `predicted_error`: includes the dropped terms, and a margin such that the error stays below it
      in 95 % of similar scenes or more.
    - `why`: one sentence per decision.
    """

    transport: AbstractTransport
    scene: Scene
    bands: np.ndarray
    terms: Mapping[str, Term]
    predicted_error: float
    why: str

    def metadata(self, tolerance: float) -> dict:
        """What an output file states about the choice."""
        return {
            "transport": model_label(self.transport),
            "tolerance": tolerance,
            "predicted_error": self.predicted_error,
            "dropped": [name for name, term in self.terms.items() if not term.kept],
            "bands": len(self.bands),
        }


def plan(
    scene: Scene,
    tolerance: float,
    quantity: str = "irradiance",
    *,
    depth: float | None = None,
    camera: Camera | None = None,
) -> Plan:
    """The cheapest sufficient model of a scene.  Concrete values only: call it outside jit.

    **Arguments:**

    - `tolerance`: relative error to stay below, 0 < tolerance < 1.
    - `quantity`: "irradiance" (largest error of Ed over depths to the 1 % light level or the
      floor), "radiance" (95th percentile over directions beyond 20 degrees of the sun) or
      "photograph" (rms error over the mean, of the worst channel).
    - `depth`: of the eye, m; by default any down to the 1 % level.  `camera`: the camera of a
      photograph, whose position gives the depth; by default a generic one.

    The predicted error comes from random scenes in which each transport was tried
    (`tests/acceptance/plan.py`: waters of chlorophyll 0.01-30 mg/m3, CDOM and detritus 0.001-5 /m,
    sun 0-75 degrees, 0.5-40 m, a floor or none, sky up to half of the light, flat surface; bands of
    400-700 nm).  For waters and lights unlike those, such as milk and ice, it is a guess, and `why`
    says so.  If no transport is expected to keep the tolerance, the best is returned and `why`
    says that.

    **Raises** ValueError for other arguments and for values that are traced.
    """
    if camera is not None:
        depth = float(camera.position[2])
    _check(quantity, depth, tolerance)
    if scene.objects or scene.lamps:
        return _traced(scene, tolerance)
    lean, found, terms = reduced_scene(scene, tolerance / 5.0, quantity, depth)
    channels = np.zeros((0, len(scene.wavelength)))
    if quantity == "photograph":
        response = _mean_camera() if camera is None else camera.response
        lean, pick, terms["bands"], channels = reduced_bands(
            lean, tolerance / 5.0, response, found[0]
        )
        found = [water.select(pick) for water in found]
    dropped_error = float(sum(term.bound for term in terms.values() if not term.kept))
    waters = errors.features_of_waters(lean, found)
    transport, error, tried = choose(lean, tolerance, quantity, waters, channels, dropped_error)
    if errors.out_of_calibration_range(waters):
        tried.append("a guess: unlike the waters and lights in which errors were measured")
    why = "; ".join([*(f"{name}: {term.why}" for name, term in terms.items()), *tried]) + "."
    return Plan(transport, lean, lean.wavelength, terms, error, why)


def expected_error(
    scene: Scene,
    transport: AbstractTransport,
    quantity: str = "irradiance",
    *,
    depth: float | None = None,
    response: Response | None = None,
) -> float:
    """The expected error of a transport on a scene of which no term is dropped.

    The arguments mean what they mean in `plan`; `response`: of the camera of a photograph.
    """
    _check(quantity, depth)
    name = model_label(transport)
    if (quantity, name) not in errors.error_models():
        known = ", ".join(n for q, n in errors.error_models() if q == quantity)
        raise ValueError(f"the errors of {name} are not known; those of {known} are.")
    return errors.predicted(
        quantity, name, *_features_and_channels(scene, quantity, depth, response)
    )


def sufficient(
    scene: Scene,
    tolerance: float,
    quantity: str = "irradiance",
    *,
    depth: float | None = None,
    response: Response | None = None,
) -> tuple[AbstractTransport, float]:
    """The cheapest sufficient transport for a scene, no term dropped, and its expected error.

    It serves callers, such as fits, that must not change the scene.  The arguments mean what they
    mean in `plan`; `response`: of the camera of a photograph.
    """
    _check(quantity, depth, tolerance)
    waters, channels = _features_and_channels(scene, quantity, depth, response)
    return choose(scene, tolerance, quantity, waters, channels)[:2]


def _check(quantity: str, depth: float | None, tolerance: float = 0.5) -> None:
    if quantity not in QUANTITIES:
        raise ValueError(f"quantity is {quantity!r}; choose from {', '.join(QUANTITIES)}.")
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"tolerance is {tolerance}; it is a relative error between 0 and 1.")
    if depth is not None and not (np.isfinite(depth) and depth >= 0):
        raise ValueError(f"depth is {depth}; it must be finite and at least 0 m.")


def _features_and_channels(
    scene: Scene, quantity: str, depth: float | None, response: Response | None
):
    """The features of a scene's waters, and the weights of a photograph's channels."""
    channels = np.zeros((0, len(scene.wavelength)))
    if quantity == "photograph":
        response = _mean_camera() if response is None else response
        channels = channel_weights(response, scene.wavelength)
    return errors.features_of_waters(
        scene, errors.observed_waters(scene, quantity, depth)
    ), channels


@functools.cache
def _mean_camera():
    return generic_camera()


def choose(
    scene: Scene,
    tolerance: float,
    quantity: str,
    waters: list[errors.WaterFeatures],
    channels: np.ndarray,
    dropped_error: float = 0.0,
) -> tuple[AbstractTransport, float, list[str]]:
    """The first transport expected to keep the tolerance, its error, and a remark on each tried.

    `waters`: from `errors.features_of_waters`; `channels`: (channel, wl) weights of a photograph;
    `dropped_error`: the part of the error that the dropped terms use up.
    """
    tried, best = [], None
    for transport in CANDIDATES[quantity]:
        lacks = _lacks(transport, scene)
        if lacks:
            tried.append(f"{model_label(transport)} does not solve {lacks}")
            continue
        error = dropped_error + errors.predicted(quantity, model_label(transport), waters, channels)
        tried.append(f"{model_label(transport)} errs by {100 * error:.2g} %")
        if error <= tolerance:
            return transport, error, tried
        if best is None or error < best[1]:
            best = (transport, error)
    if best is None:
        raise ValueError(f"no transport solves this scene: {'; '.join(tried)}.")
    tried.append(
        f"no transport promises {100 * tolerance:.2g} %, {model_label(best[0])} comes nearest"
    )
    return *best, tried


def model_label(transport: AbstractTransport) -> str:
    """Label of a transport in the table of errors: its type and accuracy settings alone."""
    if isinstance(transport, PlaneParallel):
        return f"PlaneParallel(streams={transport.streams}, orders={transport.orders})"
    return f"{type(transport).__name__}()"


def _lacks(transport: AbstractTransport, scene: Scene) -> str:
    """The part of a scene that a transport cannot solve, or an empty string."""
    if not isinstance(scene.water, IOPs) and not isinstance(transport, PlaneParallel):
        return "layers"
    if scene.inelastic is not None and not transport.inelastic:
        return "inelastic light"
    if scene.light.sky is not None and not transport.any_sky:
        return "skies that are not uniform"
    return ""


def _traced(scene: Scene, tolerance: float) -> Plan:
    """MonteCarlo for objects and lamps, with random error of half the tolerance."""
    # The standard deviation of one path's value is about twice its mean.
    paths = 1 << int(np.clip(np.ceil(np.log2((4.0 / tolerance) ** 2)), 6, 24))
    kept = Term(True, float("inf"), "what objects and lamps contribute has no bound: kept")
    why = (
        f"objects or lamps: only MonteCarlo draws them; {paths} paths for {100 * tolerance:.2g} %."
    )
    return Plan(MonteCarlo(paths=paths), scene, scene.wavelength, {"things": kept}, tolerance, why)
