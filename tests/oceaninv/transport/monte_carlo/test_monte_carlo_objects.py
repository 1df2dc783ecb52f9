"""MonteCarlo among objects and lamps: what is known exactly of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import oceaninv as oi
from oceaninv.foundation.interface_optics import fresnel_from_water
from oceaninv.water.phase import HenyeyGreenstein

WAVELENGTH = np.array([450.0, 550.0])
A = jnp.asarray
ONE = jnp.ones(2)
KEY = jax.random.key(0)


def water(b):
    return oi.IOPs(WAVELENGTH, A([0.05, 0.1]), A(b), HenyeyGreenstein(0.8))


@pytest.mark.slow
def test_a_wide_box_is_a_floor():
    """Scattering water under a surface and a sky: the exact radiance of the same floor."""
    light = oi.Light(30.0, ONE, 0.05 * ONE)
    rays = oi.Rays(A([0.0, 0.0, 1.0]), A([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]))
    box = oi.Box([-1e3, -1e3, 5.0], [1e3, 1e3, 8.0], 0.4 * ONE)
    scattering, surface = water([0.1, 0.15]), oi.FlatSurface(1.34)
    boxed = oi.Scene(scattering, light, surface, objects=(box,))
    found = oi.radiance(boxed, rays, oi.MonteCarlo(2**12, 16), key=KEY)
    floored = oi.Scene(scattering, light, surface, oi.Floor(5.0, 0.4 * ONE))
    exact = oi.radiance(floored, rays, oi.PlaneParallel(16)).value
    z = np.asarray((found.value - exact) / found.stderr)
    assert np.abs(z).max() < stats.norm.isf(0.001), z
    assert (found.stderr < 0.05 * exact).all()


SPHERE = oi.Sphere([0.0, 0.0, 3.0], 1.0, A([0.2, 0.8]))


def test_sphere_shadow_and_lamp_in_clear_water():
    """Without scattering: a lit sphere, its shadow, and a lamp with its image in the surface."""
    rays = oi.Rays(
        A([[0.0, 0.0, 0.5], [0.5, 0.0, 4.5], [2.0, 0.0, 1.0]]),
        A([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]),
    )
    a, mc = np.array([0.05, 0.1]), oi.MonteCarlo(32, 1)
    floor = oi.Floor(5.0, 0.4 * ONE)
    surface = oi.FlatSurface(1.34)
    sunny = oi.Scene(water([0.0, 0.0]), oi.Light(0.0, ONE), surface, floor, (SPHERE,))
    through = 1 - (0.34 / 2.34) ** 2
    found = oi.radiance(sunny, rays, mc, key=KEY).value
    top = through * np.array([0.2, 0.8]) / np.pi * np.exp(-a * (1.5 + 2.0))
    bottom = through * 0.4 / np.pi * np.exp(-a * (4.0 + 5.0))
    np.testing.assert_allclose(found, [top, 0 * bottom, bottom], rtol=1e-9, atol=1e-12)

    lamp = oi.PointLamp([1.0, 0.0, 3.0], ONE)
    dark = oi.Light(0.0, 0 * ONE)
    lit = oi.Scene(water([0.0, 0.0]), dark, surface, floor, lamps=(lamp,))
    found = oi.radiance(lit, oi.Rays(A([0.0, 0.0, 1.0]), rays.direction[:1]), mc, key=KEY).value
    near, far = np.sqrt(1 + 2**2), np.sqrt(1 + 8**2)
    image = float(fresnel_from_water(A(8 / far), A(1.34)))
    arriving = 2 / near**3 * np.exp(-a * near) + image * 8 / far**3 * np.exp(-a * far)
    np.testing.assert_allclose(found[0], 0.4 / np.pi * arriving * np.exp(-4 * a), rtol=1e-9)


def test_height_fields_are_floors_and_slopes():
    """Flat, a height field is a floor; on a slope the sun falls in at an angle; and a hill's
    shadow is dark."""
    x = np.tile(np.arange(-8, 9), (17, 1))
    ramp, flat = 5.0 + 0.5 * x, 5.0 + 0.0 * x
    rays = oi.Rays(A([[0.25, 0.5, 0.5]]), A([[0.0, 0.0, 1.0]]))
    mc = oi.MonteCarlo(32, 1)

    def seen(depth, light):
        field = oi.HeightField(depth, -8.0, -8.0, 1.0, 0.4 * ONE)
        scene = oi.Scene(water([0.0, 0.0]), light, objects=(field,))
        return np.asarray(oi.radiance(scene, rays, mc, key=KEY).value[0])

    sun = oi.Light(0.0, ONE)
    plain = oi.Scene(water([0.0, 0.0]), sun, floor=oi.Floor(5.0, 0.4 * ONE))
    np.testing.assert_allclose(
        seen(flat, sun), oi.radiance(plain, rays, mc, key=KEY).value[0], rtol=1e-9
    )
    a, depth = np.array([0.05, 0.1]), 5.0 + 0.5 * 0.25
    expected = 0.4 / np.pi / np.sqrt(1.25) * np.exp(-a * (2 * depth - 0.5))
    np.testing.assert_allclose(seen(ramp, sun), expected, rtol=1e-9)
    # Light at 60 degrees travels towards -x, along the slope's rise of depth: from behind a wall.
    wall = np.where(x >= 3, 1.0, 5.0)
    assert (seen(wall, oi.Light(60.0, ONE)) == 0).all()
    assert (seen(wall[:, ::-1], oi.Light(60.0, ONE)) > 0).all()


@pytest.mark.slow
def test_a_flat_height_field_in_scattering_water():
    """Against the exact radiance over a floor, under a surface and a sky."""
    light = oi.Light(30.0, ONE, 0.05 * ONE)
    rays = oi.Rays(A([0.0, 0.0, 1.0]), A([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]))
    field = oi.HeightField(np.full((3, 3), 5.0), -1e3, -1e3, 1e3, 0.4 * ONE)
    scattering, surface = water([0.1, 0.15]), oi.FlatSurface(1.34)
    scene = oi.Scene(scattering, light, surface, objects=(field,))
    found = oi.radiance(scene, rays, oi.MonteCarlo(2**11, 16), key=KEY)
    floored = oi.Scene(scattering, light, surface, oi.Floor(5.0, 0.4 * ONE))
    exact = oi.radiance(floored, rays, oi.PlaneParallel(16)).value
    z = np.asarray((found.value - exact) / found.stderr)
    assert np.abs(z).max() < stats.norm.isf(0.001), z
    assert (found.stderr < 0.05 * exact).all()


def test_spot_lamp_scatters_once():
    """A beam across the line of sight, in water so thin that light scatters once:
    the closed form by quadrature, within the stated error."""
    b = 1e-4
    thin = oi.IOPs(WAVELENGTH, 0 * ONE, b * ONE, HenyeyGreenstein(0.5))
    lamp = oi.SpotLamp([2.0, 0.0, 3.0], [-1.0, 0.0, 0.0], 20.0, ONE)
    scene = oi.Scene(thin, oi.Light(0.0, 0 * ONE), floor=oi.Floor(6.0, 0 * ONE), lamps=(lamp,))
    rays = oi.Rays(A([0.0, 0.0, 1.0]), A([[0.0, 0.0, 1.0]]))
    found = oi.radiance(scene, rays, oi.MonteCarlo(2**13, 2), key=KEY)
    z = np.linspace(1.0, 6.0, 20001)
    r = np.hypot(2.0, z - 3.0)
    lit = 2.0 / r >= np.cos(np.radians(20.0))
    phase = HenyeyGreenstein(0.5)(A((3.0 - z) / r))
    exact = np.trapezoid(b * np.asarray(phase) * lit / r**2, z)
    assert np.abs(np.asarray((found.value - exact) / found.stderr)).max() < 3.5
    assert (found.stderr < 0.05 * exact).all()


def test_objects_are_differentiable_in_reflectance_alone():
    rays = oi.Rays(A([0.0, 0.0, 0.5]), A([[0.0, 0.0, 1.0]]))
    light, mc = oi.Light(0.0, ONE), oi.MonteCarlo(32, 2)

    def value(scale, radius):
        sphere = oi.Sphere([0.0, 0.0, 3.0], radius, A([0.2, 0.8]) * scale)
        scene = oi.Scene(water([0.0, 0.0]), light, objects=(sphere,))
        return oi.radiance(scene, rays, mc, key=KEY).value[0]

    exact = value(1.0, 1.0)
    np.testing.assert_allclose(jax.jacfwd(value)(1.0, 1.0), exact, rtol=1e-9)
    with pytest.raises(ValueError, match=r"objects\[0\].radius"):
        jax.jacfwd(value, 1)(1.0, 1.0)


def test_things_where_they_cannot_be():
    scene = oi.Scene(water([0.0, 0.0]), oi.Light(0.0, ONE), objects=(SPHERE,))
    look = A([[0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match=r"inside objects\[0\]"):
        oi.radiance(scene, oi.Rays(A([0.0, 0.0, 2.5]), look), oi.MonteCarlo(32, 1), key=KEY)
    with pytest.raises(ValueError, match="horizontally uniform"):
        oi.irradiance(scene, A([1.0]), oi.MonteCarlo(32, 1), key=KEY)
