"""Walks frozen for one water and used for others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import oceaninv as oi
from tests.oceaninv.transport.monte_carlo.test_monte_carlo import A, down, nadir, sidak, within

FACTORS = [1.0, 1.2, 1.0, 1.0], [1.0, 0.8, 1.0, 1.0], [1.3, 1.0, 1.0, 1.0]


@pytest.mark.slow
def test_frozen_walks_are_smooth_in_the_water():
    """Reverse mode is forward mode, and both are the differences of one set of walks."""
    p = A([0.065, 0.178, 0.8, 0.3])
    transport = oi.MonteCarlo(32, 8).frozen(nadir(p))

    @jax.jit
    def value(p):
        key = jax.random.key(0)
        seen = oi.radiance(nadir(p), down(), transport, key=key).value[0]
        down_there = oi.irradiance(nadir(p), A([1.0]), transport, key=key)
        return jnp.stack([seen[0], down_there.Ed.value[0, 0], down_there.Eu.value[0, 0]])

    forward, reverse = jax.jacfwd(value)(p), jax.jacrev(value)(p)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-13)
    for h in (1e-5, 1e-3):
        differences = [(value(p + h * e) - value(p - h * e)) / (2 * h) for e in np.eye(4)]
        np.testing.assert_allclose(forward.T, differences, rtol=2e-3 if h > 1e-4 else 1e-6)


@pytest.mark.slow
def test_frozen_walks_serve_other_waters():
    """At b +-20 % and a +30 %: unbiased, worth most of their own walks; far away, a warning."""
    p, rays = A([0.065, 0.178, 0.8, 0.3]), down()
    frozen = oi.MonteCarlo(2**13, 32).frozen(nadir(p))
    for factor in FACTORS:
        scene = nadir(p * A(factor))
        found = oi.radiance(scene, rays, frozen, key=jax.random.key(4))
        within(found, oi.radiance(scene, rays, oi.PlaneParallel(32)).value)
        assert (frozen.reuse(scene, rays, jax.random.key(4)) > 0.5).all()
    with pytest.warns(UserWarning, match="freeze the transport again"):
        frozen.reuse(nadir(p * A([0.05, 0.05, 1.0, 1.0])), rays, jax.random.key(4))


@pytest.mark.slow
def test_irradiances_by_frozen_walks_are_unbiased_with_the_error_they_state():
    """Over 100 keys: means against exact fluxes, and the scatter between keys against what each
    states, Ed just below the surface, which is the light itself, apart."""
    p, depths, count = A([0.065, 0.178, 0.8, 0.3]), A([0.0, 4.0, 10.0]), 100
    frozen = oi.MonteCarlo(2**13, 32).frozen(nadir(p))

    def fluxes(estimates):
        parts = (estimates.Ed, estimates.Eu, estimates.E0)
        rows = [np.stack([getattr(f, k)[:, 0] for f in parts]) for k in ("value", "stderr")]
        return np.array(rows).reshape(2, -1)[:, 1:]

    off, ratio = [], []
    for factor in FACTORS:
        scene = nadir(p * A(factor))
        exact = fluxes(oi.irradiance(scene, depths, oi.PlaneParallel(32)))[0]
        keys = [jax.random.key(100 + k) for k in range(count)]
        value, stderr = np.stack(
            [fluxes(oi.irradiance(scene, depths, frozen, key=key)) for key in keys], axis=1
        )
        scatter = value.std(axis=0, ddof=1)
        off.append((value.mean(axis=0) - exact) / (scatter / np.sqrt(count)))
        ratio.append(scatter**2 / (stderr**2).mean(axis=0))
    assert np.abs(off).max() < sidak(np.size(off)), off
    least, most = stats.chi2.ppf([0.005 / np.size(ratio), 1 - 0.005 / np.size(ratio)], count - 1)
    assert np.min(ratio) > least / (count - 1), ratio
    assert np.max(ratio) < most / (count - 1), ratio
