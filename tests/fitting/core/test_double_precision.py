"""Fits called where JAX is set to float32 equal those in float64, and return float64."""

import dataclasses
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
from fitting.core.double_precision import in_double_precision, promoted

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
    sizes = oi.particles.LogNormal(1.0, 0.3, minimum=0.3, maximum=3.0)
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


def test_the_setting_of_the_caller_stays_as_it_was(single):
    seen = in_double_precision(lambda x: (jnp.asarray(x).dtype, jax.config.jax_enable_x64))
    assert seen(np.ones(2)) == (jnp.float64, True)
    assert not jax.config.jax_enable_x64

    @in_double_precision
    def fails():
        raise ValueError("no such water")

    with pytest.raises(ValueError, match="no such water"):
        fails()
    assert jnp.ones(1).dtype == jnp.float32


@dataclasses.dataclass(frozen=True)
class _Held:
    name: str
    number: object


def test_numbers_in_float32_become_the_decimals_that_were_written():
    table = np.loadtxt(["0.1 1.33 4.7e-5 1e-45 3.4e38 0.123456"])
    with jax.enable_x64(False):
        kept = jnp.asarray(table)
        index = jnp.asarray(1.33 + 0.01j)
    given = {"z": _Held("a", kept), "a": (index, kept), "n": np.float32(0.7), "none": None}
    new = promoted(given)
    assert list(new) == list(given)
    np.testing.assert_array_equal(new["z"].number, table)
    np.testing.assert_array_equal(new["a"][1], table)
    assert new["a"][0] == 1.33 + 0.01j
    assert new["a"][0].dtype == np.complex128
    assert new["n"] == 0.7
    assert given["z"].number is kept


def test_every_number_of_float32_rounds_to_itself():
    bits = np.random.default_rng(0).integers(0, 2**32, 20000, dtype=np.uint32)
    numbers = bits.view(np.float32)
    special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan], np.float32)
    numbers = np.concatenate([numbers[~np.isnan(numbers)], special])
    assert promoted(numbers).dtype == np.float64
    assert promoted(numbers).astype(np.float32).tobytes() == numbers.tobytes()


def test_what_holds_no_float32_is_handed_on_itself():
    given = {"b": np.ones(2), "a": [jnp.arange(3), cast(), "text", None, jax.random.key(0)]}
    assert promoted(given) is given
