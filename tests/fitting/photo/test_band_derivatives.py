"""Derivatives of light fields band by band against those through the whole light field."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from fitting.photo._band_derivatives import downward, open_radiance, ring_transmission
from oceaninv.transport.closed_form._two_moment_field import DeltaScaledWater

WAVELENGTH = oi.spectrum.bands(4)
DIRECTION = jnp.asarray([[0.6, 0.0, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, -0.6]])
RADIUS = jnp.asarray([[0.01, 0.05], [0.02, 0.04], [0.001, 0.1]])
START = jnp.asarray([0.3, -0.2, 0.1, 35.0, 6.0, 2.0, 3.0, 4.0, 0.8])


def unpacked(x):
    """A scene, a number and depths that all depend on the unknowns."""
    grid = jnp.asarray(WAVELENGTH / 500.0)
    a = 0.1 * jnp.exp(x[0] * grid) + jnp.asarray([0.0, 0.02, 0.1, 0.4])
    b = jnp.stack([0.2 * grid ** x[1], 0.05 * (1.0 + x[2]) * jnp.ones_like(grid)])
    phases = (oi.phase.HenyeyGreenstein(0.9), oi.phase.HenyeyGreenstein(0.5))
    water = oi.IOPs(WAVELENGTH, a, b, phases)
    light = oi.Light(x[3], x[8] * jnp.asarray([1.0, 1.2, 0.9, 0.7]))
    return oi.Scene(water, light, oi.FlatSurface()), x[4], x[5:8]


def banded(transport, x):
    scene, size, depths = unpacked(x)
    seen = open_radiance(scene, depths, DIRECTION, transport)
    rings = ring_transmission(scene.water, depths, RADIUS, x[8], size)
    return jnp.stack([seen, *downward(scene, depths, transport), *rings])


def plain(transport, x):
    scene, size, depths = unpacked(x)
    zero = jnp.zeros_like(depths)
    eyes = jnp.stack([zero, zero, depths], axis=1)
    rays = oi.Rays(eyes, DIRECTION, jnp.full_like(depths, 1e6))
    seen = transport.radiance(scene, rays, None).value
    discs = oi.disc_transmission(scene.water, depths, size * RADIUS, x[8])
    rings = [discs[:, 0], discs[:, 1] - discs[:, 0]]
    light = transport.irradiance(scene, depths, None)
    mu0, beam = scene.beam()
    lost = DeltaScaledWater(scene.water).attenuation.c_star
    sun = beam[None, :] * jnp.exp(-lost[None, :] * depths[:, None] / mu0)
    return jnp.stack([seen, light.Ed.value, light.E0.value - sun, sun, *rings])


@pytest.mark.parametrize(
    "transport",
    [
        pytest.param(oi.TwoStream(), id="two-stream"),
        pytest.param(oi.PlaneParallel(4, 2), id="plane-parallel", marks=pytest.mark.slow),
    ],
)
def test_value_and_both_modes_are_those_of_the_light_field(transport):
    x = START.astype(jnp.float64)

    def with_slope(light):
        return jax.jit(
            lambda x: (light(transport, x), jax.jacfwd(lambda x: light(transport, x))(x))
        )

    value, slope = with_slope(banded)(x)
    wanted, true = with_slope(plain)(x)
    np.testing.assert_allclose(value, wanted, rtol=1e-13)
    slope, true = np.asarray(slope), np.asarray(true)
    scale = np.abs(true).max(axis=(0, 1, 2))
    np.testing.assert_allclose(slope / scale, true / scale, atol=1e-13)
    assert np.all(scale > 0)

    weight = jnp.cos(jnp.arange(value.size, dtype=x.dtype)).reshape(value.shape)
    pulled = jax.jit(jax.grad(lambda x: jnp.sum(weight * banded(transport, x))))(x)
    np.testing.assert_allclose(pulled, np.einsum("qnw,qnwx->x", weight, true), rtol=1e-11)


def test_derivative_in_what_is_not_banded_is_exact_too():
    def of(g, light):
        scene, depth, distance = unpacked(START)
        assert isinstance(scene.water, oi.IOPs)
        phases = (oi.phase.HenyeyGreenstein(g), oi.phase.HenyeyGreenstein(0.5))
        water = oi.IOPs(WAVELENGTH, scene.water.a, scene.water.b_components, phases)
        return light(oi.Scene(water, scene.light, scene.surface), depth, distance)

    def direct(scene, depth, distance):
        return oi.TwoStream().irradiance(scene, distance, None).Ed.value

    def ours(scene, depth, distance):
        return downward(scene, distance, oi.TwoStream())[0]

    slope = jax.jacfwd(lambda g: of(g, ours))(jnp.asarray(0.8))
    np.testing.assert_allclose(slope, jax.jacfwd(lambda g: of(g, direct))(jnp.asarray(0.8)))
    assert np.all(np.abs(slope) > 0)
