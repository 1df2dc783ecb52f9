"""Least squares with priors: the one solver that the three jobs share, and its cross-check."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

Residual = Callable[[Float[Array, " unknown"], Any], Float[Array, " residual"]]

RESULTS = {
    0: "converged",
    1: "the step limit was reached before the optimum: the data hardly constrain some unknown; "
    "add data or prior knowledge, or raise max_steps",
    2: "the model is not finite where the search ended: check units, depths and prior centres",
}


class Optimum(eqx.Module):
    """Where a search ended.

    - `x`: coordinates; `residual`, `jacobian`: of everything, priors included, at x.
    - `code`: index into `RESULTS`.
    """

    x: Float[Array, " unknown"]
    residual: Float[Array, " residual"]
    jacobian: Float[Array, "residual unknown"]
    code: Int[Array, ""]


def least_squares(
    residual: Residual, start: Float[Array, " unknown"], args: Any = None, max_steps: int = 200
) -> Optimum:
    """Minimise |residual(x, args)|^2 by Levenberg-Marquardt with forward-mode derivatives.

    Pure: jit and vmap it; a lane that fails carries a code instead of raising.
    """
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    solution = optx.least_squares(
        residual,
        solver,
        start,
        args,
        options={"jac": "fwd"},
        max_steps=max_steps,
        throw=False,
        adjoint=optx.ImplicitAdjoint(),
    )
    # The solver's last linearisation is that of the optimum: no second Jacobian to compile.
    last = solution.state.f_info
    value, slope = last.residual, last.jac.as_matrix()
    finite = jnp.all(jnp.isfinite(value)) & jnp.all(jnp.isfinite(slope))
    code = jnp.where(finite, jnp.where(solution.result == optx.RESULTS.successful, 0, 1), 2)
    return Optimum(solution.value, value, slope, code.astype(jnp.int32))


def value_and_jacobian(function: Callable, x: Float[Array, " unknown"]):
    """function(x), any tree of arrays, and its forward-mode Jacobian, by one evaluation."""

    def push(tangent):
        return jax.jvp(function, (x,), (tangent,))

    basis = jnp.eye(x.shape[0], dtype=x.dtype)
    return jax.vmap(push, out_axes=(None, -1))(basis)


def covariance(jacobian: Float[Array, "residual unknown"]) -> Float[Array, "unknown unknown"]:
    """Inverse of J^T J.  Directions that nothing constrains come out huge, not as NaN."""
    scale = jnp.maximum(jnp.linalg.norm(jacobian, axis=0), jnp.finfo(jacobian.dtype).tiny ** 0.25)
    _, singular, rows = jnp.linalg.svd(jacobian / scale[None, :], full_matrices=False)
    least = singular[0] * jnp.finfo(jacobian.dtype).eps * jacobian.shape[1]
    half = rows / jnp.maximum(singular, jnp.maximum(least, 1e-150))[:, None] / scale[None, :]
    return half.T @ half


def cross_check(
    residual: Residual, start: Float[Array, " unknown"], args: Any = None, reach: float = 12.0
) -> Float[Array, " unknown"]:
    """The same optimum by another road: jaxopt's bound-constrained L-BFGS, tolerance 1e-8.

    Searches the box start +- reach.  Independent of `least_squares` in method and library.
    """
    import warnings

    with warnings.catch_warnings():
        # jaxopt announces its retirement at import; the notice is not about this call.
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt

    def objective(x):
        r = residual(x, args)
        return 0.5 * jnp.sum(r * r)

    solver = jaxopt.LBFGSB(fun=objective, tol=1e-8, maxiter=500)
    return solver.run(start, bounds=(start - reach, start + reach)).params


def sentence(code) -> str:
    """The sentence of a result code."""
    return RESULTS[int(np.asarray(code))]
