"""Where the judgement of a fit turns: identifiable, wide, chains that agree, profiles."""

import jax.numpy as jnp
import numpy as np
import pytest

from fitting import NUTS, Identity, Parameter, sample
from fitting.core import profile_likelihood, sampling
from fitting.core.parameters import Parameters
from tests.fitting.core import test_result, test_sampling


@pytest.mark.parametrize(
    ("spread", "sd", "expected"),
    # Half of the logarithm is a factor of 1.65; four fifths of its prior's spread was decided by
    # the prior.
    [(None, 0.495, True), (None, 0.505, False), (0.4, 0.318, True), (0.4, 0.322, False)],
)
def test_identifiable_turns_at_half_a_logarithm_and_four_fifths_of_the_prior(spread, sd, expected):
    one = test_result.fit([Parameter("cdom", 0.1, spread)], [0.0], [sd])
    assert one.identifiable == {"cdom": expected}


@pytest.mark.parametrize(("sd", "wide"), [(0.495, False), (0.505, True), (float("nan"), True)])
def test_a_fit_is_wide_beyond_half_a_logarithm(sd, wide):
    assert test_result.fit([Parameter("cdom", 0.1)], [0.0], [sd]).wide == wide
    assert not test_result.fit([Parameter("cdom", 0.1, nuisance=True)], [0.0], [sd]).wide


def split_rhat(chains):
    """Gelman et al. 2013, section 11.4, of (chain, draw): each chain in halves."""
    half = chains.shape[1] // 2
    parts = np.concatenate([chains[:, :half], chains[:, half : 2 * half]])
    within = np.mean(np.var(parts, axis=1, ddof=1))
    between = np.var(np.mean(parts, axis=1), ddof=1)
    return np.sqrt((half - 1) / half + between / within)


@pytest.mark.parametrize("limit", [1.047, 1.053])
def test_chains_agree_up_to_a_split_rhat_of_one_point_oh_five(limit, monkeypatch):
    """Four chains of independent draws, the means of two of them shifted apart."""
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((4, 100, 2))
    shift = np.array([1.0, -1.0, 1.0, -1.0])[:, None]
    low, high = 0.0, 2.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        rhat = split_rhat(draws[:, :, 0] + middle * shift)
        low, high = (middle, high) if rhat < limit else (low, middle)
    draws[:, :, 0] += low * shift
    assert split_rhat(draws[:, :, 0]) == pytest.approx(limit, abs=1e-6)

    def run(*_):
        return jnp.asarray(draws), jnp.zeros(4), jnp.ones(4)

    monkeypatch.setattr(sampling, "_run", run)
    found = sample(test_sampling.fit(0.0), sampler=NUTS(draws=400, chains=4))
    assert found.converged == (limit < 1.05)


def test_profiles_are_followed_where_a_constituent_is_badly_known():
    """Either way in steps of half a deviation between 0.15 and 1 of the logarithm; beyond, where
    it may as well be absent, upwards in steps of 0.3."""
    parameters = Parameters([Parameter("cdom", 0.1), Parameter("tilt", 0.0, None, Identity()),
                             Parameter("slope", 0.02, nuisance=True)])  # fmt: skip
    for sd, expected in (
        (0.149, []),
        (0.151, [(0, -0.0755), (0, 0.0755)]),
        (0.99, [(0, -0.495), (0, 0.495)]),
        (1.01, [(0, 0.3)]),
    ):
        found = profile_likelihood.profiles_needed(parameters, np.full(3, sd))
        assert [i for i, _ in found] == [i for i, _ in expected]
        assert [step for _, step in found] == pytest.approx([step for _, step in expected])


def test_profiles_reach_a_factor_of_a_hundred_and_twenty_or_a_loss_of_eight():
    """Sixteen steps of 0.3; a loss of 8 is beyond the 3.84 of 95 % with room to interpolate."""
    problem = test_sampling.fit(0.0).problem
    x = jnp.zeros(2)
    flat = test_sampling.Bent(problem.layout, 1e-3 * problem.inverse, problem.bend)
    found = profile_likelihood.profile_along(flat, x, jnp.asarray(0))
    np.testing.assert_allclose(found.x[:, 0], 0.3 * np.arange(17), atol=1e-9)
    assert np.exp(found.x[-1, 0]) == pytest.approx(121.5, rel=1e-3)
    # Along the first unknown alone the loss of a unit Gaussian is the square of the distance.
    for step, count in ((0.2795, 12), (0.2875, 11)):
        steep = profile_likelihood.profile_along(problem, x, jnp.asarray(0), jnp.asarray(step))
        loss = np.asarray(steep.loss)
        seen = np.isfinite(loss)
        np.testing.assert_allclose(loss[seen], (step * np.arange(17))[seen] ** 2, atol=1e-6)
        # The last point is the first whose loss reaches 8.
        assert seen.sum() == 1 + int(np.ceil(np.sqrt(8.0) / step))
        assert seen.sum() in (count, count + 1)
