"""Posterior draws against targets whose answer is known."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm

from fitting import NUTS, Fit, Parameter, joint_region, sample
from fitting.core.diagnostics import Status
from fitting.core.least_squares import covariance, least_squares
from fitting.core.likelihood_regions import LikelihoodRegion
from fitting.core.parameters import Parameters
from fitting.core.problem import AbstractProblem
from fitting.core.profile_likelihood import profile_adjusted_covariance
from fitting.core.result import Predictive, Quantity
from tests.acceptance._photo_posterior import region_of

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
               Status.CONVERGED, nothing, {}, problem=problem)  # fmt: skip


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
    effective = draws[bend].sampling.effective_draws
    assert effective > 300
    for row in white:
        assert abs(row.mean()) < 4 / np.sqrt(effective)
        assert abs(row.std() - 1) < 4 / np.sqrt(2 * effective)
        # Thinned to nearly independent draws.
        assert kstest(row[:: int(np.ceil(len(row) / effective)) * 2], norm.cdf).pvalue > 1e-3
    assert draws[bend].converged
    assert draws[bend].sampling.largest_split_rhat < 1.05


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
    region = region_of(("a", "b"), bent.samples, 0.9)
    inside = [region.holds({"a": np.exp(a), "b": np.exp(b)}) for a, b in bent.samples]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.005)


def test_the_region_of_an_ellipsoid_is_chi_squared():
    region = joint_region(dataclasses.replace(fit(0.0), problem=None), ("a", "b"), 0.95)
    edge = AXES @ np.array([np.sqrt(chi2.ppf(0.95, 2)), 0.0])
    for scale, inside in ((0.999, True), (1.001, False)):
        assert region.holds(dict(zip("ab", np.exp(scale * edge), strict=True))) is inside
    assert np.log(region.interval("b")[1]) == pytest.approx(np.sqrt(chi2.ppf(0.95, 2) * 0.9))
    with pytest.raises(ValueError, match="keeps no posterior"):
        joint_region(dataclasses.replace(fit(0.0), problem=None), ("product",))


def least_square(bend, a=None, product=None):
    """Least |r|^2 of `Bent` with ln of either number held, on a grid."""
    x0 = np.linspace(-8, 8, 400001) if a is None else np.array([a])
    inverse = np.linalg.inv(AXES)
    if product is None:
        return float(np.min(x0**2))
    y = product - x0 + bend * (x0**2 - 1.0)
    return float(np.min(np.sum((inverse @ np.stack([x0, y])) ** 2, axis=0)))


@pytest.mark.parametrize("bend", [0.0, 0.4])
def test_likelihood_regions_are_those_of_the_best_of_all_else(bend):
    names = ("a", "product")
    # From a point beside the optimum, as a fit with draws has it.
    region = joint_region(dataclasses.replace(fit(bend), x=np.array([0.2, -0.1])), names, 0.95)
    assert isinstance(region, LikelihoodRegion)
    assert region.least == pytest.approx(0.0, abs=1e-6)
    assert region.radius2 == pytest.approx(chi2.ppf(0.95, 2))
    for held in ({"a": 1.3}, {"product": -2.0}, {"product": 2.5}, {"a": -1.0, "product": 0.7}):
        loss = region.loss({name: np.exp(value) for name, value in held.items()})
        assert loss == pytest.approx(least_square(bend, **held), rel=1e-3)
    # Just inside and just outside along a line through the optimum.
    ray = np.linspace(0, 12, 24001)
    losses = np.array([least_square(bend, t, t + bend) for t in ray])
    edge = ray[np.argmax(losses > region.radius2)]
    for scale, inside in ((0.99, True), (1.01, False)):
        t = scale * edge
        assert region.holds({"a": np.exp(t), "product": np.exp(t + bend)}) is inside
    low, high = np.log(region.interval("product"))
    assert least_square(bend, product=low) == pytest.approx(region.radius2, rel=0.01)
    assert least_square(bend, product=high) == pytest.approx(region.radius2, rel=0.01)
    assert np.log(region.interval("a")) == pytest.approx([-2.448, 2.448], abs=0.01)


def test_regions_of_what_is_not_there_say_so():
    region = joint_region(fit(0.0), ("a", "product"))
    assert isinstance(region, LikelihoodRegion)
    with pytest.raises(ValueError, match="'prodct'"):
        joint_region(fit(0.0), ("prodct",))
    with pytest.raises(ValueError, match="names that differ"):
        joint_region(fit(0.0), ("a", "a"))
    with pytest.raises(ValueError, match="between 0 and 1"):
        joint_region(fit(0.0), ("a",), 95.0)
    with pytest.raises(ValueError, match="a value of product"):
        region.holds({"a": 1.0})
    with pytest.raises(ValueError, match="none of this region"):
        region.loss({"b": 1.0})
    with pytest.raises(ValueError, match="must be positive"):
        region.loss({"a": -1.0})


class Shared(AbstractProblem):
    """Two amounts whose sum is measured, and their difference hardly: the first may be absent."""

    layout: Parameters = eqx.field(static=True)

    def residual(self, x):
        a, b = jnp.exp(x)
        return jnp.stack([(a + b - 1.0) / 0.05, (b - a - 1.05) / 0.5, x[0] / 2.3, x[1] / 2.3])

    def quantities(self, x):
        return {}


def test_what_may_be_absent_widens_what_shares_with_it():
    problem = Shared(Parameters([Parameter("a", 1.0, 2.3), Parameter("b", 1.0, 2.3)]))
    grid = np.stack(np.meshgrid(np.linspace(-8, 1, 901), np.linspace(-3, 1, 1601), indexing="ij"))
    flat = jnp.asarray(grid.reshape(2, -1).T)
    loss = np.sum(np.asarray(jax.vmap(problem.residual)(flat)) ** 2, axis=1)
    x = np.asarray(flat)[np.argmin(loss)]
    x = np.asarray(least_squares(lambda x, _: problem.residual(x), jnp.asarray(x)).x)
    cov = np.asarray(covariance(jax.jacfwd(problem.residual)(jnp.asarray(x))))
    sd = np.sqrt(np.diag(cov))
    inside = np.asarray(flat)[loss - loss.min() < chi2.ppf(0.95, 1)][:, 1]
    true = np.max(np.abs(inside - x[1])) / 1.96
    found = np.sqrt(np.diag(profile_adjusted_covariance(problem, problem.layout, x, cov)))
    assert sd[0] > 1
    assert true > 1.3 * sd[1]
    assert found[1] == pytest.approx(true, rel=0.09)


class Amount(AbstractProblem):
    """An amount and a factor on what is read of it: known the better the more there is."""

    layout: Parameters = eqx.field(static=True)

    def residual(self, x):
        return jnp.stack([(jnp.exp(x[0]) - 1.0) / 0.3, (x[0] + x[1]) / 0.1])

    def quantities(self, x):
        return {}


def test_what_is_seen_badly_reaches_as_far_as_the_longer_side_of_its_profile():
    unknowns = Parameters([Parameter("amount", 1.0, 9.0), Parameter("f", 1.0, 9.0, nuisance=True)])
    problem, x = Amount(unknowns), np.zeros(2)
    cov = np.asarray(covariance(jax.jacfwd(problem.residual)(jnp.asarray(x))))
    assert np.sqrt(cov[0, 0]) == pytest.approx(0.3)
    found = profile_adjusted_covariance(problem, unknowns, x, cov)
    # Its profile: e^x within 1.96 x 0.3 of 1.
    assert np.sqrt(found[0, 0]) == pytest.approx(-np.log(1 - 1.96 * 0.3) / 1.96, rel=0.02)
    assert found[1, 1] == pytest.approx(cov[1, 1])
    np.testing.assert_allclose(found[0, 1] / np.sqrt(found[0, 0] * found[1, 1]),
                               cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1]))  # fmt: skip


def test_what_cannot_be_sampled_says_so():
    with pytest.raises(ValueError, match="keeps no posterior"):
        sample(dataclasses.replace(fit(0.0), problem=None))
    with pytest.raises(ValueError, match="at least 32"):
        sample(fit(0.0), sampler=NUTS(draws=8))
