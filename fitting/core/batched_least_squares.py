"""Least squares by hand-written steps, where those of a library would cost more.

Levenberg-Marquardt for many problems of one shape, a few steps a call, so that problems that have
ended make room for others; and Gauss-Newton with numpy for problems that share their size with
few others and estimate their own noise.

What optimistix would cost instead, measured on the constituents of 64 casts of 7 bands in chunks of
16, with the same model, Jacobian and starts, on two cores: `jax.vmap` of `optimistix.least_squares`
takes 3.1 to 3.2 times the processor time with `optimistix.LevenbergMarquardt(1e-6, 1e-6)`, and 6.1
to 6.3 times with the trust region of `fitting.core.least_squares`.  The answers agree within 0.01
standard deviations; the first call, which compiles, costs the same, 13 to 14 s.  A vmapped search
goes on until the slowest of its chunk has ended (100 to 400 steps), as its end is told by changes
of x and of the sum, not by the distance to the optimum in standard deviations.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.core.diagnostics import Status
from fitting.core.least_squares import REMAINING

# Problems of one call, steps of one call, and how many calls a search may take.
CHUNK, STEPS, MOST_CALLS = 16, 4, 100
# Damping of the first step, and the damping at which a search gives up.
FIRST_DAMPING, LARGEST_DAMPING = 0.1, 1e12


class Steps(eqx.Module):
    """Where some steps of Levenberg-Marquardt led.

    - `x`: coordinates; `residual`, `jacobian`: there, the latter in units of the prior's scale.
    - `damping`: of the next step; `ended`: whether none is needed or possible.
    - `code`: of `fitting.core.diagnostics.Status`, as if the search ended here.
    """

    x: Float[Array, " unknown"]
    residual: Float[Array, " residual"]
    jacobian: Float[Array, "residual unknown"]
    damping: Float[Array, ""]
    ended: Bool[Array, ""]
    code: Array


def remaining(residual, jacobian, damping=0.0):
    """The step to the optimum of the linearised, damped problem, and the standard deviations that
    it is long, squared."""
    normal, slope = jacobian.T @ jacobian, jacobian.T @ residual
    ridge = 1e-14 * jnp.trace(normal) + damping
    step = -jax.scipy.linalg.solve(
        normal + ridge * jnp.eye(len(slope), dtype=slope.dtype), slope, assume_a="pos"
    )
    return step, -step @ slope


def levenberg_marquardt_steps(
    both: Callable[[Float[Array, " unknown"]], tuple[Array, Array]],
    x: Float[Array, " unknown"],
    damping: Float[Array, ""],
    scale: Float[Array, " unknown"],
    longest: float,
    count: int = STEPS,
) -> Steps:
    """At most `count` steps from `x`.  Pure: jit and vmap it.

    `both`: x -> residual, and its Jacobian in units of `scale`, the spreads of the priors; in the
    same units no coordinate moves by more than `longest` a step.
    """

    def step(carry):
        x, residual, jacobian, damping, taken, _ = carry
        move, _ = remaining(residual, jacobian, damping)
        move = jnp.clip(move, -longest, longest)
        tried = x + scale * move
        new, slope = both(tried)
        along = jacobian @ move
        predicted = -jnp.sum(along * (residual + 0.5 * along))
        square = 0.5 * jnp.sum(residual**2)
        gain = square - 0.5 * jnp.sum(new**2)
        # A loss below the sum's rounding error is none.
        rounding = 256.0 * jnp.finfo(x.dtype).eps * square
        good = jnp.all(jnp.isfinite(new)) & jnp.all(jnp.isfinite(slope))
        good &= gain >= 0.01 * predicted - rounding
        trust = jnp.where(gain > 0.75 * predicted, 0.1, jnp.where(gain > 0.25 * predicted, 0.5, 2))
        damping = jnp.maximum(damping * jnp.where(good, trust, 5.0), 1e-12).astype(x.dtype)
        x, residual, jacobian = jax.tree.map(
            lambda new, old: jnp.where(good, new, old),
            (tried, new, slope),
            (x, residual, jacobian),
        )
        left = remaining(residual, jacobian)[1]
        ended = (left <= REMAINING**2) | (damping > LARGEST_DAMPING)
        return x, residual, jacobian, damping, taken + 1, ended

    start = (x, *both(x), damping, jnp.zeros((), jnp.int32))
    bad = ~jnp.all(jnp.isfinite(start[1]))
    x, residual, jacobian, damping, _, ended = jax.lax.while_loop(
        lambda carry: (carry[-2] < count) & ~carry[-1], step, (*start, bad)
    )
    finite = jnp.all(jnp.isfinite(residual)) & jnp.all(jnp.isfinite(jacobian))
    close = remaining(residual, jacobian)[1] <= REMAINING**2
    stopped = jnp.where(close, Status.CONVERGED, Status.STEP_LIMIT)
    code = jnp.where(finite, stopped, Status.MODEL_NOT_FINITE).astype(jnp.int32)
    return Steps(x, residual, jacobian, damping, ended, code)


def solve_in_chunks(
    problems: Sequence[Any],
    states: Sequence[Any],
    advance: Callable[[Any, Any], tuple[Any, Any, np.ndarray]],
    next_round: Callable[[Any], Any],
    rounds: int = 1,
) -> list[Any]:
    """Searches of many problems of one shape: `rounds` of them each.

    A chunk takes a few steps at a time, and searches that have ended make room for others: the
    slowest holds up nobody.

    - `problems`, `states`: trees of arrays, and where each search begins.
    - `advance` (stacked problems, stacked states) -> results, states to go on from, and which
      searches have ended, all with a leading axis; a chunk of one shape, padded by its last, or of
      one where there is only one problem.
    - `next_round` (result) -> where the next round begins.

    Returns the results at the end of the last rounds.
    """
    at, done, calls = list(states), [0] * len(problems), [0] * len(problems)
    found: dict[int, Any] = {}
    waiting = list(range(len(problems)))
    while waiting:
        part, waiting = waiting[:CHUNK], waiting[CHUNK:]
        whole_chunk = part + part[-1:] * (CHUNK - len(part)) if len(problems) > 1 else part

        def stacked(items, whole_chunk=whole_chunk):
            return jax.tree.map(lambda *leaves: np.stack(leaves), *[items[i] for i in whole_chunk])

        results, onward, ended = advance(stacked(problems), stacked(at))
        for k, i in enumerate(part):
            own, go_on = jax.tree.map(lambda leaf, k=k: leaf[k], (results, onward))
            calls[i] += 1
            over = bool(ended[k]) or calls[i] >= MOST_CALLS
            if over and done[i] + 1 == rounds:
                found[i] = own
                continue
            if over:
                done[i], calls[i] = done[i] + 1, 0
            at[i] = next_round(own) if over else go_on
            waiting.append(i)
    return [found[i] for i in range(len(problems))]


class NoisyOptimum(NamedTuple):
    """Where `gauss_newton_with_noise` ended: the mode, its covariance and inverse covariance, the
    degrees of freedom left, the Jacobian and misfit of the data before the last step, and the
    variance of the data."""

    x: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    freedom: float
    slopes: np.ndarray
    left: np.ndarray
    variance: float


def gauss_newton_with_noise(
    linear: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    x: np.ndarray,
    prior: np.ndarray,
    count: int,
    variance: float,
    longest: float,
    most: int,
) -> NoisyOptimum:
    """Mode of data of unknown variance under a prior that `prior @ x` is standard normal.

    `linear`: x -> Jacobian (row, unknown) of the model and data less model (row,); `count`: of
    data; `variance`: to begin with, re-estimated each step from the misfit per degree of freedom;
    no coordinate moves by more than `longest` a step, of which there are at most `most`.
    """
    rounds = 0
    while True:
        rounds += 1
        slopes, left = linear(x)
        information = slopes.T @ slopes / variance + prior.T @ prior
        ridge = 1e-12 * np.trace(information) / len(x) * np.eye(len(x))
        covariance = np.linalg.inv(information + ridge)
        step = covariance @ (slopes.T @ left / variance - prior.T @ (prior @ x))
        step = np.clip(step, -longest, longest)
        free = max(count - float(np.sum(covariance * (slopes.T @ slopes))) / variance, 1.0)
        new = float(left @ left) / free
        done = np.abs(step).max() < 1e-5 and abs(new / variance - 1.0) < 1e-4
        x, variance = x + step, new
        if done or rounds == most:
            return NoisyOptimum(x, covariance, information, free, slopes, left, variance)
