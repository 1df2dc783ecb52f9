"""Posterior draws against targets whose answer is known."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm

from fitting import NUTS, Fit, Parameter, joint_region, sample
from fitting.parameters import Parameters
from fitting.posterior import Predictive, Quantity
from fitting.sampling import AbstractProblem

AXES = np.array([[1.0, 0.0], [0.9, 0.3]])
LAYOUT = Parameters([Parameter("a", 1.0), Parameter("b", 1.0)])


class Bent(AbstractProblem):
    """r = A^-1 (x0, x1 + bend (x0^2 - 1)): Gaussian in bent coordinates, of unit determinant."""

    layout: Parameters = eqx.field(static=True)
    inverse: jax.Array
    bend: jax.Array

    def residual(self, x):
        return self.inverse @ jnp.stack([x[0], x[1] + self.bend * (x[0] ** 2 - 1.0)])

    def quantities(self, x):
        return {"product": jnp.exp(x[0] + x[1])}


def fit(bend):
    problem = Bent(LAYOUT, jnp.asarray(np.linalg.inv(AXES)), jnp.asarray(bend))
    nothing = Predictive(np.zeros(1), np.zeros(1), np.ones(1), ("reading",), "1")
    product = Quantity(np.array(1.0), np.array(1.0), "1", "a times b")
    covariance = AXES @ AXES.T
    return Fit(LAYOUT, np.zeros(2), covariance, {"product": product}, np.array([500.0]),
               "converged", nothing, {}, problem=problem)  # fmt: skip


@pytest.fixture(scope="module")
def draws():
    sampler = NUTS(draws=3200, warm=100, chains=8)
    return {b: sample(fit(b), key=jax.random.key(3), sampler=sampler) for b in (0.0, 0.4)}


@pytest.mark.parametrize("bend", [0.0, 0.4])
def test_draws_are_those_of_the_target(bend, draws):
    """Bent back and whitened, the draws are standard normal: means, spreads and both tails."""
    x = draws[bend].samples
    straight = np.stack([x[:, 0], x[:, 1] + bend * (x[:, 0] ** 2 - 1.0)])
    white = np.linalg.inv(AXES) @ straight
    effective = draws[bend].metadata["sampling"]["effective_draws"]
    assert effective > 300
    for row in white:
        assert abs(row.mean()) < 4 / np.sqrt(effective)
        assert abs(row.std() - 1) < 4 / np.sqrt(2 * effective)
        # Thinned to nearly independent draws.
        assert kstest(row[:: int(np.ceil(len(row) / effective)) * 2], norm.cdf).pvalue > 1e-3
    assert draws[bend].converged
    assert draws[bend].metadata["sampling"]["largest_split_rhat"] < 1.05


def test_intervals_and_regions_are_those_of_the_draws(draws):
    straight, bent = draws[0.0], draws[0.4]
    low, high = straight.interval("a")
    assert np.log([low, high]) == pytest.approx([-1.96, 1.96], abs=0.25)
    # x1 has variance |A_1|^2 + 2 bend^2, and is skewed downwards.
    low, high = np.log(bent.interval("b"))
    assert abs(low) > 1.15 * high
    product = bent.quantities["product"]
    share = np.mean(product.samples < product.interval(0.68)[0])
    assert share == pytest.approx(0.16, abs=0.01)
    region = joint_region(bent, ("a", "b"), 0.9)
    inside = [region.holds({"a": np.exp(a), "b": np.exp(b)}) for a, b in bent.samples]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.005)
    with pytest.raises(ValueError, match="'prodct'"):
        joint_region(bent, ("prodct",))


def test_the_region_of_an_ellipsoid_is_chi_squared():
    region = joint_region(fit(0.0), ("a", "b"), 0.95)
    edge = AXES @ np.array([np.sqrt(chi2.ppf(0.95, 2)), 0.0])
    for scale, inside in ((0.999, True), (1.001, False)):
        assert region.holds(dict(zip("ab", np.exp(scale * edge), strict=True))) is inside
    with pytest.raises(ValueError, match="joint regions of quantities need draws"):
        joint_region(fit(0.0), ("product",))


def test_what_cannot_be_sampled_says_so():
    with pytest.raises(ValueError, match="keeps no posterior"):
        sample(dataclasses.replace(fit(0.0), problem=None))
    with pytest.raises(ValueError, match="at least 32"):
        sample(fit(0.0), sampler=NUTS(draws=8))
