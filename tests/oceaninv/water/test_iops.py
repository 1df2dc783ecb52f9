"""Inherent optical properties: sums, moments, volume scattering function, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.water.iops import check_concrete

WAVELENGTH = [440.0, 550.0, 660.0]
A = np.array([[0.01, 0.06, 0.4], [0.2, 0.1, 0.05]])
B = np.array([[0.004, 0.002, 0.001], [0.5, 0.4, 0.3]])
PHASES = (oi.phase.Seawater(), oi.phase.HenyeyGreenstein(0.9))


def _water(dtype=jnp.float64):
    return oi.IOPs(WAVELENGTH, jnp.asarray(A, dtype), jnp.asarray(B, dtype), PHASES)


def test_sums():
    water = _water()
    np.testing.assert_allclose(water.a, A.sum(0), rtol=1e-15)
    np.testing.assert_allclose(water.b, B.sum(0), rtol=1e-15)
    np.testing.assert_allclose(water.c, A.sum(0) + B.sum(0), rtol=1e-15)
    np.testing.assert_allclose(water.albedo, B.sum(0) / (A.sum(0) + B.sum(0)), rtol=1e-15)
    g = 0.9
    hg = (1 - g) / (2 * g) * ((1 + g) / np.sqrt(1 + g * g) - 1)
    np.testing.assert_allclose(water.bb, 0.5 * B[0] + hg * B[1], rtol=1e-14)
    assert isinstance(water.wavelength, np.ndarray)


def test_moments_and_volume_scattering_agree():
    """The Legendre moments are those of the volume scattering function; its integral is b."""
    x, w = np.polynomial.legendre.leggauss(200)
    water = _water()
    beta = np.asarray(water.volume_scattering(jnp.asarray(x)))
    direct = sum(np.outer(phase(jnp.asarray(x)), b) for phase, b in zip(PHASES, B, strict=True))
    np.testing.assert_allclose(beta, direct, rtol=1e-14)
    legendre = np.polynomial.legendre.legvander(x, 4)
    integrals = 2 * np.pi * (w[:, None] * legendre).T @ beta
    np.testing.assert_allclose(water.scattering_moments(4), integrals, rtol=1e-12)


def test_adding_waters():
    total = _water() + _water()
    np.testing.assert_allclose(total.a, 2 * _water().a, rtol=1e-15)
    np.testing.assert_allclose(total.bb, 2 * _water().bb, rtol=1e-15)
    assert len(total.phases) == total.b_components.shape[0] == len(total.scatterers) == 4


def test_totals_and_vacuum():
    """(wl,) totals are accepted; a vacuum has albedo 0 with a finite derivative."""
    water = oi.IOPs([550.0], jnp.ones(1), jnp.ones(1), oi.phase.Isotropic())
    assert water.a_components.shape == (1, 1)

    def albedo(a):
        return oi.IOPs([550.0], a, jnp.zeros(1), oi.phase.Isotropic()).albedo

    value, slope = jax.jvp(albedo, (jnp.zeros(1),), (jnp.ones(1),))
    assert float(value[0]) == float(slope[0]) == 0.0


def test_dtype_and_transformations():
    single = _water(jnp.float32)
    for value in (
        single.a,
        single.bb,
        single.albedo,
        single.scattering_moments(3),
        single.volume_scattering(jnp.asarray([0.3], jnp.float32)),
    ):
        assert value.dtype == jnp.float32
    batch = jax.vmap(lambda a: oi.IOPs(WAVELENGTH, a, jnp.asarray(B), PHASES).c)
    np.testing.assert_allclose(batch(jnp.stack([A, 2 * A]))[1], 2 * A.sum(0) + B.sum(0))
    slope = jax.grad(lambda b: jnp.sum(oi.IOPs(WAVELENGTH, jnp.asarray(A), b, PHASES).bb))
    np.testing.assert_allclose(slope(jnp.asarray(B))[0], 0.5, rtol=1e-14)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"wavelength": [440.0, 660.0, 550.0]}, "strictly increasing"),
        ({"wavelength": [440.0, 440.0, 550.0]}, "strictly increasing"),
        ({"wavelength": [440.0, 550.0]}, r"a_components must have shape \(rows, 2\)"),
        ({"a_components": -A}, "a_components must be finite and at least 0; 6 of 6"),
        ({"b_components": np.full((2, 3), np.nan)}, "b_components must be finite"),
        ({"phases": PHASES[:1]}, "2 rows, 1 phases"),
        ({"absorbers": ("water",)}, "must name every row"),
    ],
)
def test_refusals(change, message):
    given = {
        "wavelength": WAVELENGTH,
        "a_components": jnp.asarray(A),
        "b_components": jnp.asarray(B),
        "phases": PHASES,
    } | change
    with pytest.raises(ValueError, match=message):
        oi.IOPs(**given)


def test_layers():
    water = _water()
    assert len(oi.Layers([3.0], (water, water)).wavelength) == 3
    other = oi.IOPs([550.0], jnp.ones(1), jnp.ones(1), oi.phase.Isotropic())
    with pytest.raises(ValueError, match="one entry fewer"):
        oi.Layers([3.0], (water,))
    with pytest.raises(ValueError, match="share the same wavelengths"):
        oi.Layers([3.0], (water, other))
    with pytest.raises(ValueError, match="increase with depth"):
        oi.Layers([3.0, 3.0], (water, water, water))
    with pytest.raises(ValueError, match="same wavelengths"):
        water + other


def test_check_concrete_lets_traced_values_pass():
    jax.jit(lambda x: check_concrete("x", x))(jnp.asarray(-1.0))
    with pytest.raises(ValueError, match="x must be finite and between 0 and 1; 1 of 2"):
        check_concrete("x", np.array([0.5, 1.5]), 0.0, 1.0)
