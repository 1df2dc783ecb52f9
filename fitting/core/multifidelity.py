"""Multifidelity fits: the cheapest transport that is accurate enough for the water found."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

import oceaninv as oi
from fitting.core.diagnostics import ModelChoice
from fitting.core.result import Fit
from oceaninv.fidelity.planning import expected_error, model_label, sufficient
from oceaninv.transport.base import AbstractTransport


class AccuracyTarget(NamedTuple):
    """What a transport must compute accurately.

    - `quantity`: one of those that `oceaninv.plan` knows; `depth`: in m, None for all depths;
      `response`: of the camera, for photographs.
    """

    quantity: str
    depth: float | None = None
    response: oi.spectrum.Response | None = None


def multifidelity_fit(
    tolerance: float,
    transport: AbstractTransport | None,
    solve: Callable[[AbstractTransport, np.ndarray | None], Fit],
    scene_of: Callable[[Fit], oi.Scene],
    targets: Sequence[AccuracyTarget],
    correctable: float = 0.0,
) -> tuple[Fit, AbstractTransport]:
    """A fit through a transport that errs by at most `tolerance`, and that transport.

    The cheapest transport finds a first water.  A transport is planned for that water, and the
    plan is checked at the optimum of the planned transport: where it no longer suffices, a more
    accurate one follows.  Every search starts where the last one ended.

    **Arguments:** `solve` (transport, coordinates to start from or None) -> the fit; `scene_of`
    (fit) -> its water and light; `targets`: what the transport is used for; `correctable`: an
    error that suffices whatever the tolerance, because a correction follows.

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
    fit, tried = solve(here, None), [model_label(here)]
    while True:
        scene = scene_of(fit)
        error = max(
            expected_error(scene, here, quantity, depth=depth, response=response)
            for quantity, depth, response in targets
        )
        if error <= max(tolerance, correctable):
            break
        # Each target asks for a transport: the most costly serves all.
        better, _ = max(
            (
                sufficient(scene, tolerance, quantity, depth=depth, response=response)
                for quantity, depth, response in targets
            ),
            key=_cost,
        )
        if model_label(better) in tried:  # the best there is
            break
        here = better
        fit = solve(here, np.asarray(fit.x))
        tried.append(model_label(here))
    plan = ModelChoice(model_label(here), tuple(tried), tolerance, error)
    return dataclasses.replace(fit, plan=plan), here


def chosen_model(fit: Fit) -> ModelChoice:
    """The choice of the transport; ValueError for a fit that was given one."""
    if fit.plan is None:
        raise ValueError("only a fit within a tolerance chooses its transport.")
    return fit.plan


# The accurate model that corrects fits within a tolerance.
EXACT = oi.PlaneParallel()


def corrected_fit(
    fit: Fit,
    exact: AbstractTransport,
    evaluate: Callable[[np.ndarray], tuple[Any, float]],
    solve: Callable[[np.ndarray, Any], Fit],
) -> Fit:
    """The fit with its transport's error at the optimum corrected by an accurate model.

    Noise averages out over samples while a model's error does not: one of 1 % may move an estimate
    by more than its interval.  The ratio of accurate to cheap light hardly depends on the water, so
    one evaluation of the accurate model gives a multiplicative correction, with which the cheap
    search continues; again where a constituent moved by a tenth of its standard deviation or more,
    at most three times.  The remaining error is the largest relative change of the ratio between
    its last two evaluations, the last one after the search.

    **Arguments:** `evaluate` (coordinates) -> the ratio of `exact` to cheap light, any tree of
    arrays, and the largest relative difference of it from one; `solve` (coordinates to start from,
    ratio) -> the fit.
    """
    asked = np.array([not parameter.nuisance for parameter in fit.parameters])
    sd, plan = np.sqrt(np.diag(fit.covariance)), chosen_model(fit)
    passes, moving = 0, True
    ratio, largest = evaluate(np.asarray(fit.x))
    left = largest
    while moving and passes < 3:
        x = np.asarray(fit.x)
        fit = solve(x, ratio)
        moving = bool(np.any(np.abs(fit.x - x)[asked] >= 0.1 * sd[asked]))
        passes += 1
        before = ratio
        ratio, largest = evaluate(np.asarray(fit.x))
        changes = jax.tree.map(lambda a, b: np.max(np.abs(a / b - 1.0), initial=0.0), ratio, before)
        left = float(max(jax.tree.leaves(changes)))
    plan = dataclasses.replace(
        plan,
        corrections=passes,
        corrected_by=model_label(exact),
        largest_correction=largest,
        remaining_error=left,
    )
    return dataclasses.replace(fit, plan=plan)


def _cost(found: tuple[AbstractTransport, float]) -> int:
    transport = found[0]
    if isinstance(transport, oi.PlaneParallel):
        return transport.streams * transport.orders
    return int(isinstance(transport, oi.FourStream))
