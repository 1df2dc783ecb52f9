"""Irradiance of facets by where they look: limits, the flux vector, derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.transport.objects import _surface_irradiance
from oceaninv.transport.objects._surface_irradiance import facet_irradiance

NORMALS = np.random.default_rng(3).normal(size=(14, 3))
NORMALS[:6] = [[0, 0, -1], [0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0.0, -1, 0]]
NORMALS = NORMALS / np.linalg.norm(NORMALS, axis=1, keepdims=True)
DEPTHS = np.full(14, 5.0)


def water(a=0.1, b=0.4, dtype=float):
    ones = jnp.ones(2, dtype)
    phase = oi.phase.HenyeyGreenstein(jnp.asarray(0.9, dtype))
    return oi.IOPs([450.0, 550.0], a * ones, b * jnp.asarray([1.0, 0.5], dtype), phase)


def scene(zenith=40.0, a=0.1, b=0.4, dtype=float, **more):
    light = oi.Light(jnp.asarray(zenith, dtype), jnp.ones(2, dtype))
    return oi.Scene(water(a, b, dtype), light, oi.FlatSurface(jnp.asarray(1.34, dtype)), **more)


@eqx.filter_jit
def found(scene, transport, depths, normals):
    return facet_irradiance(scene, transport, jnp.asarray(depths), jnp.asarray(normals))


@eqx.filter_jit
def tabulated(scene, transport, depths, normals, free):
    depths, normals = jnp.asarray(depths), jnp.asarray(normals)
    lit = _surface_irradiance.light(transport, scene, jnp.min(depths), jnp.max(depths), None)
    at = jnp.zeros_like(normals).at[:, 2].set(depths)
    return _surface_irradiance.irradiance(scene, lit, at, normals, jnp.asarray(free))


def test_uniform_light():
    """A white sky over a white floor in clear water: pi L on every face, whose directions alone err
    (by 0.83 % here)."""
    ones = jnp.ones(2)
    uniform = oi.Scene(water(1e-9, 1e-9), oi.Light(40.0, 0 * ones, ones), None, oi.Floor(9.0, ones))
    value = np.asarray(found(uniform, oi.TwoStream(), DEPTHS, NORMALS))
    np.testing.assert_allclose(value, np.pi, rtol=0.0085)
    np.testing.assert_allclose(value[:2], np.pi, rtol=1e-6)


@pytest.mark.parametrize("zenith", [0.0, 60.0])
def test_level_facets_and_the_flux_vector(zenith):
    """Level facets get Ed and Eu; E(n) - E(-n) is linear in n."""
    here = scene(zenith)
    value = np.asarray(found(here, oi.TwoStream(), DEPTHS, NORMALS))
    light = oi.irradiance(here, [5.0])
    np.testing.assert_allclose(value[:2], [light.Ed.value[0], light.Eu.value[0]], rtol=1e-12)
    opposite = np.asarray(found(here, oi.TwoStream(), DEPTHS, -NORMALS))
    flux = np.linalg.lstsq(NORMALS, value - opposite, rcond=None)[0]
    np.testing.assert_allclose(NORMALS @ flux, value - opposite, atol=1e-12)
    np.testing.assert_allclose(flux[2], light.Eu.value[0] - light.Ed.value[0], rtol=1e-10)
    np.testing.assert_allclose(flux[1], 0.0, atol=1e-14)
    np.testing.assert_allclose(value[4], value[5], rtol=1e-12)  # the sun's plane is a mirror
    assert np.all(value > 0)
    if zenith:
        assert np.all(value[2] > 2 * value[3])
    else:  # around a sun in the zenith nothing has a side, but for the directions' places
        np.testing.assert_allclose(value[2:4], value[3:5], rtol=0.02)


def test_sunlight_alone():
    """Without scattering, the cosine of the sun, and none on faces that turn away."""
    here = scene(30.0, b=0.0)
    value = found(here, oi.TwoStream(), DEPTHS, NORMALS)
    mu0, beam = here.beam()
    to_sun = np.array([np.sqrt(1 - float(mu0) ** 2), 0, -float(mu0)])
    sun = float(beam[0] * jnp.exp(-0.1 * 5.0 / mu0)) * np.maximum(NORMALS @ to_sun, 0)
    np.testing.assert_allclose(value[:, 0], sun, atol=1e-5 * float(beam[0]))


def test_table_for_pictures():
    """Depths and normals between those of the table, and facets that objects shade."""
    depths = np.linspace(4.0, 9.0, 14)
    here, free = scene(), np.ones(14, bool)
    direct = np.asarray(found(here, oi.TwoStream(), depths, NORMALS))
    table = np.asarray(tabulated(here, oi.TwoStream(), depths, NORMALS, free))
    np.testing.assert_allclose(table, direct, rtol=0.02)
    shaded = np.asarray(tabulated(here, oi.TwoStream(), depths, NORMALS, ~free))
    assert np.all(shaded > 0)
    assert np.all(shaded <= table * (1 + 1e-3))
    assert np.all(shaded[0] < 0.6 * table[0])
    np.testing.assert_allclose(shaded[3], table[3], rtol=0.02)


@pytest.mark.slow
def test_derivatives():
    """In absorption, scattering, depth and sun, forward and reverse, against differences."""

    @jax.jit
    def value(x):
        a, b, depth, zenith = x
        here = scene(zenith, a, b)
        e = facet_irradiance(here, oi.TwoStream(), depth * jnp.ones(2), jnp.asarray(NORMALS[6:8]))
        return jnp.sum(jnp.log(e))

    at = jnp.asarray([0.1, 0.4, 5.0, 40.0])
    forward, reverse = jax.jacfwd(value)(at), jax.grad(value)(at)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8)
    for k, step in enumerate(1e-5 * np.eye(4) * np.asarray(at)):
        rise = (value(at + step) - value(at - step)) / (2 * step[k])
        np.testing.assert_allclose(forward[k], rise, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    ("a", "b", "depth"), [(0.1, 0.4, 5.0), (0.0, 1e-9, 1e-3), (2.0, 8.0, 30.0)]
)
def test_single_precision(a, b, depth):
    double = found(scene(40.0, a, b), oi.TwoStream(), np.full(14, depth), NORMALS)
    normals = NORMALS.astype(np.float32)
    single = found(
        scene(40.0, a, b, jnp.float32), oi.TwoStream(), np.full(14, depth, np.float32), normals
    )
    assert single.dtype == jnp.float32
    assert np.all(np.isfinite(np.asarray(single)))
    least = max(3e-6 * float(jnp.max(double)), 1e-37)  # no smaller number is normal
    np.testing.assert_allclose(single, double, rtol=3e-3, atol=least)
