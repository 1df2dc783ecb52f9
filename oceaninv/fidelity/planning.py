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
# Cheapest first.  KdTransport costs what TwoStream costs and is right less often: it is for waters
# of which only Kd is known.
_CLOSED = (TwoStream(), FourStream())
LADDERS: Mapping[str, tuple[AbstractTransport, ...]] = {
    # Without lines of sight four streams cost half of what two do.
    "irradiance": (*_CLOSED[::-1], *(PlaneParallel(n, 1) for n in (4, 8, 16, 24, 32))),
    # Dense, by cost: with half as many orders as streams most scenes fare better, some much worse.
    "radiance": (
        *_CLOSED,
        *(PlaneParallel(n, m) for n, m in ((8, 6), (12, 6), (10, 10), (16, 8), (12, 12), (14, 12))),
        *(PlaneParallel(n, m) for n, m in ((16, 12), (20, 10), (20, 20), (28, 14), (24, 24))),
        *(PlaneParallel(n, m) for n, m in ((28, 28), (40, 20), (40, 40))),
    ),
    # A camera looks about the horizon, where half as many orders of azimuth do.
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
    - `bands`: (wl,) nm that are left.
    - `terms`: by name, what each term of the scene contributes at most, and whether it is kept.
    - `predicted_error`: dropped terms included, with such a margin that the promise is kept in 95 %
      of similar scenes or more.
    - `why`: one sentence per decision.
    """

    transport: AbstractTransport
    scene: Scene
    bands: np.ndarray
    terms: Mapping[str, Term]
    predicted_error: float
    why: str

    def metadata(self, tolerance: float) -> dict:
        """What a file should say of the choice."""
        return {
            "transport": rung(self.transport),
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
      photograph, which knows its depth; by default a generic one.

    The predicted error comes from random scenes in which each rung was tried
    (`tests/acceptance/plan.py`: waters of chlorophyll 0.01-30 mg/m3, CDOM and detritus 0.001-5 /m,
    sun 0-75 degrees, 0.5-40 m, a floor or none, sky up to half of the light, flat surface; bands of
    400-700 nm).  For waters and lights unlike those, such as milk and ice, it is a guess, and `why`
    says so.  If no rung promises the tolerance, the best is returned and `why` says that.

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
        found = [look.of(pick) for look in found]
    spent = float(sum(term.bound for term in terms.values() if not term.kept))
    views = errors.views(lean, found)
    transport, error, tried = choose(lean, tolerance, quantity, views, channels, spent)
    if errors.unlike(views):
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
    """What a rung of the ladder errs by on a scene, all of whose terms it keeps.

    Arguments and meaning as of `plan`; `response`: of the camera of a photograph.
    """
    _check(quantity, depth)
    name = rung(transport)
    if (quantity, name) not in errors.models():
        known = ", ".join(n for q, n in errors.models() if q == quantity)
        raise ValueError(f"the errors of {name} are not known; those of {known} are.")
    return errors.predicted(quantity, name, *_outlook(scene, quantity, depth, response))


def sufficient(
    scene: Scene,
    tolerance: float,
    quantity: str = "irradiance",
    *,
    depth: float | None = None,
    response: Response | None = None,
) -> tuple[AbstractTransport, float]:
    """The cheapest rung for a scene of which nothing is left out, and its expected error.

    `plan` for those who cannot change the scene, as a fit cannot.  Arguments as there; `response`:
    of the camera of a photograph.
    """
    _check(quantity, depth, tolerance)
    views, channels = _outlook(scene, quantity, depth, response)
    return choose(scene, tolerance, quantity, views, channels)[:2]


def _check(quantity: str, depth: float | None, tolerance: float = 0.5) -> None:
    if quantity not in QUANTITIES:
        raise ValueError(f"quantity is {quantity!r}; choose from {', '.join(QUANTITIES)}.")
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"tolerance is {tolerance}; it is a relative error between 0 and 1.")
    if depth is not None and not (np.isfinite(depth) and depth >= 0):
        raise ValueError(f"depth is {depth}; it must be finite and at least 0 m.")


def _outlook(scene: Scene, quantity: str, depth: float | None, response: Response | None):
    """A scene as the error models see it, and the weights of a photograph's channels."""
    channels = np.zeros((0, len(scene.wavelength)))
    if quantity == "photograph":
        response = _mean_camera() if response is None else response
        channels = channel_weights(response, scene.wavelength)
    return errors.views(scene, errors.looks(scene, quantity, depth)), channels


@functools.cache
def _mean_camera():
    return generic_camera()


def choose(
    scene: Scene,
    tolerance: float,
    quantity: str,
    views: list[errors.View],
    channels: np.ndarray,
    spent: float = 0.0,
) -> tuple[AbstractTransport, float, list[str]]:
    """The first rung expected to keep the tolerance, its error, and what was said of each.

    `views`: the scene's waters as `errors.views` sees them; `channels`: (channel, wl) weights of a
    photograph; `spent`: what dropped terms took already.
    """
    tried, best = [], None
    for transport in LADDERS[quantity]:
        lacks = _lacks(transport, scene)
        if lacks:
            tried.append(f"{rung(transport)} does not solve {lacks}")
            continue
        error = spent + errors.predicted(quantity, rung(transport), views, channels)
        tried.append(f"{rung(transport)} errs by {100 * error:.2g} %")
        if error <= tolerance:
            return transport, error, tried
        if best is None or error < best[1]:
            best = (transport, error)
    if best is None:
        raise ValueError(f"no transport solves this scene: {'; '.join(tried)}.")
    tried.append(f"no rung promises {100 * tolerance:.2g} %, {rung(best[0])} comes nearest")
    return *best, tried


def rung(transport: AbstractTransport) -> str:
    """Name of a rung in the table of errors: type and dials, whatever else it may hold."""
    if isinstance(transport, PlaneParallel):
        return f"PlaneParallel(streams={transport.streams}, orders={transport.orders})"
    return f"{type(transport).__name__}()"


def _lacks(transport: AbstractTransport, scene: Scene) -> str:
    """What of a scene a transport cannot solve, or nothing."""
    if not isinstance(scene.water, IOPs) and not isinstance(transport, PlaneParallel):
        return "layers"
    if scene.inelastic is not None and not transport.inelastic:
        return "inelastic light"
    if scene.light.sky is not None and not transport.any_sky:
        return "skies that are not uniform"
    return ""


def _traced(scene: Scene, tolerance: float) -> Plan:
    """Things and lamps need the tracer: paths until its random error is half the tolerance."""
    # One path's value scatters about as much as twice its mean.
    paths = 1 << int(np.clip(np.ceil(np.log2((4.0 / tolerance) ** 2)), 6, 24))
    kept = Term(True, float("inf"), "objects and lamps have no bound: they are kept")
    why = (
        f"objects or lamps: only MonteCarlo draws them; {paths} paths for {100 * tolerance:.2g} %."
    )
    return Plan(MonteCarlo(paths=paths), scene, scene.wavelength, {"things": kept}, tolerance, why)
