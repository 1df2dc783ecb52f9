"""Inelastic light in PlaneParallel: closed forms, energy, layers, floor, orders."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.water import inelastic
from oceaninv.water.phase import AbstractPhase, HenyeyGreenstein, Isotropic, Seawater
from tests.paths import REFERENCE

REFERENCE_FILE = REFERENCE / "radiative_transfer.json"


class OneStep(inelastic.AbstractInelastic):
    """The first of two bands excites the second, and nothing else happens."""

    strength: float
    pattern: AbstractPhase

    def coefficient(self, iops):
        return jnp.full(2, self.strength)

    def shares(self, wavelength, photons=False):
        return inelastic.Shares(np.array([[0.0, 1.0], [0.0, 0.0]]), np.zeros(2))

    @property
    def phase(self):
        return self.pattern


class Only(inelastic.Inelastic):
    process: inelastic.AbstractInelastic | None = None

    @property
    def terms(self):
        return (self.process,)


def scene(a, b, phase, pattern=None, zenith=0.0, strength=2.6e-4, **more):
    iops = oi.IOPs([400.0, 500.0], jnp.asarray(a), jnp.asarray(b), phase)
    process = Only(raman=inelastic.Raman(), process=OneStep(strength, pattern or Isotropic()))
    return oi.Scene(iops, oi.Light(zenith, jnp.asarray([1.0, 0.0])), inelastic=process, **more)


def cases():
    clear, turbid = json.loads(REFERENCE_FILE.read_text())["inelastic"]["cases"]
    return [
        pytest.param(clear, id="clear"),
        pytest.param(turbid, marks=pytest.mark.slow, id="turbid"),
    ]


@pytest.mark.parametrize("case", cases())
def test_closed_forms(case):
    """Fluxes and radiances to 1e-5 of the reference (48 streams where it scatters: E0 right at
    the surface is the last to converge)."""
    given = scene([case["a_exc"], case["a"]], [0.0, case["b"]], HenyeyGreenstein(float(case["g"])))
    z = np.asarray(case["z"])
    transport = oi.PlaneParallel(16 if case["b"] == 0 else 48, 1)
    fluxes = transport.fluxes(given, jnp.asarray(z))
    for name in ("Ed", "Eu", "E0"):
        found = getattr(fluxes, name)[:, 1]
        np.testing.assert_allclose(found, case[name], rtol=1e-5, atol=1e-5 * 2.6e-4)
    down, up = np.tile([0.0, 0.0, 1.0], (3, 1)), np.tile([0.0, 0.0, -1.0], (3, 1))
    origin = jnp.asarray(z[:, None] * np.array([0.0, 0.0, 1.0]))
    looks = jnp.asarray(np.concatenate([down, up]))
    seen = transport.radiance(given, oi.Rays(jnp.concatenate([origin] * 2), looks)).value[:, 1]
    expected = np.concatenate([case["Lu_nadir"], case["Ld_zenith"]])
    np.testing.assert_allclose(seen, expected, rtol=1e-5, atol=1e-5 * 6e-5)


def test_single_dipole_emission_under_a_slanted_sun():
    """Without elastic scattering: the source b p(angle to the sun) E e^(-a' z/mu0), integrated
    along the ray in closed form.  All three azimuth orders of a dipole take part."""
    a, strength, pattern = np.array([0.05, 0.25]), 2.6e-4, Seawater(0.53)
    given = scene(a, [0.0, 0.0], Isotropic(), pattern, 50.0, strength)
    looks = np.array([[0.6, 0.0, 0.8], [0.0, 0.8, 0.6], [-0.8, 0.0, -0.6], [0.48, 0.64, -0.6]])
    z = 3.0
    rays = oi.Rays(jnp.asarray([0.0, 0.0, z]), jnp.asarray(looks))
    found = oi.PlaneParallel(8, 3).radiance(given, rays).value[:, 1]
    sine, mu0 = np.sin(np.radians(50)), np.cos(np.radians(50))
    sun = np.array([-sine, 0.0, mu0])  # the way its light travels
    turned = -(looks @ sun)
    rate = a[1] + a[0] * looks[:, 2] / mu0
    length = np.where(looks[:, 2] > 0, np.inf, z / np.abs(looks[:, 2]))
    along = -np.expm1(-rate * length) / rate
    expected = strength * np.asarray(pattern(jnp.asarray(turned))) * np.exp(-a[0] * z / mu0) * along
    np.testing.assert_allclose(found, expected, rtol=1e-6)


GRID = np.arange(350.0, 701.0, 50.0)


def natural(floor=True, layers=False, processes=None, dtype=jnp.float64):
    n = len(GRID)
    a = jnp.asarray(
        [
            oi.water.absorption(GRID),
            0.03 * np.exp(-(((GRID - 440) / 80) ** 2)),
            0.05 * np.exp(-0.017 * (GRID - 440)),
        ],
        dtype=dtype,
    )
    b = jnp.asarray(0.3 * 500 / GRID, dtype=dtype)
    iops = oi.IOPs(GRID, a, b, HenyeyGreenstein(0.9), ("water", "chlorophyll", "cdom"))
    water = oi.Layers(jnp.asarray([2.0, 7.0], dtype), (iops,) * 3) if layers else iops
    if processes is None:
        processes = oi.Inelastic(oi.Raman(), oi.ChlorophyllFluorescence(), oi.CDOMFluorescence())
    light = oi.Light(40.0, jnp.full(n, 1.0, dtype), jnp.full(n, 0.1, dtype))
    bottom = oi.Floor(12.0, jnp.full(n, 0.3, dtype)) if floor else None
    return oi.Scene(water, light, oi.FlatSurface(1.34), bottom, inelastic=processes)


def without(given):
    return eqx.tree_at(lambda s: s.inelastic, given, None, is_leaf=lambda x: x is None)


@pytest.mark.parametrize("floor", [pytest.param(False, marks=pytest.mark.slow), True])
def test_energy_is_absorbed_or_leaves(floor):
    """Gershun's law with a source: the net flux falls by a E0 and grows by what is emitted."""
    given, transport = natural(floor), oi.PlaneParallel(10)
    z = jnp.asarray([0.2, 1.0, 4.0, 9.0, 11.5])

    def net(z):
        f, elastic = transport.fluxes(given, z), transport.fluxes(without(given), z)
        difference = f.Ed - f.Eu - elastic.Ed + elastic.Eu
        return difference, (f.E0 - elastic.E0, elastic.E0)

    _, slope, (extra, exciting) = jax.jvp(net, (z,), (jnp.ones_like(z),), has_aux=True)
    emitted = sum(exciting @ m for m, _ in inelastic.sources(given.inelastic, given.water))
    error = np.asarray(emitted - given.water.a[None, :] * extra - slope)
    assert np.abs(error[:, 1:] / np.asarray(emitted).max(axis=0)[1:]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("floor", [False, True])
def test_identical_layers_are_one(floor):
    transport = oi.PlaneParallel(8, 3)
    one, three = natural(floor), natural(floor, layers=True)
    z = jnp.asarray([0.0, 1.0, 2.0, 5.0, 11.0])
    for name in ("Ed", "Eu", "E0"):
        a, b = (getattr(transport.fluxes(s, z), name) for s in (one, three))
        base = getattr(transport.fluxes(without(one), z), name)
        np.testing.assert_allclose(a - base, b - base, rtol=2e-5, atol=1e-8)
    looks = jnp.asarray([[0.6, 0.0, 0.8], [0.0, 0.6, -0.8], [0.0, 0.8, -0.6]])
    rays = oi.Rays(jnp.asarray([0.0, 0.0, 4.0]), looks, jnp.asarray([3.0, np.inf, 4.0]))
    a, b = (transport.radiance(s, rays).value for s in (one, three))
    base = transport.radiance(without(one), rays).value
    np.testing.assert_allclose(a - base, b - base, rtol=2e-5, atol=1e-9)


@pytest.mark.slow
def test_inelastic_orders():
    """Each excites the next; what is left after one is within its bound."""
    given = natural()
    z = jnp.asarray([0.5, 5.0])
    base = oi.PlaneParallel(6).fluxes(without(given), z).E0
    found = [oi.PlaneParallel(6, inelastic_orders=g).fluxes(given, z).E0 - base for g in (1, 2, 3)]
    left = float(oi.PlaneParallel(6).inelastic_left(given))
    assert 0 < left < 0.1
    assert (found[1] >= found[0] * (1 - 1e-9)).all()
    assert (found[2] - found[0] <= left * found[0] * (1 + 1e-6) + 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize("floor", [False, True])
def test_slopes_with_depth(floor):
    """Those of the transfer equation are the derivatives with depth, in every layer."""
    given, z = natural(floor, layers=True), jnp.asarray([0.0, 1.0, 5.0, 8.0])
    transport = oi.PlaneParallel(6)
    _, found = transport.fluxes_and_slopes(given, z)
    _, exact = jax.jvp(lambda z: transport.fluxes(given, z), (z,), (jnp.ones_like(z),))
    for name in ("Ed", "Eu", "E0d", "E0u"):
        np.testing.assert_allclose(getattr(found, name), getattr(exact, name), rtol=1e-6)


@pytest.mark.slow
def test_gradient_against_differences():
    """With respect to the quantum yield, absorption, scattering and the floor, either way."""
    given, z = natural(), jnp.asarray([1.0, 8.0])

    def f(p):
        s = eqx.tree_at(
            lambda s: (
                s.inelastic.chlorophyll.quantum_yield,
                s.water.a_components,
                s.water.b_components,
                s.floor.reflectance,
            ),
            given,
            (
                0.02 * p[0],
                given.water.a_components * p[1],
                given.water.b_components * p[2],
                given.floor.reflectance * p[3],
            ),
        )
        found, slopes = oi.PlaneParallel(6).fluxes_and_slopes(s, z)
        return jnp.stack([found.Eu[:, -1], found.E0[:, -1], slopes.Eu[:, -1]])

    one = jnp.ones(4)
    # Rounding moves what the ill-conditioned fit of the source gives by some 1e-11: the steps are
    # long enough to drown it, and errors count against the light itself.
    value, step = jax.jit(f), 1e-2
    light = np.abs(np.asarray(value(one))).max()
    exact, worst = np.asarray(jax.jit(jax.jacfwd(f))(one)), 1e-6 * light
    np.testing.assert_allclose(jax.jit(jax.jacrev(f))(one), exact, rtol=1e-7, atol=1e-8 * light)
    for i in range(4):
        terms = [np.asarray(value(one + k * step * np.eye(4)[i])) for k in (-2, -1, 1, 2)]
        numeric = (terms[0] - 8 * terms[1] + 8 * terms[2] - terms[3]) / (12 * step)
        assert np.abs(exact[..., i] - numeric).max() < worst


def test_absent_processes_change_nothing():
    """A scene without them compiles to the program that knows nothing of them."""
    given = without(natural())
    lowered = jax.jit(lambda s: oi.PlaneParallel(4).fluxes(s, jnp.ones(1))).lower(given)
    assert "svd" not in lowered.as_text()
    with pytest.raises(ValueError, match=r"Inelastic\(\) holds no process"):
        oi.PlaneParallel(4).fluxes(natural(processes=oi.Inelastic()), jnp.ones(1))
