"""The Kd model: Gershun's law, slopes, the printed closure against direct integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.transport.closed_form.kd import monzon2024
from oceaninv.water.attenuation import kd_lee2005

ONE = jnp.ones(1)
WATER = oi.IOPs([550.0], 0.08 * ONE, 0.3 * ONE, oi.phase.HenyeyGreenstein(0.924))
SCENE = oi.Scene(WATER, oi.Light(30.0, ONE), oi.FlatSurface())


def test_irradiance_follows_the_given_kd():
    kd = jnp.asarray([0.13])
    field = oi.irradiance(SCENE, [0.0, 5.0, 20.0], oi.KdTransport(kd))
    down, up, scalar = (np.asarray(x.value)[:, 0] for x in (field.Ed, field.Eu, field.E0))
    np.testing.assert_allclose(down[1:] / down[0], np.exp(-0.13 * np.array([5.0, 20.0])), 1e-13)
    # Gershun: the net flux loses what is absorbed.
    np.testing.assert_allclose(0.13 * (down - up), 0.08 * scalar, rtol=1e-13)
    assert down[0] > np.cos(np.radians(30)) * (1 - 0.022)  # reflected back from below


def test_default_kd_is_lee():
    given = kd_lee2005(WATER.a, WATER.bb, 30.0)
    both = [oi.irradiance(SCENE, [7.0], oi.KdTransport(k)).Ed.value for k in (None, given)]
    np.testing.assert_array_equal(*both)


def test_radiance_and_gradient():
    """Positive, finite, the finite-range identity, slopes in a, b and Kd against differences."""
    lines = oi.Rays([0.0, 0.0, 4.0], np.array([[0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [1.0, 0.0, 0.0]]))

    @jax.jit
    def seen(x):
        water = oi.IOPs([550.0], x[0][None], x[1][None], oi.phase.HenyeyGreenstein(0.924))
        scene = oi.Scene(water, oi.Light(30.0, ONE), oi.FlatSurface())
        return oi.radiance(scene, lines, oi.KdTransport(x[2][None])).value[:, 0]

    at = jnp.asarray([0.08, 0.3, 0.13])
    assert float(seen(at).min()) > 0
    slope = jax.jacfwd(seen)(at)
    np.testing.assert_allclose(jax.jacrev(seen)(at), slope, rtol=1e-11)
    for k in range(3):
        h = 1e-6
        rise = (seen(at.at[k].add(h)) - seen(at.at[k].add(-h))) / (2 * h)
        np.testing.assert_allclose(slope[:, k], rise, rtol=1e-6, atol=1e-9)


def test_resonance():
    """Kd = c* /mu0, where diffuse light and beam decay alike, is nothing special."""
    kd = (0.08 + 0.3 * (1 - 0.924**2)) / float(SCENE.beam()[0])
    lines = oi.Rays([0.0, 0.0, 4.0], [0.0, 0.6, 0.8])
    at, below, above = (
        oi.radiance(SCENE, lines, oi.KdTransport(jnp.asarray([kd * f]))).value
        for f in (1.0, 1 - 1e-6, 1 + 1e-6)
    )
    np.testing.assert_allclose(at, 0.5 * (below + above), rtol=1e-9)


def _directly(b, c, kd, surface, depth, down, length, reflectance=None, floor=None):
    """The printed closure's integral by quadrature, sign of the depth's exponent as printed."""
    x, w = np.polynomial.legendre.leggauss(120)
    s = length / 2 * (x + 1)
    source = np.exp(-kd * depth)
    if reflectance is not None:
        source += reflectance / np.pi * np.exp(-kd * (2 * floor - depth))
    inner = np.exp((kd * down - c) * s)
    return b * surface / (4 * np.pi) * source * length / 2 * np.sum(w * inner)


@pytest.mark.parametrize("floor", [None, 12.0])
def test_printed_closure(floor):
    """Closed form = its own integrand, on both sides of and at c = K d, and at no length."""
    b, c, kd, surface = 0.3, 0.4, 0.5, 0.9
    rays = np.array([(2.0, 1.0, 3.0), (5.0, -0.7, 4.0), (3.0, 0.8, 6.0), (1.0, 0.0, 0.0)])
    more = () if floor is None else (jnp.asarray([0.3]), floor)
    value = monzon2024(
        *(jnp.asarray([x]) for x in (b, c, kd, surface)), *(jnp.asarray(x) for x in rays.T), *more
    )[:, 0]
    extra = {} if floor is None else {"reflectance": 0.3, "floor": floor}
    expected = [_directly(b, c, kd, surface, *ray, **extra) for ray in rays]
    np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (oi.Scene(WATER, oi.Light(0.0, ONE), None, oi.Floor(5.0, ONE)), "neither floor nor sky"),
        (oi.Scene(WATER, oi.Light(0.0, ONE, ONE)), "neither floor nor sky"),
        (oi.Scene(oi.Layers([3.0], (WATER, WATER)), oi.Light(0.0, ONE)), "one homogeneous water"),
    ],
)
def test_refusals(scene, message):
    with pytest.raises(ValueError, match=message):
        oi.irradiance(scene, [1.0], oi.KdTransport())
    with pytest.raises(ValueError, match=message):
        oi.radiance(scene, oi.Rays([0.0, 0.0, 1.0], [0.0, 0.0, 1.0]), oi.KdTransport())


def test_negative_kd():
    with pytest.raises(ValueError, match="kd must be finite and at least 0"):
        oi.KdTransport([-0.1])
