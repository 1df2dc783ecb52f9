"""MonteCarlo with inelastic light: reference fields of an isotropic Raman source."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.water.inelastic import Inelastic, Raman, sources
from oceaninv.water.phase import HenyeyGreenstein, Isotropic
from tests.paths import REFERENCE

REFERENCE_FILE = REFERENCE / "radiative_transfer.json"
WAVELENGTH = np.array([490.0, 590.0])
A = jnp.asarray


def raman_water(a, b, g):
    """Light enters in the first band only; what is seen in the second is inelastic."""
    water = oi.IOPs(WAVELENGTH, A(a), A([0.0, b]), HenyeyGreenstein(g))
    light = oi.Light(0.0, A([1.0, 0.0]))
    return oi.Scene(water, light, inelastic=Inelastic(raman=Raman()))


def raman_matrix():
    """What the bands emit per scalar irradiance, 1/m: the same in all water."""
    water = oi.IOPs(WAVELENGTH, jnp.zeros(2), jnp.zeros(2), Isotropic())
    return sources(Inelastic(raman=Raman()), water)[0][0]


def looking_down(depths):
    depths = jnp.atleast_1d(A(depths))
    origin = jnp.stack([0 * depths, 0 * depths, depths], axis=1)
    return oi.Rays(origin, jnp.tile(A([[0.0, 0.0, 1.0]]), (len(depths), 1)))


@pytest.fixture(scope="module")
def isotropic():
    """Raman light that spreads evenly, as the reference has it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Raman, "phase", property(lambda self: Isotropic()))
        jax.clear_caches()
        yield
    jax.clear_caches()


@pytest.mark.parametrize("case", [0, 1])
def test_reference_radiance(isotropic, case):
    """Zenith sun, source b_R E0/(4 pi), seen through absorbing and through scattering water."""
    exact = json.loads(REFERENCE_FILE.read_text())["inelastic"]["cases"][case]
    scene = raman_water([exact["a_exc"], exact["a"]], exact["b"], exact["g"])
    found = oi.radiance(
        scene, looking_down(exact["z"]), oi.MonteCarlo(2**12, 16), key=jax.random.key(1)
    )
    matrix = raman_matrix()
    wanted = np.array(exact["Lu_nadir"]) * float(matrix[0, 1]) / exact["bR"]
    z = np.asarray(found.value[:, 1] - wanted) / np.asarray(found.stderr[:, 1])
    assert np.abs(z).max() < 3.3, z
    assert (np.asarray(found.stderr[:, 1]) < 0.1 * wanted).all()


def test_derivatives_are_those_of_the_closed_form(isotropic):
    """L = b_R E0(z)/(4 pi (a' + a)): slopes in both absorptions, no elastic scattering."""
    a = A([0.05, 0.25])

    def value(a):
        scene = raman_water(a, 0.0, 0.0)
        return oi.radiance(
            scene, looking_down(2.0), oi.MonteCarlo(2**12, 4), key=jax.random.key(2)
        ).value[0, 1]

    def closed(a):
        matrix = raman_matrix()
        return matrix[0, 1] * jnp.exp(-2.0 * a[0]) / (4 * jnp.pi * (a[0] + a[1]))

    np.testing.assert_allclose(value(a), closed(a), rtol=0.1)
    np.testing.assert_allclose(jax.jacfwd(value)(a), jax.jacfwd(closed)(a), rtol=0.15)


@pytest.fixture(scope="module")
def lit():
    """A scattering sea over a floor, sun and sky, under a surface."""
    one = jnp.ones(2)
    water = oi.IOPs(WAVELENGTH, A([0.05, 0.25]), A([0.3, 0.25]), HenyeyGreenstein(0.8))
    light = oi.Light(30.0, one, 0.1 * one)
    floor = oi.Floor(6.0, 0.3 * one)
    return oi.Scene(water, light, oi.FlatSurface(1.34), floor, inelastic=Inelastic(Raman(2.6e-2)))


@pytest.mark.parametrize("inelastic_orders", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_irradiance_against_the_exact_one(lit, inelastic_orders):
    """Raman light a hundred times as strong as it is: Ed, Eu and E0 at three depths."""
    depths = A([0.0, 2.0, 6.0])
    transport = oi.MonteCarlo(2**13, 24, inelastic_orders=inelastic_orders)
    found = oi.irradiance(lit, depths, transport, key=jax.random.key(3))
    exact = oi.irradiance(lit, depths, oi.PlaneParallel(16, inelastic_orders=inelastic_orders))
    for name in ("Ed", "Eu", "E0"):
        own, value = getattr(found, name), np.asarray(getattr(exact, name).value)
        z = (np.asarray(own.value) - value) / np.asarray(own.stderr)
        assert np.abs(z).max() < 3.5, (name, z)
        assert np.median(np.asarray(own.stderr)[:, 1] / value[:, 1]) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("inelastic_orders", [2, 3])
def test_radiance_of_every_change_against_the_exact_one(inelastic_orders):
    """Blue light alone enters, and Raman scattering a hundred times as strong as it is takes it
    from band to band: the third can only be reached by two changes, the fourth by three.  Looking
    down at the floor, up, and level, two layers."""
    bands = np.array([400.0, 465.0, 555.0, 690.0])
    iops = tuple(
        oi.IOPs(bands, A([0.2, 0.2, 0.25, 0.5]), A([0.2] * 4), HenyeyGreenstein(g))
        for g in (0.8, 0.5)
    )
    scene = oi.Scene(
        oi.Layers(A([2.0]), iops),
        oi.Light(30.0, A([1.0, 0.0, 0.0, 0.0])),
        oi.FlatSurface(1.34),
        oi.Floor(6.0, 0.3 * jnp.ones(4)),
        inelastic=Inelastic(Raman(2.6e-2)),
    )
    rays = oi.Rays(
        A([[0.0, 0.0, 1.0]] * 3), A([[0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, 1.0, 0.0]])
    )
    transport = oi.MonteCarlo(2**14, 20, inelastic_orders=inelastic_orders)
    found = oi.radiance(scene, rays, transport, key=jax.random.key(5))
    exact = oi.radiance(scene, rays, oi.PlaneParallel(12, inelastic_orders=inelastic_orders)).value
    value, stderr = np.asarray(found.value), np.asarray(found.stderr)
    z = (value - np.asarray(exact))[:, : inelastic_orders + 1] / stderr[:, : inelastic_orders + 1]
    assert np.abs(z).max() < 3.5, z
    assert (stderr[:, inelastic_orders] < 0.1 * value[:, inelastic_orders]).all()
    assert (value[:, inelastic_orders + 1 :] < 0.2 * value[:, inelastic_orders, None]).all()
