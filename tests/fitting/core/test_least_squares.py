"""The least-squares solver."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from fitting.core.diagnostics import Status
from fitting.core.jaxopt_solver import BoundedSolver
from fitting.core.least_squares import (
    check_solver,
    covariance,
    curvature,
    least_squares,
    value_and_jacobian,
)

TIME = np.linspace(0.0, 4.0, 9)


def decay(x, data):
    """Residuals of an exponential decay with 2 % noise."""
    model = jnp.exp(x[0] - jnp.exp(x[1]) * jnp.asarray(TIME, x.dtype))
    return (data - model) / 0.02


def decay_data(seed=0):
    noise = np.random.default_rng(seed).standard_normal(len(TIME))
    return jnp.asarray(np.exp(0.4 - 0.7 * TIME) + 0.02 * noise)


def rosenbrock(x, offset):
    """A curved, narrow minimum at (1, 1), and a residual that nothing can lower."""
    return jnp.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0], offset])


# One program for all tests of the same problem.
SOLVE = jax.jit(lambda start, data: least_squares(decay, start, data))
FOLLOW = jax.jit(lambda start, offset, scale: least_squares(rosenbrock, start, offset, scale))
START = jnp.zeros(2)
UNIT = jnp.ones(2)


@pytest.mark.parametrize("scale", [(1.0, 1.0), (0.1, 10.0)])
def test_rosenbrocks_minimum_is_found(scale):
    found = FOLLOW(jnp.asarray([-1.2, 1.0]), 0.0, jnp.asarray(scale))
    np.testing.assert_allclose(found.x, 1.0, atol=1e-6)
    assert int(found.code) == Status.CONVERGED


def test_the_optimum_is_scipys():
    from scipy.optimize import least_squares as reference

    data = decay_data()
    found = SOLVE(START, data)
    by_scipy = reference(
        lambda x: np.asarray(decay(jnp.asarray(x), data)), np.zeros(2), xtol=1e-14, ftol=1e-14
    )
    np.testing.assert_allclose(found.x, by_scipy.x, atol=1e-7)
    np.testing.assert_allclose(found.residual, decay(found.x, data), atol=1e-10)
    np.testing.assert_allclose(found.jacobian, by_scipy.jac, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("solver", "apart"),
    [
        (optx.LevenbergMarquardt(1e-8, 1e-8), 1e-8),
        (optx.Dogleg(1e-8, 1e-8), 1e-8),
        (optx.BFGS(1e-8, 1e-8), 1e-8),
        (optx.LBFGS(1e-8, 1e-8), 1e-8),
        (BoundedSolver(), 1e-8),
    ],
    ids=lambda one: type(one).__name__,
)
def test_another_solver_ends_at_the_same_optimum(solver, apart):
    data = decay_data(3)
    found = SOLVE(START, data)
    other = jax.jit(lambda data: least_squares(decay, START, data, 0.5 * UNIT, solver=solver))(data)
    assert int(other.code) == Status.CONVERGED
    np.testing.assert_allclose(other.x, found.x, atol=apart)
    np.testing.assert_allclose(other.residual, decay(other.x, data), atol=1e-10)
    np.testing.assert_allclose(other.jacobian, found.jacobian, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("solver", "words"),
    [
        (optx.BFGS, r"the class BFGS; give an instance, as BFGS\(rtol=1e-6"),
        (BoundedSolver, r"the class BoundedSolver; give an instance, as BoundedSolver\(\)"),
        ("BFGS", r"solver is 'BFGS'; give a least-squares solver or a minimiser of optimistix"),
        (optx.Newton(1e-6, 1e-6), "Newton.*; give a least-squares solver or a minimiser"),
    ],
    ids=["class", "class of jaxopt", "string", "root finder"],
)
def test_what_is_no_solver_is_refused_in_a_sentence(solver, words):
    with pytest.raises(TypeError, match=words):
        check_solver(solver)


def test_a_search_that_fails_returns_a_code_and_spares_the_rest_of_its_batch():
    data = jnp.stack([decay_data(0), jnp.full(len(TIME), jnp.nan), decay_data(2)])
    batch = jax.jit(jax.vmap(lambda d: least_squares(decay, START, d)))(data)
    ended = [Status.CONVERGED, Status.MODEL_NOT_FINITE, Status.CONVERGED]
    assert batch.code.tolist() == ended
    np.testing.assert_allclose(batch.x[2], SOLVE(START, data[2]).x, atol=1e-9)
    assert "not finite" in ended[1].message


def test_a_search_cut_short_says_so():
    cut = jax.jit(lambda start: least_squares(rosenbrock, start, 0.0 * start[0], max_steps=3))
    found = cut(jnp.asarray([-1.2, 1.0]))
    assert Status(int(found.code)) is Status.STEP_LIMIT
    assert "step limit" in Status.STEP_LIMIT.message


@pytest.mark.parametrize("offset", [1.0, 1e4])
def test_steps_below_the_rounding_error_of_the_sum_end_the_search(offset):
    found = FOLLOW(1.0001 * UNIT, offset, UNIT)
    assert int(found.code) == 0
    np.testing.assert_allclose(found.x, 1.0, atol=1e-4)


def test_single_precision_in_single_precision_out():
    found = SOLVE(START.astype(jnp.float32), decay_data().astype(jnp.float32))
    assert found.x.dtype == found.jacobian.dtype == jnp.float32
    assert int(found.code) == 0
    np.testing.assert_allclose(found.x, SOLVE(START, decay_data()).x, atol=2e-5)


def test_derivative_of_the_optimum_is_that_of_the_implicit_function():
    data = decay_data()

    def level(size):
        return SOLVE(START, data * size).x

    step = 1e-4
    difference = (level(1 + step) - level(1 - step)) / (2 * step)
    # Scaling the data moves the logarithm of the amplitude alone.
    np.testing.assert_allclose(difference, [1.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(jax.jacfwd(level)(1.0), difference, atol=1e-3)


def test_value_and_jacobian_agree_with_jax_and_with_differences():
    x = jnp.asarray([0.3, -0.4])

    def tree(x):
        return {"wave": jnp.sin(x[0] * jnp.arange(3.0)), "sum": jnp.sum(x**2)}

    value, slope = value_and_jacobian(tree, x)
    assert slope["wave"].shape == (3, 2)
    for name in value:
        np.testing.assert_allclose(value[name], tree(x)[name])
        np.testing.assert_allclose(slope[name], jax.jacfwd(tree)(x)[name], atol=1e-14)
        for i in range(2):
            move = 1e-6 * jnp.eye(2)[i]
            difference = (tree(x + move)[name] - tree(x - move)[name]) / 2e-6
            np.testing.assert_allclose(slope[name][..., i], difference, atol=1e-9)


def test_covariance_is_the_inverse_of_the_information():
    jacobian = np.random.default_rng(0).standard_normal((10, 4))
    np.testing.assert_allclose(
        covariance(jnp.asarray(jacobian)), np.linalg.inv(jacobian.T @ jacobian), rtol=1e-10
    )


@pytest.mark.parametrize("decades", [6, 12, 40])
def test_covariance_does_not_mind_the_units_of_the_unknowns(decades):
    jacobian = np.random.default_rng(0).standard_normal((10, 3))
    units = np.array([1.0, 10.0**-decades, 10.0**decades])
    plain = np.linalg.inv(jacobian.T @ jacobian)
    scaled = np.asarray(covariance(jnp.asarray(jacobian * units)))
    np.testing.assert_allclose(scaled * np.outer(units, units), plain, rtol=1e-8)


def test_covariance_of_nearly_parallel_columns_keeps_its_digits():
    from mpmath import mp, mpf

    # Condition 1e6: the normal equations in double precision would keep four digits.
    base = np.linspace(0.0, 1.0, 6)
    jacobian = np.column_stack([np.ones(6), 1.0 + 1e-6 * base])
    with mp.workdps(40):
        rows = mp.matrix([[mpf(v) for v in row] for row in jacobian.tolist()])
        exact = np.array((rows.T * rows) ** -1, dtype=float).reshape(2, 2)
    np.testing.assert_allclose(covariance(jnp.asarray(jacobian)), exact, rtol=1e-8)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("kind", ["zero column", "equal columns"])
def test_directions_that_nothing_constrains_are_huge_not_nan(kind, dtype):
    jacobian = np.random.default_rng(2).standard_normal((8, 3))
    jacobian[:, 2] = 0.0 if kind == "zero column" else jacobian[:, 1]
    cov = np.asarray(covariance(jnp.asarray(jacobian, dtype)))
    assert np.all(np.isfinite(cov))
    assert cov[2, 2] > 1e4
    # The constrained unknown keeps its variance.
    kept = jacobian[:, :2]
    best = np.linalg.inv(kept.T @ kept)[0, 0]
    assert cov[0, 0] == pytest.approx(best, rel=1e-3)


def test_curvature_gives_the_spread_of_a_quadratic_model():
    """r_i = x_i + c_i (d_i . x)^2 over the spreads s_i, d_i of length 1 in these: the mode errs by
    -c_i z^2, z standard normal, of mean -c_i and standard deviation 2^(1/2) c_i."""
    rng = np.random.default_rng(3)
    count = 30
    size = np.exp(rng.standard_normal(count))
    bend = 0.1 * rng.standard_normal(count)
    across = rng.standard_normal((count, count))
    across /= np.linalg.norm(across, axis=1)[:, None] * size[None, :]

    def function(x):
        bent = x + jnp.asarray(bend * size) * (jnp.asarray(across) @ x) ** 2
        return bent / jnp.asarray(size), {"log": x[0] + x[1], "straight": 3.0 * x[2]}

    x = jnp.zeros(count)
    _, jacobian = value_and_jacobian(lambda x: function(x)[0], x)
    _, slopes = value_and_jacobian(lambda x: function(x)[1], x)
    found = curvature(function, x, covariance(jacobian), jacobian, slopes)
    # The spread is estimated from as many directions as there are unknowns: right on average.
    share = np.asarray(found.sd) / (np.sqrt(2) * np.abs(bend) * size)
    assert np.sqrt(np.mean(share**2)) == pytest.approx(1.0, abs=0.12)
    assert np.all((share > 0.3) & (share < 2.0))
    straight = np.asarray(found.derived["straight"])
    assert straight == pytest.approx(3 * np.asarray(found.sd)[2], rel=1e-8)
    assert found.derived["log"] > 0
