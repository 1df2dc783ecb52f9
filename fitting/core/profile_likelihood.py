"""How far a posterior reaches along a constituent, followed through its own valley.

On a log scale a constituent that may as well be absent has no slope left: at such an optimum it
seems to have no part in what the others must explain, and their standard deviations come out as if
it were known to be absent.  Followed up its own valley it takes its share, and they give way.

A constituent that is seen, but badly, is seen the better the more there is of it: at an optimum
that came out high its standard deviation is too small, and the truth lies down the valley, further
away than the ellipsoid says.  There both sides are followed, and the longer one counts for it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from fitting.core.least_squares import covariance, value_and_jacobian
from fitting.core.parameters import Log, Parameters
from fitting.core.problem import AbstractProblem
from fitting.core.program_cache import cached_jit
from fitting.core.result import quantile

# A constituent known to less than a factor of e either way: it may as well be absent.
_UNSEEN = 1.0
# Known to better than this, the ellipsoid will do.
_SEEN = 0.15
# Steps upwards and their length (ln): a factor of 120 in all.
_STEPS, _LENGTH = 16, 0.3
# Length of steps to either side of what is seen, in standard deviations.
_SHARE = 0.5
# Evaluations at each, the first where the step leads; what a step that led uphill is shortened to;
# the decrease of the loss at which the valley's floor is reached; the loss at which to turn back.
_FOLLOW, _SHORTER, _FLOOR, _ENOUGH = 5, 0.3, 0.02, 8.0


class Valley(NamedTuple):
    """Points of a profile: `x` (step, unknown), the loss |residual|^2 above the optimum's (step,),
    and the standard deviations of all else there, what is walked along held, (step, unknown)."""

    x: Any
    loss: Any
    sd: Any


def walk(
    problem: AbstractProblem,
    x: Float[Array, " unknown"],
    i: Int[Array, ""],
    length: Float[Array, ""] | None = None,
) -> Valley:
    """Along the coordinate `i` from the optimum `x`, all others following by Gauss-Newton.

    `length` of a step, upwards unless negative.  Points beyond what matters have an infinite loss.
    Pure: jit and vmap it.
    """
    held = jnp.arange(x.shape[0]) == i
    length = jnp.asarray(_LENGTH, x.dtype) if length is None else length

    def both(x):
        return value_and_jacobian(problem.residual, x)

    # One evaluation of the model, wherever a step leads: each more would be a copy to compile.
    def move(carry):
        x, value, slope, rise, share, count, _ = carry
        step = -_conditional(slope, held) @ jnp.where(held, 0.0, value @ slope)
        new = count == 0
        tried = jnp.where(new, jnp.where(held, x + rise, x), x + share * step)
        there = both(tried)
        finite = jnp.all(jnp.isfinite(there[0])) & jnp.all(jnp.isfinite(there[1]))
        less = jnp.sum(value**2) - jnp.sum(there[0] ** 2)
        good = new | (finite & (less > 0))
        x, value, slope = jax.tree.map(
            lambda ours, theirs: jnp.where(good, theirs, ours), (x, value, slope), (tried, *there)
        )
        share = jnp.where(good, 1.0, _SHORTER * share)
        return x, value, slope, rise, share, count + 1, jnp.where(good & ~new, less, jnp.inf)

    def unsettled(carry):
        return (carry[5] < _FOLLOW) & (carry[6] > _FLOOR)

    def go(carry, rise):
        x, value, slope, share, least, _ = carry
        begin = (
            x,
            value,
            slope,
            rise,
            share,
            jnp.zeros((), jnp.int32),
            jnp.asarray(jnp.inf, x.dtype),
        )
        x, value, slope, _, share, *_ = jax.lax.while_loop(unsettled, move, begin)
        sd = jnp.sqrt(jnp.diagonal(_conditional(slope, held)))
        total = jnp.sum(value**2)
        # The first point is the optimum.
        least = jnp.where(jnp.isfinite(least), least, total)
        loss = total - least
        done = ~(loss < _ENOUGH)
        return (x, value, slope, share, least, done), Valley(x, loss, jnp.where(held, 0.0, sd))

    def stay(carry, _):
        x = carry[0]
        return carry, Valley(x, jnp.asarray(jnp.inf, x.dtype), jnp.zeros_like(x))

    def step(carry, rise):
        return jax.lax.cond(carry[5], stay, go, carry, rise)

    # What stands before the first point is not used.
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(both, x))
    rises = jnp.broadcast_to(length, (_STEPS + 1,)).at[0].set(0.0)
    start = (x, *blank, jnp.ones((), x.dtype), jnp.asarray(jnp.inf, x.dtype), jnp.asarray(False))
    return jax.lax.scan(step, start, rises)[1]


def _conditional(slope, held):
    # The held column is replaced by one of its own, on which no other depends.
    free = jnp.where(held[None, :], 0.0, slope)
    return covariance(jnp.concatenate([free, held[None, :].astype(slope.dtype)]))


@cached_jit
def _walked(problem: AbstractProblem, x, i, length):
    return walk(problem, x, i, length)


def walks(parameters: Parameters, sd: np.ndarray) -> list[tuple[int, float]]:
    """Which valleys to follow from an optimum: asked-for unknowns, and the length of a step.

    Upwards what may as well be absent; to either side what is seen, but badly.
    """
    found = []
    for i, p in enumerate(parameters):
        if p.nuisance or not isinstance(p.transform, Log):
            continue
        if sd[i] > _UNSEEN:
            found.append((i, _LENGTH))
        elif sd[i] > _SEEN:
            found += [(i, -_SHARE * float(sd[i])), (i, _SHARE * float(sd[i]))]
    return found


def reach(x: np.ndarray, i: int, valley: Valley, parameters: Parameters) -> np.ndarray:
    """(unknown,) the standard deviations whose 95 % intervals about `x` hold the profile's, at most
    those of the priors.

    A profile's interval holds the coordinates of all points whose loss is below chi-squared: of
    those of the valley, with what the others may add to their loss; of `i` itself, up to where
    the root of the loss, nearly straight, crosses.
    """
    z = float(quantile(0.95))
    loss = np.asarray(valley.loss)
    left = z * z - loss[:, None]
    more = np.sqrt(np.maximum(left, 0.0)) * np.asarray(valley.sd)
    moved = np.abs(np.asarray(valley.x) - x)
    away = np.where(left > 0, moved + more, 0.0).max(axis=0, initial=0.0)
    beyond = np.flatnonzero(np.isfinite(loss) & (loss >= z * z))
    if len(beyond) and beyond[0] > 0:
        pair = slice(beyond[0] - 1, beyond[0] + 1)
        away[i] = np.interp(z, np.sqrt(np.maximum(loss[pair], 0.0)), moved[pair, i])
    most = [np.inf if p.spread is None else p.spread for p in parameters]
    return np.minimum(away / z, most)


def followed(along, parameters: Parameters, x: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """(unknown,) `sd`, widened to what the valleys from the optimum `x` ask for.

    `along` (i, length) -> `Valley`.
    """
    found = sd
    for i, length in walks(parameters, sd):
        far = reach(x, i, along(i, length), parameters)
        # What is seen has a slope at the optimum, by which the others know of it already.
        others = (sd[i] > _UNSEEN) | (np.arange(len(sd)) == i)
        found = np.where(others, np.maximum(found, far), found)
    return found


def widened(problem: AbstractProblem, parameters: Parameters, x, cov: np.ndarray) -> np.ndarray:
    """The covariance with the standard deviations that the valleys of its constituents ask for."""
    sd = np.sqrt(np.diag(cov))

    def along(i, length):
        return _walked(problem, jnp.asarray(x), jnp.asarray(i), jnp.asarray(length))

    found = followed(along, parameters, np.asarray(x), sd)
    return cov * np.outer(found / sd, found / sd)
