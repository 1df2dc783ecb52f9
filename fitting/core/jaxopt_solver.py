"""Least squares within bounds by jaxopt: another library, method and kind of derivative."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fitting.core import least_squares as core
from fitting.core.least_squares import AbstractSolver, Optimum, Residual, value_and_jacobian


class BoundedSolver(AbstractSolver):
    """`jaxopt.LBFGSB` in units of the problem's own curvature.

    - `lower`, `upper`: bounds of the coordinates, a number or (unknown,); None stands for `reach`
      scales below and above the start.  The scale of an unknown is the spread of its prior, so
      that the default excludes no optimum that the prior allows.
    - `rounds`: searches, each of which measures each coordinate by the Jacobian where the last
      one ended; strongly nonlinear problems need several.
    - `tolerance`: norm of the projected gradient in these units at which a round ends.

    Independent of the default method in library, steps (quasi-Newton) and derivatives (reverse
    mode).  L-BFGS-B is the one method of jaxopt that keeps bounds, runs inside a compiled program
    and converges here: on the constituents of a cast, `ProjectedGradient` was still 1.3 standard
    deviations from the optimum after 800 steps, `LevenbergMarquardt` knows no bounds, and
    `ScipyBoundedLeastSquares` runs outside of programs only.  A search compiles the model about a
    dozen times.  Not differentiable.
    """

    lower: Float[Array, "..."] | float | None = None
    upper: Float[Array, "..."] | float | None = None
    reach: float = 40.0
    rounds: int = 4
    tolerance: float = 1e-6

    def minimise(
        self,
        residual: Residual,
        start: Float[Array, " unknown"],
        args: Any,
        scale: Float[Array, " unknown"],
        max_steps: int,
    ) -> tuple[Float[Array, " unknown"], Bool[Array, " unknown"]]:
        """See `fitting.core.least_squares.AbstractSolver.minimise`; `max_steps` are of a round."""
        with warnings.catch_warnings():
            # jaxopt announces its retirement at import; the notice is not about this call.
            warnings.simplefilter("ignore", DeprecationWarning)
            import jaxopt

        lower = start - self.reach * scale if self.lower is None else self.lower
        upper = start + self.reach * scale if self.upper is None else self.upper
        lower, upper = (jnp.broadcast_to(jnp.asarray(b, start.dtype), start.shape)
                        for b in (lower, upper))  # fmt: skip

        def half_square(u, x, unit):
            r = residual(x + unit * u, args)
            return 0.5 * jnp.sum(r * r)

        # With a history of all unknowns the approximation to the Hessian forgets nothing.
        solver = jaxopt.LBFGSB(
            half_square,
            tol=self.tolerance,
            maxiter=max_steps,
            history_size=start.shape[0] + 10,
            implicit_diff=False,
        )

        def one_round(x, _):
            slope = value_and_jacobian(lambda x: residual(x, args), x)[1]
            unit = 1.0 / jnp.maximum(jnp.linalg.norm(slope, axis=0), 1.0 / scale)
            bounds = ((lower - x) / unit, (upper - x) / unit)
            moved = solver.run(jnp.zeros_like(x), bounds, x, unit).params
            return jnp.clip(x + unit * moved, lower, upper), None

        begin = jnp.clip(start, lower, upper)
        x = jax.lax.scan(one_round, begin, None, length=self.rounds)[0]
        close = 1e-9 * scale
        return x, (x <= lower + close) | (x >= upper - close)


def least_squares(
    residual: Residual,
    start: Float[Array, " unknown"],
    args: Any = None,
    scale: Float[Array, " unknown"] | None = None,
    max_steps: int = 400,
) -> Optimum:
    """`fitting.core.least_squares.least_squares` by a `BoundedSolver` with its default bounds."""
    return core.least_squares(residual, start, args, scale, max_steps, BoundedSolver())
