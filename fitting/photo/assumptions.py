"""Sensitivity of a fit to the tables and shapes that its model fixes."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fitting.core.least_squares import least_squares
from fitting.core.parameters import Identity, Parameter, Parameters, Prior
from fitting.core.problem import AbstractProblem
from fitting.core.program_cache import cached_jit
from fitting.core.result import Fit
from fitting.water_model.alternatives import ALTERNATIVES, PREFIX
from oceaninv.foundation.double_precision import in_double_precision


def open_to(parameters: Parameters, names=tuple(ALTERNATIVES)) -> Parameters:
    """The unknowns and, after them, a coordinate for every alternative assumption."""
    extra = [Parameter(PREFIX + name, 0.0, None, Identity(), nuisance=True) for name in names]
    return Parameters([*parameters, *extra])


def opened(problem: Any) -> Any:
    """The same posterior as a function of the unknowns and of the alternative assumptions."""
    zero = jnp.zeros(len(ALTERNATIVES), problem.prior.centre.dtype)
    prior = Prior(
        jnp.concatenate([problem.prior.centre, zero]),
        jnp.concatenate([problem.prior.weight, zero]),
        jnp.concatenate([problem.prior.scale, zero + 1.0]),
    )
    return dataclasses.replace(problem, layout=open_to(problem.layout), prior=prior)


@cached_jit
def _refitted(problem: AbstractProblem, x, scale):
    """(alternative + 1, unknown) optima and ln quantities there, first of the model as it is."""
    count = len(ALTERNATIVES)

    def residual(x, share):
        return problem.residual(jnp.concatenate([x, share]))

    def one(share):
        moved = least_squares(residual, x, share, scale).x
        logs = jax.tree.map(jnp.log, problem.quantities(jnp.concatenate([moved, share])))
        return moved, logs

    shares = jnp.concatenate([jnp.zeros((1, count), x.dtype), jnp.eye(count, dtype=x.dtype)])
    return jax.lax.map(one, shares)


@in_double_precision
def assumptions(fit: Fit) -> dict[str, dict[str, float]]:
    """The change of each answer if the fit assumed something else.

    `Fit.sensitivity` is about assumptions with a prior; this is about those that are fixed: the
    table of pure water, the spectrum of algal absorption, the phase function of particles, and the
    wavelength dependence of their backscattering.  The alternatives to them are in
    `fitting.water_model.alternatives.ALTERNATIVES`.

    **Returns** by constituent and scalar quantity, and by alternative, the change of ln of the
    answer in a search with the alternative that starts at the fit's optimum.  Where the alternative
    is true, the error of the fit is about the opposite.

    **Raises** ValueError for a fit that is not of photographs.
    """
    from fitting.photo.problem import PhotoProblem

    if not isinstance(fit.problem, PhotoProblem):
        raise ValueError("assumptions need a fit of photographs; this fit is of something else.")
    scale = fit.problem.prior.scale
    moved, logs = _refitted(opened(fit.problem), jnp.asarray(fit.x), scale)
    moved, logs = np.asarray(moved), {name: np.asarray(value) for name, value in logs.items()}
    found = {}
    for name, quantity in fit.quantities.items():
        if quantity.value.ndim == 0:
            found[name] = _by_name(logs[name])
    for i, parameter in enumerate(fit.parameters):
        if not parameter.nuisance:
            found[parameter.name] = _by_name(moved[:, i])
    return found


def _by_name(values: np.ndarray) -> dict[str, float]:
    return dict(zip(ALTERNATIVES, map(float, values[1:] - values[0]), strict=True))
