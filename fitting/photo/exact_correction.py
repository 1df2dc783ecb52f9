"""A photo fit through a cheap transport, led to the optimum of the exact light.

What the exact light makes of a reading over what the cheap one does is known, with its slopes,
where both were looked at; the cheap search goes on with it.  Constituents that are badly seen move
far along valleys of nearly equal readings, beyond where the slopes hold: a step counts where the
misfit to the exact light itself is smaller, else the search is held to where it began (a trust
region over models of two fidelities; Alexandrov, Lewis, Gumbert, Green & Newman 2001, Journal of
Aircraft 38:1093).  One look costs a hundredth of a search through the exact light.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from fitting.core.program_cache import cached_jit
from fitting.core.result import Fit
from fitting.photo.problem import Correction, PhotoProblem, predict_all
from oceaninv.fidelity.planning import rung
from oceaninv.transport.base import AbstractTransport

Ratios = list[np.ndarray]  # by photograph, (reading, channel)

# Searches at most, and the move of all unknowns, in standard deviations, that counts as none.
_MOST, _STILL = 25, 0.15
# Step of a derivative, in standard deviations.
_STEP = 0.02
# Share of the promised decrease of the misfit below which the next search is held more firmly,
# and above which less; by what factors; and the least hold.
_POOR, _GOOD, _FIRMER, _LOOSER, _LEAST = 0.3, 0.7, 2.5, 3.0, 0.3


def uncorrected(problem: PhotoProblem) -> Correction:
    """No correction, in the shape of one."""
    centre = problem.prior.centre
    log = tuple(jnp.zeros_like(one.values) for one in problem.readings)
    slope = tuple(jnp.zeros((*one.shape, *centre.shape), one.dtype) for one in log)
    zero = jnp.zeros((), centre.dtype)
    return Correction(log, slope, centre, jnp.ones_like(centre), zero, zero + 10.0)


def exact_ratios(problem: PhotoProblem, x, exact: AbstractTransport) -> Ratios:
    """What `exact` makes of each reading over what the problem's transport does."""
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
    """The ratios found at `x`, with their slopes.

    By differences: a program of derivatives of the exact light would take a minute to compile.
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


def approached(
    fit: Fit,
    problem: PhotoProblem,
    exact: AbstractTransport,
    search: Callable[[PhotoProblem, np.ndarray], tuple[np.ndarray, np.ndarray]],
    solve: Callable[[np.ndarray, Correction], Fit],
) -> Fit:
    """The fit with what its transport gets wrong, as the exact one sees it at its optimum.

    **Arguments:** `problem`: of the fit, with the noise as stated; `search`: of a problem and
    where to begin, the optimum and its standard deviations; `solve`: the fit from a point with a
    correction.

    The result's `metadata["plan"]` says how many searches went on (`corrections`), whether the
    unknowns stood still at last, and `error_left`: by how much the exact light still differs from
    what was fitted, in the worst reading.
    """
    x, unit = np.asarray(fit.x), np.sqrt(np.diag(fit.covariance))
    ratios = exact_ratios(problem, x, exact)

    def exactly(x, ratios):
        return float(_misfit(_with(problem, log=_logs(ratios)), jnp.asarray(x)))

    here, hold, searches, still = exactly(x, ratios), 0.0, 0, False
    correction = tangent(problem, x, ratios, unit, exact)
    while not still and searches < _MOST:
        correction = dataclasses.replace(correction, hold=jnp.asarray(hold))
        posed = dataclasses.replace(problem, correction=correction)
        new, sd = search(posed, x)
        searches += 1
        seen = exact_ratios(problem, new, exact)
        promised, there = here - float(_misfit(posed, jnp.asarray(new))), exactly(new, seen)
        share = (here - there) / max(promised, 1e-9)
        moved = float(np.max(np.abs(new - x) / unit)) * (1.0 + hold**2)
        if there <= here:
            x, ratios, here, still = new, seen, there, moved < _STILL
            unit = sd if hold == 0.0 else unit
            if not still:
                correction = tangent(problem, x, ratios, unit, exact)
        if share > _GOOD:
            hold = hold / _LOOSER if hold > 0.5 * _LEAST else 0.0
        elif share < _POOR:
            hold = max(_LEAST, _FIRMER * hold)
    last = dataclasses.replace(correction, log=_logs(ratios), about=jnp.asarray(x))
    found = solve(x, last)
    seen = exact_ratios(problem, found.x, exact)
    fitted = [np.asarray(last.factor(p, jnp.asarray(found.x))) for p in range(len(seen))]
    left = max(_largest(a / b) for a, b in zip(seen, fitted, strict=True))
    plan = fit.metadata["plan"] | {
        "corrections": searches,
        "stood_still": still,
        "corrected_by": rung(exact),
        "largest_correction": max(map(_largest, seen)),
        "error_left": left,
        "kept": left <= fit.metadata["plan"]["tolerance"],
    }
    return dataclasses.replace(found, metadata={**found.metadata, "plan": plan})


def _largest(ratio: np.ndarray) -> float:
    return float(np.max(np.abs(ratio - 1.0), initial=0.0))
