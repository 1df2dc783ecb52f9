"""Steps of Levenberg-Marquardt shared out over many problems, and Gauss-Newton with noise."""

import jax
import jax.numpy as jnp
import numpy as np

from fitting.core.batched_least_squares import (
    CHUNK,
    FIRST_DAMPING,
    STEPS,
    gauss_newton_with_noise,
    levenberg_marquardt_steps,
    solve_in_chunks,
)
from fitting.core.diagnostics import Status
from fitting.core.least_squares import covariance, least_squares, value_and_jacobian
from tests.fitting.core.test_least_squares import START, decay, decay_data

SCALE = jnp.asarray([0.5, 2.0])


@jax.jit
@jax.vmap
def steps(data, at):
    def both(x):
        value, slope = value_and_jacobian(lambda x: decay(x, data), x)
        return value, slope * SCALE[None, :]

    return levenberg_marquardt_steps(both, *at, SCALE, 3.0)


def searched(data, rounds=1):
    """Results of all problems, and the numbers of problems and of ended searches by call."""
    calls = []

    def advance(data, at):
        found = jax.tree.map(np.asarray, steps(data, at))
        calls.append((len(found.code), int(found.ended.sum())))
        return found, (found.x, found.damping), found.ended

    start = (np.asarray(START), np.asarray(FIRST_DAMPING))
    # Later rounds begin where the last one ended.
    return (
        solve_in_chunks(
            list(data), [start] * len(data), advance, lambda f: (f.x, start[1]), rounds
        ),
        calls,
    )


def test_many_searches_end_at_their_own_optima():
    data = [np.asarray(decay_data(seed)) for seed in range(CHUNK + 5)]
    found, calls = searched(data)
    assert len(found) == len(data)
    for one, own in zip(data, found, strict=True):
        best = least_squares(decay, START, jnp.asarray(one))
        assert own.code == Status.CONVERGED
        sd = np.sqrt(np.diag(covariance(best.jacobian)))
        # A thousandth of a standard deviation is converged.
        assert np.max(np.abs(own.x - np.asarray(best.x)) / sd) < 1e-3
    # Chunks are full while anything is left, the last one padded; and each needed several calls.
    assert {count for count, _ in calls} == {CHUNK}
    assert len(calls) > 2


def test_a_search_alone_is_not_padded_and_rounds_follow_each_other():
    data = [np.asarray(decay_data())]
    (once,), calls = searched(data)
    (twice,), more = searched(data, rounds=2)
    assert {count for count, _ in calls} == {1}
    assert len(more) > len(calls)
    assert np.sum(twice.residual**2) <= np.sum(once.residual**2)


def test_a_model_that_is_not_finite_ends_at_once_and_spares_the_others():
    data = [np.asarray(decay_data()), np.full(9, np.nan)]
    (good, bad), _ = searched(data)
    assert good.code == Status.CONVERGED
    assert bad.code == Status.MODEL_NOT_FINITE
    np.testing.assert_array_equal(bad.x, START)


def test_steps_are_few_and_no_longer_than_the_limit():
    data = jnp.asarray(decay_data())

    def both(x):
        value, slope = value_and_jacobian(lambda x: decay(x, data), x)
        return value, slope * SCALE[None, :]

    begin = jnp.asarray([-2.0, 1.0])
    found = jax.jit(lambda x: levenberg_marquardt_steps(both, x, jnp.asarray(0.1), SCALE, 0.01))(
        begin
    )
    moved = np.abs(np.asarray(found.x - begin) / np.asarray(SCALE))
    assert not found.ended
    assert found.code == Status.STEP_LIMIT
    assert 0.01 <= moved.max() <= STEPS * 0.01 * (1 + 1e-12)


def test_the_variance_of_a_straight_line_is_that_of_linear_regression():
    rng = np.random.default_rng(0)
    time = np.linspace(0.0, 1.0, 40)
    design = np.stack([np.ones(40), time], axis=1)
    y = design @ [1.0, -0.5] + 0.1 * rng.standard_normal(40)
    nothing = np.zeros((1, 2))
    found = gauss_newton_with_noise(
        lambda x: (design, y - design @ x), np.zeros(2), nothing, 40, 1.0, 0.4, 30
    )
    best, square = np.linalg.lstsq(design, y, rcond=None)[:2]
    np.testing.assert_allclose(found.x, best, atol=1e-9)
    assert abs(found.freedom - 38.0) < 1e-9
    np.testing.assert_allclose(found.variance, square[0] / 38.0, rtol=1e-9)
    expected = found.variance * np.linalg.inv(design.T @ design)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6)
    # A prior of unit spread about 0 on either unknown, with the noise known to be 1.
    strong = gauss_newton_with_noise(
        lambda x: (design, y - design @ x), np.zeros(2), np.eye(2), 40, 1.0, 9.0, 1
    )
    ridge = np.linalg.solve(design.T @ design + np.eye(2), design.T @ y)
    np.testing.assert_allclose(strong.x, ridge, rtol=1e-9)
