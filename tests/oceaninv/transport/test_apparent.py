"""Apparent optical properties: definitions against differences, limits, identities."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv import apparent
from oceaninv.water.phase import HenyeyGreenstein, Isotropic
from tests.paths import REFERENCE

REFERENCE_FILE = REFERENCE / "radiative_transfer.json"
TRANSPORT = oi.PlaneParallel(8, 4)
WATER = oi.IOPs([450.0, 550.0], jnp.asarray([0.1, 0.3]), jnp.full(2, 0.4), HenyeyGreenstein(0.8))


def scene(light=None, **more):
    light = oi.Light(40.0, jnp.ones(2), jnp.asarray([0.05, 0.1])) if light is None else light
    return oi.Scene(WATER, light, oi.FlatSurface(1.34), **more)


def test_asymptotic_attenuation():
    """K/c to 1e-5 of the reference, whatever scatters how."""
    cases = json.loads(REFERENCE_FILE.read_text())["analytic"]["asymptotic_K_over_c"]
    for g in sorted({c["g"] for c in cases}):
        omega = np.array([c["omega"] for c in cases if c["g"] == g])
        exact = np.array([c["K_over_c"] for c in cases if c["g"] == g])
        grid = np.arange(400.0, 400.0 + len(omega))
        water = oi.IOPs(grid, jnp.asarray(1 - omega), jnp.asarray(omega), HenyeyGreenstein(g))
        np.testing.assert_allclose(apparent.kd_asymptotic(water, 128), exact, rtol=1e-5)


def test_asymptotic_attenuation_of_isotropic_scattering():
    """w/(2 k) ln((1 + k)/(1 - k)) = 1 with k = K/c; its derivatives; c without scattering."""

    def found(p):
        water = oi.IOPs([450.0, 550.0], p[0], p[1], Isotropic())
        return apparent.kd_asymptotic(water)

    a, b = jnp.asarray([0.7, 1e-6]), jnp.asarray([0.3, 1.0])
    k = np.asarray(found((a, b)) / (a + b))
    omega = np.asarray(b / (a + b))
    np.testing.assert_allclose(omega / (2 * k) * np.log((1 + k) / (1 - k)), 1.0, rtol=2e-6)
    _, slope = jax.jvp(found, ((a, b),), ((a, 0 * b),))
    numeric = (found((a * 1.0001, b)) - found((a * 0.9999, b))) / 2e-4
    np.testing.assert_allclose(slope, numeric, rtol=1e-5)
    np.testing.assert_allclose(found((a, 0 * b)), a, rtol=1e-12)


def test_every_attenuation_is_its_definition():
    given = scene()
    z, h = 3.0, 1e-3
    found = apparent.apparent(given, z, TRANSPORT)
    fluxes = TRANSPORT.fluxes(given, jnp.asarray([z - h, z, z + h]))
    for name, values in (("Kd", fluxes.Ed), ("Ku", fluxes.Eu), ("K0", fluxes.E0)):
        slope = jnp.log(values[0] / values[2]) / (2 * h)
        np.testing.assert_allclose(getattr(found, name)[0], slope, rtol=1e-6)
    np.testing.assert_allclose(found.R[0], fluxes.Eu[1] / fluxes.Ed[1], rtol=1e-12)
    # Gershun: K of the net flux times its mean cosine is a (8 streams under a surface: 1e-6).
    net = (found.Kd - found.R * found.Ku) / (1 - found.R)
    np.testing.assert_allclose((net * found.mean_cosine)[0], WATER.a, rtol=2e-6)
    total = fluxes.Ed[1] / found.mean_cosine_down[0] + fluxes.Eu[1] / found.mean_cosine_up[0]
    np.testing.assert_allclose(total, fluxes.E0[1], rtol=1e-12)
    middle = apparent.kd_between(given, z - h, z + h, TRANSPORT)
    np.testing.assert_allclose(middle, found.Kd[0], rtol=1e-6)


def test_derivatives_of_every_attenuation():
    """In the lower layer's absorption and scattering, forward, against differences."""

    def found(p):
        lower = oi.IOPs([450.0, 550.0], p[0] * WATER.a, p[1] * WATER.b, HenyeyGreenstein(0.8))
        given = eqx.tree_at(
            lambda s: s.water,
            scene(floor=oi.Floor(5.0, jnp.full(2, 0.1))),
            oi.Layers(jnp.asarray([2.0]), (WATER, lower)),
        )
        here = apparent.apparent(given, 3.0, oi.PlaneParallel(4))
        return jnp.concatenate([here.Kd, here.Ku, here.K0])

    value, one, h = jax.jit(found), jnp.ones(2), 1e-3
    exact = jax.jit(jax.jacfwd(found))(one)
    for i, unit in enumerate(np.eye(2)):
        terms = [value(one + k * h * unit) for k in (-2, -1, 1, 2)]
        numeric = (terms[0] - 8 * terms[1] + 8 * terms[2] - terms[3]) / (12 * h)
        np.testing.assert_allclose(exact[..., i], numeric, rtol=1e-7, atol=1e-9)


def test_second_derivatives_in_the_water_are_refused():
    """They would lack how the modes change."""

    def light(a):
        water = oi.IOPs([450.0, 550.0], a, WATER.b, HenyeyGreenstein(0.8))
        given = eqx.tree_at(lambda s: s.water, scene(), water)
        return oi.PlaneParallel(4).fluxes(given, jnp.asarray([3.0])).Ed[0, 0]

    with pytest.raises(NotImplementedError, match="first derivatives in the water"):
        jax.hessian(light)(WATER.a)


def test_mean_attenuation_to_a_light_level():
    kd, depth = apparent.kd_to_light(scene(), 0.1, TRANSPORT)
    light = TRANSPORT.fluxes(scene(), jnp.concatenate([jnp.zeros(1), depth])).Ed
    np.testing.assert_allclose(jnp.diagonal(light[1:]), 0.1 * light[0], rtol=1e-9)
    np.testing.assert_allclose(kd, np.log(10) / depth, rtol=1e-12)
    shallow = scene(floor=oi.Floor(5.0, jnp.full(2, 0.1)))
    assert bool(jnp.isnan(apparent.kd_to_light(shallow, 1e-3, TRANSPORT)[0]).all())
    with pytest.raises(ValueError, match="share must be between 0 and 1"):
        apparent.kd_to_light(scene(), 10.0)


def test_reflectance_above_and_below():
    """Without refraction or reflection at nadir but for (1 - F)/n^2; the sky's mirror image."""
    given = scene()
    down = jnp.asarray([[0.0, 0.0, 1.0]])
    below = TRANSPORT.radiance(given, oi.Rays(jnp.zeros(3), down)).value[0]
    fresnel = (0.34 / 2.34) ** 2
    rrs = apparent.remote_sensing_reflectance(given, TRANSPORT)
    air = np.cos(np.radians(40.0)) + np.pi * given.light.diffuse
    np.testing.assert_allclose(rrs, below * (1 - fresnel) / 1.34**2 / air, rtol=1e-12)
    seen = apparent.radiance_above(given, down, TRANSPORT)[0]
    np.testing.assert_allclose(seen, rrs * air + fresnel * given.light.diffuse, rtol=1e-12)
    fluxes = TRANSPORT.fluxes(given, jnp.zeros(1))
    found = apparent.irradiance_reflectance(given, TRANSPORT)
    np.testing.assert_allclose(found, fluxes.Eu[0] / fluxes.Ed[0], rtol=1e-12)
    with pytest.raises(ValueError, match="must look down"):
        apparent.radiance_above(given, -down)


@pytest.mark.slow
def test_skies():
    """A table of the cardioid is the cardioid; a flat one is uniform; both keep the irradiance."""
    direct, diffuse = jnp.zeros(2), jnp.ones(2)
    angles = np.linspace(0.0, 90.0, 91)
    cosine = np.cos(np.radians(angles))
    skies = (
        oi.CardioidalSky(),
        oi.TabulatedSky(angles, 1 + 2 * cosine),
        oi.TabulatedSky(angles, np.full(91, 3.0)),
        None,
    )
    z = jnp.asarray([0.0, 5.0])
    lights = [oi.Light(30.0, direct, diffuse, sky) for sky in skies]
    cardioid, table, flat, uniform = (TRANSPORT.fluxes(scene(light), z).Ed for light in lights)
    np.testing.assert_allclose(table, cardioid, rtol=1e-12)
    np.testing.assert_allclose(flat, uniform, rtol=1e-12)
    # More of an overcast sky's light comes from above: less is lost to the surface and the depth.
    assert bool((cardioid > uniform).all())
    bare = [oi.Scene(WATER, light) for light in lights[::3]]
    entering = [TRANSPORT.fluxes(s, z).Ed[0] for s in bare]
    np.testing.assert_allclose(entering, np.pi * np.ones((2, 2)), rtol=1e-12)
    up = oi.Rays(jnp.zeros(3), jnp.asarray([[0.0, 0.0, -1.0]]))
    seen = TRANSPORT.radiance(scene(lights[0]), up).value[0]
    base = TRANSPORT.radiance(scene(lights[3]), up).value[0]
    assert bool((seen > base).all())


def test_skies_that_are_refused():
    with pytest.raises(ValueError, match="needs diffuse"):
        oi.Light(30.0, jnp.ones(2), sky=oi.CardioidalSky())
    with pytest.raises(ValueError, match="from 0 to 90"):
        oi.TabulatedSky([0.0, 80.0], [1.0, 1.0])
    with pytest.raises(ValueError, match="two vectors of one length"):
        oi.TabulatedSky([0.0, 90.0], [1.0, 1.0, 2.0])
    light = oi.Light(30.0, jnp.ones(2), jnp.ones(2), oi.CardioidalSky())
    with pytest.raises(ValueError, match="TwoStream solves uniform skies only"):
        oi.irradiance(scene(light), [1.0])
