"""The search behind `fitting.core.least_squares.least_squares`, in optimistix's terms."""

from collections.abc import Callable

import jax.numpy as jnp
import optimistix as optx


class _TrustRegion(optx.AbstractSearch):
    """Longer steps after good ones, shorter after bad ones, as in `optx.ClassicalTrustRegion`.

    Two differences.  Steps grow as soon as the linear model is roughly right, as the sum of
    squares of these problems has long, curved ridges of nearly equal values.  And a change of the
    sum below its rounding error counts as no loss: otherwise the search refuses each of its last
    steps and does not end before its step limit.
    """

    def init(self, y, f_info_struct):
        return jnp.ones((), y.dtype)

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        along = f_info.jac.mv(y_eval - y)
        predicted = jnp.sum(along * (f_info.residual + 0.5 * along))
        before = f_info.as_min()
        change = f_eval_info.as_min() - before
        rounding = 256.0 * jnp.finfo(y.dtype).eps * before
        accept = first_step | (change <= 0.01 * predicted + rounding)
        good = ~first_step & (change <= 0.75 * predicted + rounding)
        step_size = state * jnp.where(accept, jnp.where(good, 5.0, 1.0), 0.25).astype(y.dtype)
        return step_size, accept, optx.RESULTS.successful, step_size


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt with these tolerances in units of the coordinates' scales."""

    rtol: float = 1e-6
    atol: float = 1e-6
    norm: Callable = optx.max_norm
    descent: optx.AbstractDescent = optx.DampedNewtonDescent()
    search: optx.AbstractSearch = _TrustRegion()
    verbose: Callable = lambda **_: None
