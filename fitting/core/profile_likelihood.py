"""Standard deviations by profile likelihood, where those at the optimum would be too small.

On a log scale the slope of a constituent that may be absent vanishes: at such an optimum it seems
to explain no part of the signal, and the standard deviations of the others come out as if it were
known to be absent.  Profiling over that constituent lets it explain part of the signal; the
standard deviations of the others grow accordingly.

The more there is of a poorly determined constituent, the better it is determined: at an optimum
that came out high its standard deviation is too small, and the truth lies further below than the
ellipsoid says.  There both sides are profiled, and the wider one sets its standard deviation.
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

# Standard deviation of ln above which a constituent may be absent: uncertain by a factor of e.
_UNDETERMINED = 1.0
# Standard deviation of ln below which the ellipsoid at the optimum is good enough.
_WELL_DETERMINED = 0.15
# Steps upwards and their length (ln): a factor of 120 in all.
_STEPS, _LENGTH = 16, 0.3
# Length of steps to either side of a poorly determined constituent, in standard deviations.
_STEP_SD = 0.5
# Evaluations of the model at most per point, the first where the step leads; the factor that
# shortens a Gauss-Newton step which raised the loss; the decrease of the loss below which the
# others count as optimal; the loss at which the profile ends.
_EVALUATIONS, _SHORTER, _SETTLED, _HIGHEST_LOSS = 5, 0.3, 0.02, 8.0


class LikelihoodProfile(NamedTuple):
    """Points of a profile: `x` (step, unknown), the loss |residual|^2 above the optimum's (step,),
    and the standard deviations `sd` (step, unknown) of the other unknowns there, with the profiled
    one held."""

    x: Any
    loss: Any
    sd: Any


def profile_along(
    problem: AbstractProblem,
    x: Float[Array, " unknown"],
    i: Int[Array, ""],
    length: Float[Array, ""] | None = None,
) -> LikelihoodProfile:
    """Profile along the coordinate `i` from the optimum `x`, all others optimised by Gauss-Newton.

    `length`: of a step, upwards unless negative.  The loss of points beyond the profile's end is
    infinite.  Pure: jit and vmap it.
    """
    held = jnp.arange(x.shape[0]) == i
    length = jnp.asarray(_LENGTH, x.dtype) if length is None else length

    def linearise(x):
        return value_and_jacobian(problem.residual, x)

    # One call of the model for both kinds of step: a second call would be a copy to compile.
    def move(carry):
        x, value, slope, rise, share, count, _ = carry
        step = -_conditional(slope, held) @ jnp.where(held, 0.0, value @ slope)
        new = count == 0
        tried = jnp.where(new, jnp.where(held, x + rise, x), x + share * step)
        there = linearise(tried)
        finite = jnp.all(jnp.isfinite(there[0])) & jnp.all(jnp.isfinite(there[1]))
        less = jnp.sum(value**2) - jnp.sum(there[0] ** 2)
        good = new | (finite & (less > 0))
        x, value, slope = jax.tree.map(
            lambda ours, theirs: jnp.where(good, theirs, ours), (x, value, slope), (tried, *there)
        )
        share = jnp.where(good, 1.0, _SHORTER * share)
        return x, value, slope, rise, share, count + 1, jnp.where(good & ~new, less, jnp.inf)

    def unsettled(carry):
        return (carry[5] < _EVALUATIONS) & (carry[6] > _SETTLED)

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
        # The first point is the optimum: losses are above its own.
        least = jnp.where(jnp.isfinite(least), least, total)
        loss = total - least
        done = ~(loss < _HIGHEST_LOSS)
        return (x, value, slope, share, least, done), LikelihoodProfile(
            x, loss, jnp.where(held, 0.0, sd)
        )

    def stay(carry, _):
        x = carry[0]
        return carry, LikelihoodProfile(x, jnp.asarray(jnp.inf, x.dtype), jnp.zeros_like(x))

    def step(carry, rise):
        return jax.lax.cond(carry[5], stay, go, carry, rise)

    # The carry's values before the first point are not used.
    blank = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(linearise, x)
    )
    rises = jnp.broadcast_to(length, (_STEPS + 1,)).at[0].set(0.0)
    start = (x, *blank, jnp.ones((), x.dtype), jnp.asarray(jnp.inf, x.dtype), jnp.asarray(False))
    return jax.lax.scan(step, start, rises)[1]


def _conditional(slope, held):
    # Replace the held column by one that is independent of all others.
    free = jnp.where(held[None, :], 0.0, slope)
    return covariance(jnp.concatenate([free, held[None, :].astype(slope.dtype)]))


@cached_jit
def _profile_along(problem: AbstractProblem, x, i, length):
    return profile_along(problem, x, i, length)


def profiles_needed(parameters: Parameters, sd: np.ndarray) -> list[tuple[int, float]]:
    """Which unknowns that are asked for to profile from an optimum: index and length of a step.

    Upwards where the constituent may be absent; to either side where it is poorly determined.
    """
    found = []
    for i, p in enumerate(parameters):
        if p.nuisance or not isinstance(p.transform, Log):
            continue
        if sd[i] > _UNDETERMINED:
            found.append((i, _LENGTH))
        elif sd[i] > _WELL_DETERMINED:
            found += [(i, -_STEP_SD * float(sd[i])), (i, _STEP_SD * float(sd[i]))]
    return found


def profile_sd(
    x: np.ndarray, i: int, profile: LikelihoodProfile, parameters: Parameters
) -> np.ndarray:
    """(unknown,) standard deviations whose 95 % intervals about `x` contain those of the profile,
    at most the standard deviations of the priors.

    A profile's interval contains the coordinates of all points whose loss is below chi-squared: the
    profile's own points, widened by what each other unknown may add to the loss; `i` itself up to
    where the root of the loss, which is nearly linear, crosses.
    """
    z = float(quantile(0.95))
    loss = np.asarray(profile.loss)
    left = z * z - loss[:, None]
    more = np.sqrt(np.maximum(left, 0.0)) * np.asarray(profile.sd)
    moved = np.abs(np.asarray(profile.x) - x)
    distance = np.where(left > 0, moved + more, 0.0).max(axis=0, initial=0.0)
    beyond = np.flatnonzero(np.isfinite(loss) & (loss >= z * z))
    if len(beyond) and beyond[0] > 0:
        pair = slice(beyond[0] - 1, beyond[0] + 1)
        distance[i] = np.interp(z, np.sqrt(np.maximum(loss[pair], 0.0)), moved[pair, i])
    most = [np.inf if p.spread is None else p.spread for p in parameters]
    return np.minimum(distance / z, most)


def profile_adjusted_sd(along, parameters: Parameters, x: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """(unknown,) `sd`, raised to those of the profiles from the optimum `x`.

    `along` (i, length) -> `LikelihoodProfile`.
    """
    found = sd
    for i, length in profiles_needed(parameters, sd):
        far = profile_sd(x, i, along(i, length), parameters)
        # A determined constituent has a slope at the optimum: it is in the others' sd already.
        others = (sd[i] > _UNDETERMINED) | (np.arange(len(sd)) == i)
        found = np.where(others, np.maximum(found, far), found)
    return found


def profile_adjusted_covariance(
    problem: AbstractProblem, parameters: Parameters, x, cov: np.ndarray
) -> np.ndarray:
    """The covariance with standard deviations raised to those of the constituents' profiles."""
    sd = np.sqrt(np.diag(cov))

    def along(i, length):
        return _profile_along(problem, jnp.asarray(x), jnp.asarray(i), jnp.asarray(length))

    found = profile_adjusted_sd(along, parameters, np.asarray(x), sd)
    return cov * np.outer(found / sd, found / sd)
