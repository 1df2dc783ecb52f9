"""Scenes: the beam below the surface, and every refusal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi


def _water(n=2):
    return oi.IOPs(np.arange(n) + 500.0, jnp.full(n, 0.1), jnp.full(n, 0.2), oi.phase.Isotropic())


def test_beam_without_surface():
    cosine, beam = oi.Scene(_water(), oi.Light(60.0, jnp.asarray([1.0, 2.0]))).beam()
    np.testing.assert_allclose(cosine, 0.5, rtol=1e-15)
    np.testing.assert_allclose(beam, [1.0, 2.0])


@pytest.mark.parametrize("zenith", [0.0, 30.0, 60.0, 85.0])
def test_beam_conserves_energy(zenith):
    """What goes through the surface and what is reflected makes what came, on the horizontal."""
    scene = oi.Scene(_water(), oi.Light(zenith, jnp.ones(2)), oi.FlatSurface(1.34))
    cosine, beam = scene.beam()
    air = np.cos(np.radians(zenith))
    np.testing.assert_allclose(
        np.sqrt(1 - cosine**2) * 1.34, np.sin(np.radians(zenith)), 1e-13, 1e-9
    )
    reflected = oi.optics.fresnel_from_air(jnp.asarray(air), 1.34)
    np.testing.assert_allclose(beam * cosine + reflected * air, air, rtol=1e-14)


def test_known_beam():
    """Sun at 60 degrees: R = 0.061005 and Ed just below the surface 0.469498."""
    scene = oi.Scene(_water(), oi.Light(60.0, jnp.ones(2)), oi.FlatSurface(1.34))
    cosine, beam = scene.beam()
    np.testing.assert_allclose(cosine, 0.7630939123083115, rtol=1e-14)
    np.testing.assert_allclose(beam * cosine, 0.46949757263448777, rtol=1e-13)


def test_gradient_of_the_beam():
    """In the sun's angle and the index; finite for the sun at the zenith."""

    def horizontal(zenith, index):
        scene = oi.Scene(_water(), oi.Light(zenith, jnp.ones(2)), oi.FlatSurface(index))
        cosine, beam = scene.beam()
        return (cosine * beam)[0]

    at = (jnp.asarray(40.0), jnp.asarray(1.34))
    slopes = jax.grad(horizontal, argnums=(0, 1))(*at)
    for k, (slope, h) in enumerate(zip(slopes, (1e-4, 1e-6), strict=True)):
        high, low = ([x + s * h * (i == k) for i, x in enumerate(at)] for s in (1, -1))
        rise = (horizontal(*high) - horizontal(*low)) / (2 * h)
        np.testing.assert_allclose(slope, rise, rtol=1e-7)
    flat = jax.grad(horizontal)(jnp.asarray(0.0), jnp.asarray(1.34))
    np.testing.assert_allclose(flat, 0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: oi.Light(90.0, jnp.ones(2)), "zenith must be finite and between 0 and 89.9"),
        (lambda: oi.Light(-1.0, jnp.ones(2)), "zenith must be finite"),
        (lambda: oi.Light(0.0, -jnp.ones(2)), "direct must be finite and at least 0; 2 of 2"),
        (lambda: oi.Light(0.0, jnp.ones(2), -jnp.ones(2)), "diffuse must be finite"),
        (lambda: oi.Light(0.0, jnp.ones(2), jnp.ones(3)), "diffuse must have the shape of direct"),
        (lambda: oi.FlatSurface(0.9), "index must be finite and between 1 and 2"),
        (lambda: oi.Floor(0.0, jnp.ones(2)), "depth must be finite"),
        (lambda: oi.Floor(3.0, 2 * jnp.ones(2)), "reflectance must be finite and between 0 and 1"),
        (lambda: oi.Scene(_water(), oi.Light(0.0, jnp.ones(3))), r"light.direct .* \(2,\)"),
        (
            lambda: oi.Scene(
                _water(), oi.Light(0.0, jnp.ones(2)), None, oi.Floor(3.0, jnp.ones(3))
            ),
            "floor.reflectance must have one value per wavelength",
        ),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_depths():
    scene = oi.Scene(_water(), oi.Light(0.0, jnp.ones(2)), None, oi.Floor(3.0, jnp.ones(2)))
    scene.check_depths(np.array([0.0, 3.0]))
    with pytest.raises(ValueError, match="depths reach 4 m, below the floor at 3 m"):
        scene.check_depths(np.array([1.0, 4.0]))
    with pytest.raises(ValueError, match="depths must be finite and at least 0"):
        scene.check_depths(np.array([-1.0]))


def test_single_precision():
    ones = jnp.ones(2, jnp.float32)
    water = oi.IOPs([500.0, 501.0], ones, ones, oi.phase.Isotropic())
    scene = oi.Scene(water, oi.Light(30.0, ones), oi.FlatSurface(1.34), oi.Floor(3.0, ones))
    assert all(x.dtype == jnp.float32 for x in scene.beam())
