"""Statistics along depth against exact enumeration and dense covariance matrices."""

from math import comb

import numpy as np
import pytest
from scipy.stats import norm

from fitting.profile.kd import noise_statistics


def _runs_moments(plus, minus):
    """Exact mean and variance of the number of runs of `plus` and `minus` signs in any order."""
    ways = {}
    for runs in range(2, plus + minus + 1):
        half = runs // 2
        if runs % 2 == 0:
            ways[runs] = 2 * comb(plus - 1, half - 1) * comb(minus - 1, half - 1)
        else:
            ways[runs] = comb(plus - 1, half) * comb(minus - 1, half - 1)
            ways[runs] += comb(plus - 1, half - 1) * comb(minus - 1, half)
    total = comb(plus + minus, plus)
    assert sum(ways.values()) == total
    mean = sum(runs * n for runs, n in ways.items()) / total
    return mean, sum((runs - mean) ** 2 * n for runs, n in ways.items()) / total


@pytest.mark.parametrize(("plus", "minus"), [(6, 6), (12, 8), (20, 5), (30, 30)])
def test_the_runs_test_has_the_mean_and_variance_of_the_exact_distribution(plus, minus):
    mean, variance = _runs_moments(plus, minus)
    rng = np.random.default_rng(plus)
    signs = np.repeat([1.0, -1.0], [plus, minus])
    for _ in range(5):
        order = rng.permutation(signs)
        runs = 1 + np.sum(np.diff(order) != 0)
        expected = 2.0 * norm.sf(abs(runs - mean) / np.sqrt(variance))
        sized = order * rng.uniform(0.1, 3.0, len(order))
        assert noise_statistics.runs_p(sized) == pytest.approx(expected, rel=1e-10)


def test_residuals_of_one_sign_fail_the_runs_test_from_six_samples_on():
    assert noise_statistics.runs_p(np.ones(6)) == 0.0
    assert noise_statistics.runs_p(np.ones(5)) == 1.0


def test_missing_and_zero_residuals_take_no_part_in_the_runs_test():
    order = np.array([1.0, 2.0, -1.0, 3.0, -2.0, -1.0, 1.0, -1.0])
    holes = np.insert(order, [2, 5], [np.nan, 0.0])
    assert noise_statistics.runs_p(holes) == noise_statistics.runs_p(order)


def _covariance(depth, length):
    return np.exp(-np.abs(depth[:, None] - depth[None, :]) / length)


def test_whitened_noise_has_unit_covariance():
    """Rows of W, applied to a root of the covariance V, give W V W^T = 1."""
    depth = np.cumsum(np.random.default_rng(0).uniform(0.1, 0.6, 12))
    used = np.ones(12, bool)
    used[[4, 5]] = False
    root = np.linalg.cholesky(_covariance(depth[used], 0.8))
    columns = np.zeros((12, 10))
    columns[used] = root
    before, first = noise_statistics.previous_used(used)
    rho = noise_statistics.correlation_of_neighbours(depth - depth[before], 0.8)
    white = noise_statistics.whiten(columns, before, np.where(first, 0.0, rho))[used]
    np.testing.assert_allclose(white @ white.T, np.eye(10), atol=1e-12)


def test_correlation_inflation_is_that_of_the_mean_of_many_samples():
    """n var(mean) of unit AR(1) noise, summed over all pairs, with neither end in sight."""
    depth = 0.2 * np.arange(3000)
    inflation = noise_statistics.correlation_inflation(
        depth, np.ones((3000, 1), bool), np.array([0.5])
    )
    pairs = _covariance(depth, 0.5).sum() / len(depth)
    np.testing.assert_allclose(inflation[1:, 0] ** 2, pairs, rtol=2e-3)
    assert inflation[0, 0] == 1.0


def test_at_least_one_sample_in_ninety_nine_counts_as_independent():
    """(1 - 0.98)/(1 + 0.98): neighbours are correlated by 0.98 at most, however long the waves."""
    depth = np.arange(10.0)
    inflation = noise_statistics.correlation_inflation(
        depth, np.ones((10, 1), bool), np.array([1e6])
    )
    np.testing.assert_allclose(inflation[1:, 0] ** 2, 99.0, rtol=1e-9)


def test_the_running_median_is_that_of_medians_of_three():
    values = np.random.default_rng(1).standard_normal((40, 2))
    found = noise_statistics.running_median(values)
    for i in range(4, 36):
        threes = [np.median(values[i + k - 1 : i + k + 2], axis=0) for k in (-3, 0, 3)]
        np.testing.assert_array_equal(found[i], np.median(threes, axis=0))
