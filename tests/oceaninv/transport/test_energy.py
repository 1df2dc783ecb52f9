"""Energy budgets: the ten events, against the exact fluxes, closing to 1."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import oceaninv as oi
from oceaninv.water.phase import HenyeyGreenstein, Seawater

WAVELENGTH = np.linspace(420.0, 680.0, 5)
ONE = jnp.ones(5)
PROCESSES = oi.Inelastic(oi.Raman(), oi.ChlorophyllFluorescence(), oi.CDOMFluorescence())
AMOUNTS = oi.Constituents(chlorophyll=1.0, cdom=0.1, detritus=0.1)
WATER = oi.gutierrez2008().iops(AMOUNTS, WAVELENGTH)
FLOOR = oi.Floor(4.0, 0.3 * ONE)
TEN = {
    "absorption: water",
    "absorption: chlorophyll",
    "absorption: cdom",
    "absorption: detritus",
    "elastic: water",
    "elastic: chlorophyll",
    "elastic: detritus",
    "inelastic: water",
    "inelastic: chlorophyll",
    "inelastic: cdom",
}


def scene(floor=FLOOR, inelastic=None, light=None, surface=True):
    light = oi.Light(30.0, ONE) if light is None else light
    surface = oi.FlatSurface(1.34) if surface else None
    return oi.Scene(WATER, light, surface, floor, inelastic=inelastic)


@pytest.fixture(scope="module")
def ten():
    return oi.energy_budget(
        scene(inelastic=PROCESSES), oi.MonteCarlo(2**11, 32, inelastic_orders=2)
    )


def test_ten_events_close(ten):
    assert set(ten.events) == TEN
    assert ten.closure == pytest.approx(1.0, abs=1e-12)
    assert sum(ten.events.values()) == pytest.approx(1.0, abs=1e-12)
    assert all(value > 0 for value in ten.events.values())
    np.testing.assert_allclose(jnp.sum(ten.entered), 1.0, rtol=1e-12)
    remaining = np.asarray(ten.remaining.value)
    assert remaining[0] == 1.0
    assert (np.diff(remaining) < 0).all()
    assert remaining[5] < 0.1


@pytest.mark.slow
def test_inelastic_light_is_that_of_the_exact_scalar_irradiance(ten):
    """Raman: b_R times the depth's integral of E0, 1e-6 of which none goes astray (the balance
    above); its light and that of the fluorescences is absorbed or leaves: exact fluxes."""
    exact = oi.PlaneParallel(16, inelastic_orders=2)
    node, weight = np.polynomial.legendre.leggauss(24)
    field = oi.irradiance(scene(inelastic=PROCESSES), 2.0 * (1 + node), exact)
    light = 2.0 * weight @ np.asarray(field.E0.value)
    entered = np.asarray(ten.entered)
    cosine, sun = scene().beam()
    share = entered / np.asarray(sun * cosine)
    taken = share * light * np.asarray(oi.Raman().coefficient(WATER))
    found = ten.inelastic["water"]
    z = (np.asarray(found.value) - taken) / np.asarray(found.stderr)
    assert np.abs(z).max() < 3.5, z
    np.testing.assert_allclose(found.value, taken, rtol=0.05)


@pytest.mark.parametrize("floor", [FLOOR, pytest.param(None, marks=pytest.mark.slow)])
def test_absorbed_reflected_and_escaped_against_the_exact_fluxes(floor):
    """Sun and sky, two layers, a floor or none."""
    light = oi.Light(30.0, ONE, 0.05 * ONE)
    top = oi.IOPs(WAVELENGTH, 0.1 * ONE, jnp.stack([0.1 * ONE, 0.02 * ONE]), PHASES, ["x"])
    low = oi.IOPs(WAVELENGTH, 0.2 * ONE, jnp.stack([0.3 * ONE, 0.01 * ONE]), PHASES, ["y"])
    water = oi.Layers(jnp.asarray([1.0]), (top, low))
    layered = oi.Scene(water, light, None, floor)
    found = oi.energy_budget(layered, oi.MonteCarlo(2**12, 48))
    depths = [0.0, 1.0] + ([] if floor is None else [4.0])
    exact = oi.irradiance(layered, depths, oi.PlaneParallel(24))
    down, up = np.asarray(exact.Ed.value), np.asarray(exact.Eu.value)
    entering = down[0]
    net = np.concatenate([down - up, np.zeros((1, 5))])
    expected = {
        "x": net[0] - net[1],
        "y": net[1] - net[2],
        "surface": up[0],
    }
    if floor is not None:
        expected["floor"] = net[2]
    z = []
    for name, value in expected.items():
        own = (found.absorption | found.sinks)[name]
        value = value / np.sum(entering)
        assert (np.asarray(own.stderr) < 0.05 * value).all(), name
        z.append((np.asarray(own.value) - value) / np.asarray(own.stderr))
    limit = stats.norm.isf((1 - 0.99 ** (1 / (5 * len(z)))) / 2)
    assert np.abs(z).max() < limit, z
    assert found.closure == pytest.approx(1.0, abs=1e-12)


PHASES = (HenyeyGreenstein(0.8), Seawater())


def test_what_cannot_be_budgeted_says_so():
    thing = oi.Sphere([0.0, 0.0, 2.0], 0.5, ONE)
    with pytest.raises(ValueError, match="leave objects, lamps"):
        oi.energy_budget(oi.Scene(WATER, oi.Light(0.0, ONE), objects=(thing,)))
