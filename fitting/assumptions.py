"""What a fit's answers lean on besides its priors: the tables and shapes that its model fixes."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fitting._assumed import ALTERNATIVES, PREFIX
from fitting._programs import kept
from fitting.parameters import Identity, Parameter, Parameters, Prior
from fitting.posterior import Fit
from fitting.sampling import AbstractProblem
from fitting.solve import covariance, value_and_jacobian


def open_to(parameters: Parameters, names=tuple(ALTERNATIVES)) -> Parameters:
    """The unknowns and, after them, a coordinate for every alternative assumption."""
    extra = [Parameter(PREFIX + name, 0.0, None, Identity(), nuisance=True) for name in names]
    return Parameters([*parameters, *extra])


def opened(problem: Any) -> Any:
    """The same posterior as a function of the unknowns and of what else could be assumed."""
    zero = jnp.zeros(len(ALTERNATIVES), problem.prior.centre.dtype)
    prior = Prior(
        jnp.concatenate([problem.prior.centre, zero]),
        jnp.concatenate([problem.prior.weight, zero]),
        jnp.concatenate([problem.prior.scale, zero + 1.0]),
    )
    return dataclasses.replace(problem, layout=open_to(problem.layout), prior=prior)


# Numbers that are well known hold still only once badly known ones have found their place.
_STEPS = 10


@kept
def _stepped(problem: AbstractProblem, x):
    """(alternative + 1, unknown) optima and ln quantities there, first of the model as it is."""
    count, unknown = len(ALTERNATIVES), x.shape[0]
    zero = jnp.zeros(count, x.dtype)
    value, slope = value_and_jacobian(lambda x: problem.residual(jnp.concatenate([x, zero])), x)
    cov = covariance(slope)

    def one(share):
        def step(moved, _):
            off = problem.residual(jnp.concatenate([moved, share])) - value
            down = slope.T @ off
            length = jnp.sqrt(down @ cov @ down)
            return moved - cov @ down / jnp.maximum(1.0, length), None

        return jax.lax.scan(step, x, None, length=_STEPS)[0]

    def quantities(pair):
        x, share = pair
        return jax.tree.map(jnp.log, problem.quantities(jnp.concatenate([x, share])))

    shares = jnp.concatenate([zero[None], jnp.eye(count, dtype=x.dtype)])
    moved = jax.lax.map(one, shares)
    return moved.reshape(count + 1, unknown), jax.lax.map(quantities, (moved, shares))


def assumptions(fit: Fit) -> dict[str, dict[str, float]]:
    """How far each answer would move if the fit took something else for granted.

    `Fit.sensitivity` says it of what has a prior.  This says it of what is fixed: which table of
    pure water, which spectrum of algal absorption, which phase function of particles, and how
    their backscattering goes; see `fitting._assumed.ALTERNATIVES` for what is put in the place.

    **Returns** by constituent and scalar quantity, and by alternative, the change of ln of the
    answer by Gauss-Newton steps, each of a standard deviation at most, with the slopes of the
    fit's own model.  If the water is like the alternative, the fit errs by the opposite.

    **Raises** ValueError for a fit that is not of photographs.
    """
    from fitting.photo import PhotoProblem

    if not isinstance(fit.problem, PhotoProblem):
        raise ValueError("assumptions are those of a fit of photographs; this fit is of none.")
    moved, logs = _stepped(opened(fit.problem), jnp.asarray(fit.x))
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
