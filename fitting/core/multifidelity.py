"""Fits that choose their own transport: the cheapest that is good enough for the water found."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

import oceaninv as oi
from fitting.core.result import Fit
from oceaninv.fidelity.planning import expected_error, rung, sufficient
from oceaninv.transport.base import AbstractTransport


class Demand(NamedTuple):
    """What a transport must be good for: a quantity of `oceaninv.plan`, a depth and a camera."""

    quantity: str
    depth: float | None = None
    response: oi.spectrum.Response | None = None


def fit_within(
    tolerance: float,
    transport: AbstractTransport | None,
    solve: Callable[[AbstractTransport, np.ndarray | None], Fit],
    scene_of: Callable[[Fit], oi.Scene],
    demands: Sequence[Demand],
    corrigible: float = 0.0,
) -> tuple[Fit, AbstractTransport]:
    """A fit through a transport that errs by at most `tolerance`, and that transport.

    The water is found by the cheapest rung, the plan is made for it, and checked again at the
    optimum of the planned rung: a dearer one follows where that is no longer enough.  Every search
    begins where the last one ended.

    **Arguments:** `solve`: of a transport and where to begin; `scene_of`: a fit's water and light;
    `corrigible`: an error that is good enough, whatever the tolerance, for `corrected` follows.

    **Raises** ValueError when a transport was given as well, and for a tolerance out of range.
    """
    if transport is not None:
        raise ValueError(
            f"both a transport ({type(transport).__name__}) and a tolerance were given: the "
            "tolerance chooses the transport, leave one out."
        )
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"tolerance is {tolerance}; it is a relative error between 0 and 1.")
    here: AbstractTransport = oi.TwoStream()
    fit, tried = solve(here, None), [rung(here)]
    while True:
        scene = scene_of(fit)
        error = max(
            expected_error(scene, here, quantity, depth=depth, response=response)
            for quantity, depth, response in demands
        )
        if error <= max(tolerance, corrigible):
            break
        # As many demands, as many answers: the dearest serves all.
        better, _ = max(
            (
                sufficient(scene, tolerance, quantity, depth=depth, response=response)
                for quantity, depth, response in demands
            ),
            key=_dearness,
        )
        if rung(better) in tried:  # the best there is
            break
        here = better
        fit = solve(here, np.asarray(fit.x))
        tried.append(rung(here))
    plan = {
        "transport": rung(here),
        "tolerance": tolerance,
        "predicted_error": error,
        "tried": tried,
        "kept": error <= tolerance,
    }
    return dataclasses.replace(fit, metadata={**fit.metadata, "plan": plan}), here


EXACT = oi.PlaneParallel()  # by which fits within a tolerance are corrected


def corrected(
    fit: Fit,
    exact: AbstractTransport,
    look: Callable[[np.ndarray], tuple[Any, float]],
    solve: Callable[[np.ndarray, Any], Fit],
) -> Fit:
    """The fit with what its transport gets wrong at its optimum, as the exact one sees it.

    Noise averages out over samples while the error of a model does not: one of 1 % may move an
    estimate by more than its interval.  Its ratio to the exact light hardly depends on the water:
    one evaluation of that, and the cheap search goes on with it, again where the constituents
    moved by a tenth of their standard deviation or more, at most three times.  The error that is
    left is by how much the ratio changed between the last two of its looks, the last one after
    the search.

    **Arguments:** `look`: of the unknowns, the ratio of `exact` to cheap light in any shape, and
    the largest share by which it differs from one; `solve`: from where, with which ratio.
    """
    asked = np.array([not parameter.nuisance for parameter in fit.parameters])
    sd, plan = np.sqrt(np.diag(fit.covariance)), fit.metadata["plan"]
    passes, moving = 0, True
    ratio, largest = look(np.asarray(fit.x))
    left = largest
    while moving and passes < 3:
        x = np.asarray(fit.x)
        fit = solve(x, ratio)
        moving = bool(np.any(np.abs(fit.x - x)[asked] >= 0.1 * sd[asked]))
        passes += 1
        before = ratio
        ratio, largest = look(np.asarray(fit.x))
        changes = jax.tree.map(lambda a, b: np.max(np.abs(a / b - 1.0), initial=0.0), ratio, before)
        left = float(max(jax.tree.leaves(changes)))
    more = {
        "corrections": passes,
        "corrected_by": rung(exact),
        "largest_correction": largest,
        "error_left": left,
        "kept": left <= plan["tolerance"],
    }
    return dataclasses.replace(fit, metadata={**fit.metadata, "plan": plan | more})


def _dearness(found: tuple[AbstractTransport, float]) -> int:
    transport = found[0]
    if isinstance(transport, oi.PlaneParallel):
        return transport.streams * transport.orders
    return int(isinstance(transport, oi.FourStream))
