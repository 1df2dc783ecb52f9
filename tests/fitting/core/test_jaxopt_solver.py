"""Least squares within bounds by jaxopt."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares as reference

from fitting.core import jaxopt_solver
from fitting.core.diagnostics import Status
from fitting.core.jaxopt_solver import BoundedSolver
from fitting.core.least_squares import least_squares
from tests.fitting.core.test_least_squares import START, decay, decay_data, rosenbrock


def test_the_function_is_the_solver_with_its_default_bounds():
    data = decay_data(3)
    by_function = jaxopt_solver.least_squares(decay, START, data)
    by_solver = least_squares(decay, START, data, solver=BoundedSolver())
    np.testing.assert_array_equal(by_function.x, by_solver.x)
    # 0.02: the standard deviation of the better determined unknown.
    np.testing.assert_allclose(by_function.x, least_squares(decay, START, data).x, atol=1e-6 * 0.02)


def test_rosenbrocks_minimum_is_found():
    found = jaxopt_solver.least_squares(rosenbrock, jnp.asarray([-1.2, 1.0]), jnp.asarray(0.0))
    np.testing.assert_allclose(found.x, 1.0, atol=1e-6)
    assert int(found.code) == Status.CONVERGED


@pytest.mark.parametrize("name", ["lower", "upper"])
def test_an_optimum_on_a_bound_is_scipys(name):
    data = decay_data()
    free = least_squares(decay, START, data).x
    # The optimum of the second unknown lies 0.3 beyond the bound.
    bound = {"lower": free[1] + 0.3, "upper": free[1] - 0.3}[name]
    sides = {"lower": (np.array([-9.0, bound]), np.full(2, 9.0)),
             "upper": (np.full(2, -9.0), np.array([9.0, bound]))}[name]  # fmt: skip
    solver = BoundedSolver(jnp.asarray(sides[0]), jnp.asarray(sides[1]))
    found = least_squares(decay, START, data, solver=solver)
    by_scipy = reference(
        lambda x: np.asarray(decay(jnp.asarray(x), data)),
        np.clip(START, sides[0] + 1e-3, sides[1] - 1e-3),
        bounds=sides,
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    assert float(found.x[1]) == pytest.approx(float(bound), abs=1e-12)
    np.testing.assert_allclose(found.x, by_scipy.x, atol=1e-6)
    assert int(found.code) == Status.CONVERGED
