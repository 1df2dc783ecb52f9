"""Skies and lamps by their integrals, and the clear sky by its source's numbers."""

import jax.numpy as jnp
import numpy as np
import pvlib
import pytest

import oceaninv as oi
from oceaninv.scene.light import clear_sky

ONE = jnp.ones(1)


def irradiance(sky, nodes=20):
    """Of a sky relative to the uniform one of the same `diffuse`: integral of 2 mu L(mu)."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    mu, weight = 0.5 * (x + 1.0), 0.5 * weight
    light = oi.Light(30.0, ONE, ONE, sky)
    return float(2.0 * np.sum(weight * mu * np.asarray(light.sky_radiance(jnp.asarray(mu)))[:, 0]))


def test_the_overcast_sky_gives_the_irradiance_of_the_uniform_one():
    assert irradiance(oi.CardioidalSky()) == pytest.approx(1.0, rel=1e-12)


def test_the_overcast_sky_is_three_times_as_bright_at_the_zenith_as_at_the_horizon():
    """Moon & Spencer 1942: 1 + 2 cos(zenith)."""
    light = oi.Light(30.0, ONE, ONE, oi.CardioidalSky())
    horizon, slanted, zenith = np.asarray(light.sky_radiance(jnp.asarray([0.0, 0.5, 1.0])))[:, 0]
    assert zenith / horizon == pytest.approx(3.0, rel=1e-12)
    assert slanted / horizon == pytest.approx(2.0, rel=1e-12)


def test_a_tabulated_sky_gives_the_irradiance_of_the_uniform_one():
    """Straight between its nodes in the cosine: a dense quadrature sees the kinks to 1e-4."""
    sky = oi.TabulatedSky([0.0, 25.0, 60.0, 80.0, 90.0], jnp.asarray([3.0, 5.0, 1.0, 2.0, 4.0]))
    mu = (np.arange(200_000) + 0.5) / 200_000
    total = 2.0 * np.mean(mu * np.asarray(sky.shape(jnp.asarray(mu))))
    assert total == pytest.approx(1.0, rel=1e-8)
    shape = np.asarray(sky.shape(jnp.asarray(np.cos(np.radians([0.0, 25.0, 60.0, 80.0])))))
    np.testing.assert_allclose(shape / shape[0], [1.0, 5 / 3, 1 / 3, 2 / 3], rtol=1e-12)


def test_a_clear_sky_is_that_of_spectrl2_at_sea_level():
    """Bird & Riordan 1986 over water of albedo 0.06 at 1013.25 hPa, the sun at its mean distance
    (4 April), through 1.5 cm of water, 0.3 atm cm of ozone and an aerosol of 0.1."""
    grid = np.array([360.0, 450.0, 555.0, 690.0, 940.0])
    direct, diffuse = clear_sky(grid, 40.0)
    table = pvlib.spectrum.spectrl2(
        40.0, 40.0, 0.0, 0.06, 1.01325e5, pvlib.atmosphere.get_relative_airmass(40.0), 1.5, 0.3,
        0.1, dayofyear=94,
    )  # fmt: skip
    for found, name in ((direct, "dni"), (np.pi * diffuse, "poa_sky_diffuse")):
        expected = np.interp(grid, table["wavelength"], np.ravel(table[name]))
        np.testing.assert_allclose(found, expected, rtol=1e-12, err_msg=name)


def test_a_spot_lamp_shines_within_its_half_angle():
    lamp = oi.SpotLamp([0.0, 0.0, 1.0], [0.0, 0.0, 2.0], 30.0, 5.0 * ONE)
    for angle, seen in ((29.9, 5.0), (30.1, 0.0)):
        tilt = np.radians(angle)
        along = lamp.along(jnp.asarray([np.sin(tilt), 0.0, np.cos(tilt)]))
        assert float(along[0]) == seen
