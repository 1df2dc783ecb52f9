"""Least squares with priors: the solver that all fits share."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.core.diagnostics import Status

Residual = Callable[[Float[Array, " unknown"], Any], Float[Array, " residual"]]

# Standard deviations from the optimum at which a search counts as converged.
REMAINING = 1e-3


class Optimum(eqx.Module):
    """Where a search ended.

    - `x`: coordinates; `residual`, `jacobian`: of everything, priors included, at x.
    - `code`: of the `fitting.core.diagnostics.Status`.
    """

    x: Float[Array, " unknown"]
    residual: Float[Array, " residual"]
    jacobian: Float[Array, "residual unknown"]
    code: Int[Array, ""]


def _with_matrix(function: Residual) -> Residual:
    """The same function, whose derivative in the first argument is a matrix computed once.

    The solver applies the linearised residual in several places; without this, each place would
    compile a copy of the model's derivative.
    """

    def rule(primals, tangents):
        (u, args), (du, dargs) = primals, tangents
        value, slope = value_and_jacobian(lambda u: function(u, args), u)
        zero = jax.custom_derivatives.SymbolicZero
        tangent = jnp.zeros_like(value) if isinstance(du, zero) else slope @ du
        moved = jax.tree.leaves(dargs, is_leaf=lambda leaf: isinstance(leaf, zero))
        if any(not isinstance(leaf, zero) for leaf in moved):
            dargs = jax.tree.map(_materialised, args, dargs)
            tangent += jax.jvp(lambda args: function(u, args), (args,), (dargs,))[1]
        return value, tangent

    wrapped = jax.custom_jvp(function)
    wrapped.defjvp(rule, symbolic_zeros=True)
    return wrapped


def _materialised(primal, tangent):
    if not isinstance(tangent, jax.custom_derivatives.SymbolicZero):
        return tangent
    inexact = jnp.issubdtype(primal.dtype, jnp.inexact)
    return jnp.zeros_like(primal) if inexact else np.zeros(primal.shape, jax.dtypes.float0)


class AbstractSolver(eqx.Module):
    """A method of another library than optimistix, as the argument `solver` of a fit."""

    @abc.abstractmethod
    def minimise(
        self,
        residual: Residual,
        start: Float[Array, " unknown"],
        args: Any,
        scale: Float[Array, " unknown"],
        max_steps: int,
    ) -> tuple[Float[Array, " unknown"], Bool[Array, " unknown"]]:
        """Where |residual(x, args)|^2 is least, and which coordinates lie on a bound there.

        Arguments as for `least_squares`.  Runs inside a compiled program.
        """


def check_solver(solver: Any) -> None:
    """TypeError where `solver` is none that `least_squares` takes."""
    if solver is None or isinstance(solver, AbstractSolver):
        return
    import optimistix as optx

    kinds = (optx.AbstractLeastSquaresSolver, optx.AbstractMinimiser)
    if isinstance(solver, kinds):
        return
    if isinstance(solver, type) and issubclass(solver, (*kinds, AbstractSolver)):
        numbers = "" if issubclass(solver, AbstractSolver) else "rtol=1e-6, atol=1e-6"
        name = solver.__name__
        raise TypeError(f"solver is the class {name}; give an instance, as {name}({numbers}).")
    raise TypeError(
        f"solver is {solver!r}; give a least-squares solver or a minimiser of optimistix, as "
        "optimistix.BFGS(rtol=1e-6, atol=1e-6), or fitting.core.jaxopt_solver.BoundedSolver()."
    )


def least_squares(
    residual: Residual,
    start: Float[Array, " unknown"],
    args: Any = None,
    scale: Float[Array, " unknown"] | None = None,
    max_steps: int = 400,
    solver: Any = None,
) -> Optimum:
    """Minimise |residual(x, args)|^2, by Levenberg-Marquardt with forward-mode derivatives unless
    another solver is given.

    `scale`: expected size of each coordinate's change, 1 unless given; the damping is equal in
    these units.  A search has converged when the remaining step of the linearised problem is below
    a thousandth of a standard deviation, whatever the solver.

    `solver`: an `optimistix.AbstractLeastSquaresSolver`, an `optimistix.AbstractMinimiser`, which
    sees half the sum of squares and may take ten times as many steps, or an `AbstractSolver`.
    Their tolerances are in units of `scale`.

    Pure: jit and vmap it; a search that fails returns a code instead of raising.
    """
    unit = jnp.ones_like(start) if scale is None else scale.astype(start.dtype)
    if isinstance(solver, AbstractSolver):
        found, on_bound = solver.minimise(residual, start, args, unit, max_steps)
        x = jax.lax.stop_gradient(found)
        value, slope = value_and_jacobian(lambda x: residual(x, args), x)
    else:
        x, value, slope = _by_optimistix(residual, start, args, unit, max_steps, solver)
        on_bound = None
    finite = jnp.all(jnp.isfinite(value)) & jnp.all(jnp.isfinite(slope))
    downhill = jnp.where(finite, value @ slope, 0.0)
    usable = jnp.where(finite, slope, 0.0)
    if on_bound is not None:
        downhill, usable = jnp.where(on_bound, 0.0, downhill), jnp.where(on_bound, 0.0, usable)
    remaining = downhill @ covariance(usable) @ downhill
    ended = jnp.where(remaining <= REMAINING**2, Status.CONVERGED, Status.STEP_LIMIT)
    code = jnp.where(finite, ended, Status.MODEL_NOT_FINITE)
    return Optimum(x, value, slope, code.astype(jnp.int32))


def _by_optimistix(residual, start, args, unit, max_steps: int, solver):
    """Where a solver of optimistix ends, with the residual and its Jacobian there."""
    # Stored programs need no solver, so a command that finds them is spared this import.
    import optimistix as optx

    from fitting.core._trust_region import LevenbergMarquardt

    def misfit(u, args):
        origin, unit, args = args
        return residual(origin + unit * u, args)

    solver = LevenbergMarquardt() if solver is None else solver
    solution = optx.least_squares(
        _with_matrix(misfit),
        solver,
        jnp.zeros_like(start),
        (*jax.lax.stop_gradient((start, unit)), args),
        options={"jac": "fwd"},
        max_steps=10 * max_steps if isinstance(solver, optx.AbstractMinimiser) else max_steps,
        throw=False,
        adjoint=optx.ImplicitAdjoint(),
    )
    x = start + unit * solution.value
    if not isinstance(solver, optx.AbstractGaussNewton):
        return x, *value_and_jacobian(lambda x: residual(x, args), x)
    # The solver's last linearisation is that of the optimum: no second Jacobian to compile.
    last = solution.state.f_info
    return x, last.residual, last.jac.as_matrix() / unit[None, :]


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


class SecondOrderError(eqx.Module):
    """Second-order errors of a mode, which the curvature of a model causes.

    - `sd`, `derived`: standard deviation of the second-order part of the errors of the
      coordinates (unknown,), and of a tree of derived numbers.
    """

    sd: Float[Array, " unknown"]
    derived: Any


def curvature(
    function: Callable,
    x: Float[Array, " unknown"],
    cov: Float[Array, "unknown unknown"],
    jacobian: Float[Array, "residual unknown"],
    slopes: Any,
    step: float = 0.1,
) -> SecondOrderError:
    """Standard deviations of the second-order errors of a mode of nonlinear least squares.

    `function` (x) -> (residual, tree of derived numbers); `slopes`: the Jacobian of the latter.  A
    mode errs by d + q(d), d its linear error and q_i = 1/2 d^T M_i d with M_i the Hessian of
    x_i - (C J^T r)_i.  The standard deviation of q is (1/2 tr (M_i C)^2)^1/2.

    Estimated from second differences over `step` standard deviations along randomly rotated
    orthogonal axes, as many as there are unknowns: the trace of the square is then right within
    some 30 %.  This compiles the model once more, but none of its derivatives.
    """
    count = x.shape[0]
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((count, count)))[0]
    unit = jnp.sqrt(jnp.diagonal(cov))
    values, vectors = jnp.linalg.eigh(cov / unit[:, None] / unit[None, :])
    axes = unit[:, None] * vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]
    axes = step * (axes @ jnp.asarray(turn, x.dtype)).T
    points = jnp.concatenate([x[None, :], x[None, :] + axes, x[None, :] - axes])
    values_at = jax.lax.map(function, points, batch_size=16)

    def second_derivative(leaf):
        """(axis, ...) second derivatives."""
        found = (leaf[1 : count + 1] + leaf[count + 1 :] - 2.0 * leaf[:1]) / step**2
        return jnp.where(jnp.isfinite(found), found, 0.0)

    of_residual, of_derived = jax.tree.map(second_derivative, values_at)
    pull = -of_residual @ jnp.where(jnp.isfinite(jacobian), jacobian, 0.0) @ cov

    def standard_deviation(diagonal):
        # Of M in axes turned at random, E sum M_kk^2 = ((tr M)^2 + 2 tr M^2) / (n + 2).
        square = (count + 2) * jnp.sum(diagonal**2, axis=0) - jnp.sum(diagonal, axis=0) ** 2
        return jnp.sqrt(jnp.maximum(0.25 * square, 0.0))

    def of_tree(own, slope):
        carried = jnp.tensordot(pull, slope, axes=[[1], [slope.ndim - 1]])
        return standard_deviation(own + carried)

    derived = jax.tree.map(of_tree, of_derived, slopes)
    return SecondOrderError(standard_deviation(pull), derived)
