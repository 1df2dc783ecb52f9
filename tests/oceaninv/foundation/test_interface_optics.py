"""Snell, Fresnel, the n^2 law and view rays against closed values and published tables."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.foundation.interface_optics import (
    diffuse_reflectance,
    fresnel_from_air,
    fresnel_from_water,
    refracted_cosine,
    scattering_half_sine,
)
from tests.paths import REFERENCE

REFERENCE_FILE = REFERENCE / "radiative_transfer.json"


def test_snell_and_reversibility():
    mu = jnp.linspace(0.0, 1.0, 41)
    below = refracted_cosine(mu, 1.34)
    np.testing.assert_allclose(np.sqrt(1 - below**2) * 1.34, np.sqrt(1 - mu**2), atol=1e-15)
    np.testing.assert_allclose(fresnel_from_air(mu, 1.34), fresnel_from_water(below, 1.34), 1e-12)


def test_special_angles():
    normal = (0.34 / 2.34) ** 2
    one = jnp.asarray(1.0)
    np.testing.assert_allclose(fresnel_from_air(one, 1.34), normal, rtol=1e-14)
    np.testing.assert_allclose(fresnel_from_water(one, 1.34), normal, rtol=1e-14)
    critical = np.sqrt(1 - 1 / 1.34**2)
    beyond = jnp.asarray([0.0, 0.3, critical - 1e-9])
    np.testing.assert_array_equal(fresnel_from_water(beyond, 1.34), 1.0)
    # Brewster's angle: half of the light across the plane of incidence remains.
    brewster = 1 / np.sqrt(1 + 1.34**2)
    expected = 0.5 * ((1.34**2 - 1) / (1.34**2 + 1)) ** 2
    np.testing.assert_allclose(fresnel_from_air(jnp.asarray(brewster), 1.34), expected, rtol=1e-13)
    np.testing.assert_allclose(fresnel_from_air(jnp.asarray([0.2, 0.7]), 1.0), 0.0, atol=1e-30)


@pytest.mark.parametrize("index", [1.33, 1.34])
def test_diffuse_reflectance(index):
    published = json.loads(REFERENCE_FILE.read_text())["fresnel"][str(index)]
    from_air, from_water = diffuse_reflectance(jnp.asarray(index))
    np.testing.assert_allclose(from_air, published["diffuse_R_from_air"], rtol=1e-8)
    # Published by quadrature across the critical angle, to five digits.
    np.testing.assert_allclose(from_water, published["diffuse_R_from_water"], rtol=2e-5)
    # Split there and taken in the cosine of the air inside the cone, it is exact.
    x, w = np.polynomial.legendre.leggauss(200)
    air = ((x + 1) / 2) ** 2
    inside = np.sqrt(1 - (1 - air**2) / index**2)
    # 2 mu dmu = 2 mu_air dmu_air / n^2; beyond the cone all of 1 - 1/n^2 is reflected.
    weight = w / 2 * 2 * np.sqrt(air) * 2 * air / index**2
    within = weight @ np.asarray(fresnel_from_water(jnp.asarray(inside), index))
    np.testing.assert_allclose(from_water, within + 1 - 1 / index**2, rtol=1e-9)


def test_gradients_stay_finite():
    """At the critical angle, at grazing and at normal incidence; against differences elsewhere."""
    critical = np.sqrt(1 - 1 / 1.34**2)
    mu = jnp.asarray([0.0, critical, critical - 1e-12, 0.8, 1.0])
    for mode in (jax.jacfwd, jax.jacrev):
        slope = jax.vmap(mode(lambda x: fresnel_from_water(x, 1.34)))(mu)
        assert bool(jnp.all(jnp.isfinite(slope)))
    h = 1e-6
    rise = (fresnel_from_water(mu[3] + h, 1.34) - fresnel_from_water(mu[3] - h, 1.34)) / (2 * h)
    np.testing.assert_allclose(slope[3], rise, rtol=1e-6)


def test_scattering_angle():
    """Looking away from the sun with the sun behind is forward scattering of nothing: backward."""
    cos_sun = jnp.asarray(0.8)
    at_sun = [0.6, 0.0, -0.8]
    views = jnp.asarray([at_sun, [-0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    cosine = 1 - 2 * np.asarray(scattering_half_sine(views, cos_sun)) ** 2
    np.testing.assert_allclose(cosine, [1.0, -1.0, 0.0, 0.8], atol=1e-15)
    # A billionth of a radian from the sun: a cosine could not tell.
    near = jnp.asarray([[0.6, 1e-9, -0.8]])
    np.testing.assert_allclose(scattering_half_sine(near, cos_sun), 0.5e-9, rtol=1e-6)
    slope = jax.grad(lambda m: scattering_half_sine(views, m).sum())(jnp.asarray(1.0))
    assert bool(jnp.isfinite(slope))


def test_rays():
    lines = oi.Rays([0.0, 0.0, 2.0], np.eye(3))
    assert lines.origin.shape == (3, 3)
    assert lines.length is None
    assert oi.Rays([0.0, 0.0, 2.0], np.eye(3), 2.0).length.shape == (3,)
    single = oi.Rays([0.0, 0.0, 2.0], jnp.eye(3, dtype=jnp.float32), 1.0)
    assert single.origin.dtype == single.length.dtype == jnp.float32
    with pytest.raises(ValueError, match=r"direction must have shape \(ray, 3\)"):
        oi.Rays([0.0, 0.0, 2.0], np.ones((2, 2)))
    with pytest.raises(ValueError, match="origin must have shape"):
        oi.Rays([0.0, 0.0], np.eye(3))
