"""Fits called where JAX is set to float32 equal those in float64, and return float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from fitting import (
    Background,
    Bulk,
    Chart,
    Photo,
    Populations,
    Profile,
    fit_apparent,
    fit_bulk,
    fit_photo,
    fit_profile,
    fit_profiles,
    joint_region,
)

BANDS = np.array([443.0, 490.0, 555.0])
KD = np.array([0.05, 0.045, 0.08])
TRANSPORT = oi.TwoStream()


@pytest.fixture
def single():
    """JAX as it is unless it is told otherwise."""
    with jax.enable_x64(False):
        assert jnp.ones(1).dtype == jnp.float32
        yield


def cast():
    depth = np.linspace(0.5, 30.0, 40)
    noise = 0.01 * np.random.default_rng(0).standard_normal((40, 3))
    return Profile(depth, BANDS, np.exp(-np.outer(depth, KD)) * (1 + noise), solar_zenith=30.0)


def camera_photo():
    values = np.linspace(0.05, 0.4, 21).reshape(7, 3)
    response = oi.spectrum.camera_response("Nikon D850")
    grey = np.array([0.9, 0.5, 0.1])
    charts = [Chart(values[k : k + 3], grey, 1.0 + k) for k in (0, 3)]
    return Photo(charts, [Background(values[6:])], depth=5.0, response=response)


def bulk():
    wavelength = np.array([450.0, 550.0, 650.0])
    return Bulk(wavelength, b=np.array([0.31, 0.25, 0.2]), sigma=0.01)


def spheres():
    """Float32 leaves where JAX is set to float32."""
    sizes = oi.particles.PowerLaw(3.7, 0.3, 3.0)
    population = oi.particles.Population(np.array(1.4 + 0j), sizes, 1e-6, radii=12)
    return Populations({"z": population}, np.array(1.34 + 0j), sizes=False)


FITS = {
    "Kd": lambda: fit_profile(cast()),
    "constituents": lambda: fit_profile(cast(), transport=TRANSPORT),
    "many": lambda: fit_profiles([cast()], transport=TRANSPORT).water(0),
    "Kd and R": lambda: fit_apparent(BANDS, KD[None], transport=TRANSPORT, Kd_sd=0.05)[0],
    "photograph": lambda: fit_photo(camera_photo()),
    "spheres": lambda: fit_bulk(bulk(), spheres()),
}
LONG = ("many", "Kd and R", "photograph", "spheres")


@functools.cache
def in_float64(kind):
    return FITS[kind]()


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] if kind in LONG else []) for kind in FITS]
)
def test_a_fit_called_in_float32_is_the_one_in_float64(kind, single):
    fit = FITS[kind]()
    with jax.enable_x64(True):
        true = in_float64(kind)
    assert fit.ended == true.ended
    np.testing.assert_array_equal(fit.x, true.x)
    np.testing.assert_array_equal(fit.covariance, true.covariance)
    assert fit.value == true.value
    for name, quantity in fit.quantities.items():
        np.testing.assert_array_equal(quantity.value, true.quantities[name].value)
        assert isinstance(quantity.value, (np.ndarray, np.float64))
        assert quantity.value.dtype == quantity.sd.dtype == np.float64
    seen = fit.posterior_predictive
    for array in (fit.x, fit.covariance, fit.wavelength, seen.observed, seen.predicted, seen.sd):
        assert isinstance(array, np.ndarray)
        assert array.dtype == np.float64


@pytest.mark.slow
def test_a_region_is_found_in_float64(single):
    region = joint_region(FITS["constituents"](), ("cdom",))
    assert region.x.dtype == region.centre.dtype == np.float64
    low, high = region.interval("cdom")
    with jax.enable_x64(True):
        assert (low, high) == joint_region(in_float64("constituents"), ("cdom",)).interval("cdom")
