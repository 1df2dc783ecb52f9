"""Refinement of a photo fit through a cheap transport to the optimum of the exact one.

The ratio of exact to cheap prediction of each reading, with its derivatives, is evaluated at a
point, and the cheap search continues with it.  Poorly determined constituents move far along
directions of nearly equal readings, beyond where the linear ratio is valid: a step is accepted
where it lowers the misfit to the exact model itself, else the next search is weighted towards its
starting point (trust-region model management; Alexandrov, Lewis, Gumbert, Green & Newman 2001,
Journal of Aircraft 38:1093).  One evaluation of the exact model costs a hundredth of a search
through it.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from fitting.core.multifidelity import chosen_model
from fitting.core.program_cache import cached_jit
from fitting.core.result import Fit
from fitting.photo.problem import Correction, PhotoProblem, predict_all
from oceaninv.fidelity.planning import model_label
from oceaninv.transport.base import AbstractTransport

Ratios = list[np.ndarray]  # by photograph, (reading, channel)

# Searches at most, and the standardised step of all unknowns below which the search has settled.
_MOST, _SETTLED = 25, 0.15
# Step of a derivative, in standard deviations.
_STEP = 0.02
# Ratio of actual to predicted decrease of the misfit below which the proximal weight rises, and
# above which it falls; by what factors; and its least value above 0.
_POOR, _GOOD, _RAISE, _LOWER, _LEAST = 0.3, 0.7, 2.5, 3.0, 0.3


def uncorrected(problem: PhotoProblem) -> Correction:
    """A correction by factors of one, of the shape of any other."""
    centre = problem.prior.centre
    log = tuple(jnp.zeros_like(one.values) for one in problem.readings)
    slope = tuple(jnp.zeros((*one.shape, *centre.shape), one.dtype) for one in log)
    zero = jnp.zeros((), centre.dtype)
    return Correction(log, slope, centre, jnp.ones_like(centre), zero, zero + 10.0)


def exact_ratios(problem: PhotoProblem, x, exact: AbstractTransport) -> Ratios:
    """Prediction of each reading by `exact` over that by the problem's transport."""
    models = (problem.transport, exact)
    cheap, true = (
        predict_all(problem.layout, problem.readings, model, problem.sunlight, jnp.asarray(x))
        for model in models
    )
    return [np.asarray(b) / np.asarray(a) for (a, _), (b, _) in zip(cheap, true, strict=True)]


def _with(problem: PhotoProblem, **changes) -> PhotoProblem:
    """The problem with another correction."""
    return dataclasses.replace(
        problem, correction=dataclasses.replace(uncorrected(problem), **changes)
    )


def _logs(ratios: Ratios):
    return tuple(jnp.asarray(np.log(one)) for one in ratios)


def tangent(problem: PhotoProblem, x, ratios: Ratios, unit, exact) -> Correction:
    """The ratios at `x` with their derivatives.

    By differences: derivatives of the exact model would take a minute to compile.
    """
    slopes = []
    for i in range(len(x)):
        beside = exact_ratios(problem, x + _STEP * unit * (np.arange(len(x)) == i), exact)
        slopes.append([np.log(a / b) / _STEP for a, b in zip(beside, ratios, strict=True)])
    stacked = tuple(jnp.asarray(np.stack(part, axis=-1)) for part in zip(*slopes, strict=True))
    zero = jnp.zeros(())
    return Correction(_logs(ratios), stacked, jnp.asarray(x), jnp.asarray(unit), zero, zero + 1.0)


@cached_jit
def _misfit(problem: PhotoProblem, x):
    return jnp.sum(problem.residual(x) ** 2)


def refine_with_exact_model(
    fit: Fit,
    problem: PhotoProblem,
    exact: AbstractTransport,
    search: Callable[[PhotoProblem, np.ndarray], tuple[np.ndarray, np.ndarray]],
    solve: Callable[[np.ndarray, Correction], Fit],
) -> Fit:
    """The fit refined to the optimum of the exact model.

    **Arguments:** `problem`: of the fit, with the noise as stated; `search` (problem, coordinates
    to start from) -> the optimum and its standard deviations; `solve` (coordinates to start from,
    correction) -> the fit.

    The result's `plan` says how many searches followed, whether the unknowns had settled at the
    end, and the largest relative difference between the exact model and the fitted readings.
    """
    x, unit = np.asarray(fit.x), np.sqrt(np.diag(fit.covariance))
    ratios = exact_ratios(problem, x, exact)

    def exact_misfit(x, ratios):
        return float(_misfit(_with(problem, log=_logs(ratios)), jnp.asarray(x)))

    here, proximal_weight, searches, settled = exact_misfit(x, ratios), 0.0, 0, False
    correction = tangent(problem, x, ratios, unit, exact)
    while not settled and searches < _MOST:
        weight = jnp.asarray(proximal_weight)
        correction = dataclasses.replace(correction, proximal_weight=weight)
        posed = dataclasses.replace(problem, correction=correction)
        new, sd = search(posed, x)
        searches += 1
        seen = exact_ratios(problem, new, exact)
        predicted = here - float(_misfit(posed, jnp.asarray(new)))
        there = exact_misfit(new, seen)
        share = (here - there) / max(predicted, 1e-9)
        moved = float(np.max(np.abs(new - x) / unit)) * (1.0 + proximal_weight**2)
        if there <= here:
            x, ratios, here, settled = new, seen, there, moved < _SETTLED
            unit = sd if proximal_weight == 0.0 else unit
            if not settled:
                correction = tangent(problem, x, ratios, unit, exact)
        if share > _GOOD:
            high = proximal_weight > 0.5 * _LEAST
            proximal_weight = proximal_weight / _LOWER if high else 0.0
        elif share < _POOR:
            proximal_weight = max(_LEAST, _RAISE * proximal_weight)
    last = dataclasses.replace(correction, log=_logs(ratios), about=jnp.asarray(x))
    found = solve(x, last)
    seen = exact_ratios(problem, found.x, exact)
    fitted = [np.asarray(last.factor(p, jnp.asarray(found.x))) for p in range(len(seen))]
    left = max(_largest(a / b) for a, b in zip(seen, fitted, strict=True))
    plan = dataclasses.replace(
        chosen_model(fit),
        corrections=searches,
        settled=settled,
        corrected_by=model_label(exact),
        largest_correction=max(map(_largest, seen)),
        remaining_error=left,
    )
    return dataclasses.replace(found, plan=plan)


def _largest(ratio: np.ndarray) -> float:
    return float(np.max(np.abs(ratio - 1.0), initial=0.0))
