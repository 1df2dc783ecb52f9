"""How far a posterior reaches along a constituent that the readings hardly see.

On a log scale a constituent that may as well be absent has no slope left: at such an optimum it
seems to have no part in what the others must explain, and their standard deviations come out as if
it were known to be absent.  Followed up its own valley it takes its share, and they give way.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from fitting._programs import kept
from fitting.parameters import Log, Parameters
from fitting.posterior import quantile
from fitting.sampling import AbstractProblem
from fitting.solve import covariance, value_and_jacobian

# A constituent known to less than a factor of e either way: it may as well be absent.
_UNSEEN = 1.0
# Steps upwards and their length (ln): a factor of 120 in all.
_STEPS, _LENGTH = 16, 0.3
# Evaluations at each, the first where the step leads; what a step that led uphill is shortened to.
_FOLLOW, _SHORTER = 5, 0.3


class Valley(NamedTuple):
    """Points of a profile: `x` (step, unknown), the loss |residual|^2 above the optimum's (step,),
    and the standard deviations of all else there, what is walked along held, (step, unknown)."""

    x: Any
    loss: Any
    sd: Any


def walk(problem: AbstractProblem, x: Float[Array, " unknown"], i: Int[Array, ""]) -> Valley:
    """Up the coordinate `i` from the optimum `x`, all others following by Gauss-Newton.

    Pure: jit and vmap it.
    """
    held = jnp.arange(x.shape[0]) == i

    def both(x):
        return value_and_jacobian(problem.residual, x)

    # One evaluation of the model, wherever a step leads: each more would be a copy to compile.
    def move(carry, rise):
        x, value, slope, share = carry
        step = -_conditional(slope, held) @ jnp.where(held, 0.0, value @ slope)
        new = ~jnp.isnan(rise)
        tried = jnp.where(new, jnp.where(held, x + rise, x), x + share * step)
        there = both(tried)
        finite = jnp.all(jnp.isfinite(there[0])) & jnp.all(jnp.isfinite(there[1]))
        good = new | (finite & (jnp.sum(there[0] ** 2) < jnp.sum(value**2)))
        x, value, slope = jax.tree.map(
            lambda ours, theirs: jnp.where(good, theirs, ours), (x, value, slope), (tried, *there)
        )
        return (x, value, slope, jnp.where(good, 1.0, _SHORTER * share)), None

    def step(carry, rise):
        rises = jnp.full(_FOLLOW, jnp.nan, x.dtype).at[0].set(rise)
        carry, _ = jax.lax.scan(move, carry, rises)
        sd = jnp.sqrt(jnp.diagonal(_conditional(carry[2], held)))
        return carry, Valley(carry[0], jnp.sum(carry[1] ** 2), jnp.where(held, 0.0, sd))

    # The first point is the optimum; what stands before it is not used.
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(both, x))
    rises = jnp.full(_STEPS + 1, _LENGTH, x.dtype).at[0].set(0.0)
    points = jax.lax.scan(step, (x, *blank, jnp.ones((), x.dtype)), rises)[1]
    return points._replace(loss=points.loss - points.loss[0])


def _conditional(slope, held):
    # The held column is replaced by one of its own, on which no other depends.
    free = jnp.where(held[None, :], 0.0, slope)
    return covariance(jnp.concatenate([free, held[None, :].astype(slope.dtype)]))


@kept
def _walked(problem: AbstractProblem, x, i):
    return walk(problem, x, i)


def unseen(parameters: Parameters, sd: np.ndarray) -> list[int]:
    """Which asked-for unknowns may as well be absent."""
    return [
        i
        for i, p in enumerate(parameters)
        if not p.nuisance and isinstance(p.transform, Log) and sd[i] > _UNSEEN
    ]


def reach(x: np.ndarray, valley: Valley, parameters: Parameters) -> np.ndarray:
    """(unknown,) the standard deviations whose 95 % intervals about `x` hold the profile's, at most
    those of the priors.

    A profile's interval holds the coordinates of all points whose loss is below chi-squared: of
    those of the valley, with what the others may add to their loss.
    """
    z = float(quantile(0.95))
    left = z * z - np.asarray(valley.loss)[:, None]
    more = np.sqrt(np.maximum(left, 0.0)) * np.asarray(valley.sd)
    away = np.where(left > 0, np.abs(np.asarray(valley.x) - x) + more, 0.0)
    most = [np.inf if p.spread is None else p.spread for p in parameters]
    return np.minimum(np.max(away, axis=0, initial=0.0) / z, most)


def widened(problem: AbstractProblem, parameters: Parameters, x, cov: np.ndarray) -> np.ndarray:
    """The covariance with the standard deviations that the valleys of what is unseen ask for."""
    sd = np.sqrt(np.diag(cov))
    found = sd
    for i in unseen(parameters, sd):
        valley = _walked(problem, jnp.asarray(x), jnp.asarray(i))
        found = np.maximum(found, reach(np.asarray(x), valley, parameters))
    return cov * np.outer(found / sd, found / sd)
