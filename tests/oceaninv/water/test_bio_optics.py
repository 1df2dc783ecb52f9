"""Bio-optical models: values by hand, ranges, limits, an added constituent, Jerlov waters."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv import water
from oceaninv.foundation import tables
from oceaninv.water import pure_water
from oceaninv.water.bio_optics import JERLOV_SOURCES, jerlov_types
from tests.reference.extra_constituent import Bubbles

VISIBLE = np.arange(400.0, 701.0, 50.0)


def test_default_model_by_hand():
    """Each row of the default model from its formula; the sums from the rows."""
    amounts = {"chlorophyll": 2.0, "cdom": 0.1, "detritus": 0.05, "minerals": 3.0}
    found = oi.BioOpticalModel().iops(oi.Constituents(**amounts), VISIBLE)
    table = tables.load("Bricaud1998")
    rows = dict(zip(found.absorbers, np.asarray(found.a_components), strict=True))
    expected = {
        "water": water.absorption(VISIBLE),
        "chlorophyll": table.at(VISIBLE, "A_phi") * 2.0 ** table.at(VISIBLE, "E_phi"),
        "cdom": 0.1 * np.exp(-0.0176 * (VISIBLE - 440)),
        "detritus": 0.05 * np.exp(-0.0123 * (VISIBLE - 400)),
        "minerals": 3.0 * 0.041 * np.exp(-0.0123 * (VISIBLE - 443)),
    }
    assert rows.keys() == expected.keys()
    for name, row in expected.items():
        np.testing.assert_allclose(rows[name], row, rtol=1e-13, err_msg=name)
    scattering = (
        water.scattering(VISIBLE)
        + 0.30 * 2.0**0.62 * 550 / VISIBLE
        + 5 * 0.05 * (400 / VISIBLE) ** 0.9
        + 0.51 * 3.0 * (555 / VISIBLE) ** 0.3
    )
    np.testing.assert_allclose(found.b, scattering, rtol=1e-13)
    # Backscatter: half of the water's, 1.0 % of the algae's, 1.8 and 2.0 % of the particles'.
    back = (
        0.5 * water.scattering(VISIBLE)
        + 0.010 * 0.30 * 2.0**0.62 * 550 / VISIBLE
        + 0.018 * 5 * 0.05 * (400 / VISIBLE) ** 0.9
        + 0.020 * 0.51 * 3.0 * (555 / VISIBLE) ** 0.3
    )
    np.testing.assert_allclose(found.bb, back, rtol=1e-6)


def test_absent_is_not_zero():
    """None has no row; 0 has one, and the same totals up to the knee of the power law."""
    model = oi.BioOpticalModel()
    pure = model.iops(oi.Constituents(), VISIBLE)
    none = model.iops(oi.Constituents(cdom=0.1), VISIBLE)
    zero = model.iops(oi.Constituents(cdom=0.1, chlorophyll=0.0), VISIBLE)
    assert pure.absorbers == ("water",)
    assert none.absorbers == ("water", "cdom")
    assert zero.absorbers == ("water", "chlorophyll", "cdom")
    np.testing.assert_allclose(zero.c, none.c, rtol=1e-14)


def test_gutierrez2008_by_hand():
    """Equations 3-13 of the paper (its eq 12 and 13 put right) at its own table wavelengths."""
    wl = np.array([440.0, 500.0, 550.0, 670.0])
    chlorophyll, cdom, detritus = 0.5, 0.06, 0.1
    found = oi.gutierrez2008().iops(
        oi.Constituents(chlorophyll=chlorophyll, cdom=cdom, detritus=detritus), wl
    )
    # Smith & Baker 1981; the paper's table 1 prints these eight, in 1/cm by mistake.
    pure = np.array([0.0145, 0.0257, 0.0638, 0.43])
    algae = chlorophyll * np.array([0.035, 0.02, 0.01, 0.015])
    a = pure + algae + cdom * np.exp(-0.014 * (wl - 440)) + detritus * np.exp(-0.011 * (wl - 400))
    # Smith & Baker's own 670 nm value is 0.439, the paper's 0.43.
    np.testing.assert_allclose(found.a[:3], a[:3], rtol=1e-12)
    np.testing.assert_allclose(found.a[3], a[3], rtol=0.03)
    molecules = 0.00288 * (wl / 500) ** -4.32
    cells = 0.30 * chlorophyll**0.62 * 550 / wl
    # Table 2 (detritus + minerals) at 0.1 /m; 670 nm is one of its wavelengths.
    table2 = np.array([0.0375 + 0.0525, 0.0325 + 0.05, 0.03 + 0.045, 0.0275 + 0.036])
    np.testing.assert_allclose(found.b, molecules + cells + table2, rtol=1e-12)
    back = 0.5 * (molecules + cells)
    assert np.all(np.asarray(found.bb) > back)
    np.testing.assert_allclose(found.bb - back, 0.0183 * table2, rtol=0.02)


@pytest.mark.parametrize("name", ["chlorophyll", "cdom", "detritus", "minerals"])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_gradient_at_nothing(name, mode):
    """Value and slope finite at 0 of every constituent (C^0.62 has none of its own)."""
    model = oi.BioOpticalModel()

    def total(amount):
        found = model.iops(oi.Constituents(**{name: amount}), VISIBLE)
        return found.a, found.bb

    for slope in mode(total)(jnp.asarray(0.0)):
        assert bool(jnp.all(jnp.isfinite(slope)))
        assert float(jnp.min(slope)) >= 0


def test_gradient_against_differences():
    model = oi.BioOpticalModel()

    def total(v):
        held = oi.Constituents(chlorophyll=v[0], cdom=v[1], detritus=v[2], minerals=v[3])
        found = model.iops(held, VISIBLE)
        return jnp.concatenate([found.a, found.b, found.bb])

    at = jnp.asarray([1.3, 0.1, 0.05, 2.0])
    forward = jax.jacfwd(total)(at)
    np.testing.assert_allclose(forward, jax.jacrev(total)(at), rtol=1e-12)
    for k in range(4):
        step = 1e-5 * float(at[k])
        rise = (total(at.at[k].add(step)) - total(at.at[k].add(-step))) / (2 * step)
        np.testing.assert_allclose(forward[:, k], rise, rtol=1e-8, atol=1e-9)


def test_jit_vmap_and_single_precision():
    model = oi.BioOpticalModel()

    def absorption(chlorophyll):
        return model.iops(oi.Constituents(chlorophyll=chlorophyll), VISIBLE).a

    several = jnp.asarray([0.1, 1.0, 10.0])
    found = jax.jit(jax.vmap(absorption))(several)
    np.testing.assert_allclose(found[1], absorption(1.0), rtol=1e-14)
    single = model.iops(
        oi.Constituents(chlorophyll=jnp.float32(1.0), cdom=jnp.float32(0.1)), VISIBLE
    )
    for value in (single.a, single.b, single.bb, single.scattering_moments(2)):
        assert value.dtype == jnp.float32
    np.testing.assert_allclose(
        single.a, model.iops(oi.Constituents(1.0, 0.1), VISIBLE).a, rtol=1e-6
    )


def test_sixth_constituent():
    """A new constituent is one class: it is known by its name and adds its rows."""
    model = oi.BioOpticalModel((*oi.BioOpticalModel().constituents, Bubbles()))
    without = model.iops(oi.Constituents(cdom=0.1), VISIBLE)
    found = model.iops(oi.Constituents(cdom=0.1, bubbles=0.7), VISIBLE)
    np.testing.assert_allclose(found.b - without.b, 0.7, rtol=1e-12)
    np.testing.assert_allclose(found.a, without.a, rtol=1e-15)
    assert "bubbles" in found.scatterers
    assert "bubbles" not in found.absorbers
    slope = jax.grad(lambda x: model.iops(oi.Constituents(bubbles=x), VISIBLE).b.sum())
    np.testing.assert_allclose(slope(0.7), len(VISIBLE), rtol=1e-13)


def test_ranges():
    """The default covers 400-700 nm, with the named extension 380-780 nm."""
    amounts = oi.Constituents(chlorophyll=1.0)
    with pytest.raises(ValueError, match="covers 400-700 nm"):
        oi.BioOpticalModel().iops(amounts, [390.0])
    longer = oi.BioOpticalModel((oi.Phytoplankton(extension="Sathyendranath1987"),))
    # Several bands beyond either end are each what they are alone.
    bands = np.array([380.0, 395.0, 400.0, 550.0, 700.0, 705.0, 750.0, 780.0])
    alone = [float(longer.iops(amounts, [band]).a[0]) for band in bands]
    np.testing.assert_allclose(longer.iops(amounts, bands).a, alone, rtol=1e-14)
    inside, outside = (longer.iops(amounts, [x]).a_components[1, 0] for x in (400.0, 385.0))
    assert 0.5 * inside < outside < inside
    edge = oi.BioOpticalModel().iops(amounts, [400.0]).a_components[1, 0]
    np.testing.assert_allclose(inside, edge, rtol=1e-14)
    with pytest.raises(ValueError, match="Sathyendranath1987"):
        oi.BioOpticalModel((oi.Phytoplankton(extension="Bricaud"),)).iops(amounts, [450.0])


def test_refusals():
    model = oi.BioOpticalModel()
    with pytest.raises(ValueError, match="Near it: chlorophyll"):
        model.iops(oi.Constituents(chlorophyl=1.0), VISIBLE)
    with pytest.raises(ValueError, match="cdom must be finite and at least 0"):
        oi.Constituents(cdom=-0.1)
    with pytest.raises(ValueError, match="chlorophyll must be finite"):
        oi.Constituents(chlorophyll=np.nan)
    with pytest.raises(ValueError, match="strictly increasing"):
        model.iops(oi.Constituents(), [500.0, 400.0])
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda w: model.iops(oi.Constituents(), w).a)(jnp.asarray(VISIBLE))
    with pytest.raises(ValueError, match="IOCCG2018"):
        oi.BioOpticalModel(water_absorption="IOCCG").iops(oi.Constituents(), VISIBLE)
    silent = oi.BioOpticalModel((Bubbles(phase=None),))
    with pytest.raises(ValueError, match="scatters but has no phase function"):
        silent.iops(oi.Constituents(bubbles=1.0), VISIBLE)


@pytest.mark.parametrize("source", JERLOV_SOURCES)
def test_jerlov_types(source):
    """Every type of both sources at tabulated wavelengths, with its own a and b."""
    table = tables.load(source)
    for name in jerlov_types(source):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = oi.jerlov(name, [450.0, 550.0], source)
        a, b = (table.at([450.0, 550.0], f"{kind}_{name}") for kind in "ab")
        molecules = pure_water.scattering([450.0, 550.0])
        np.testing.assert_allclose(found.a, a)
        np.testing.assert_allclose(found.b, np.maximum(b, molecules))
        particles = np.maximum(b - molecules, 0.0)
        np.testing.assert_allclose(found.bb, molecules / 2 + 0.0183 * particles, rtol=2e-3)
    assert len(jerlov_types("SolonenkoMobley2015")) == 10
    assert jerlov_types("WilliamsonHollins2022") == ("IB", "II", "III", "1C", "3C", "5C")


def test_jerlov_values_and_flags():
    found = oi.jerlov("II", [450.0, 550.0])
    np.testing.assert_allclose(found.a, [0.0241, 0.0622])
    np.testing.assert_allclose(found.b, [0.504, 0.358])
    with pytest.warns(UserWarning, match="marks b of type I as doubtful. .* in 1 of 2 bands"):
        oi.jerlov("I", [450.0, 600.0])
    given = oi.jerlov("II", [450.0], phase=oi.phase.Isotropic())
    np.testing.assert_allclose(given.bb, 0.252)


@pytest.mark.parametrize("kind", ["I", "IA", "IB"])
def test_clearest_jerlov_waters_scatter_back_as_much_as_sea_water(kind):
    """Every nm of 412-550; the part of particles is what the table leaves."""
    wavelength = np.arange(412.0, 551.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = oi.jerlov(kind, wavelength)
    molecules = pure_water.scattering(wavelength)
    assert np.all(np.asarray(found.bb) >= molecules / 2 * (1 - 1e-6))
    table = tables.load("SolonenkoMobley2015").at(wavelength, f"b_{kind}")
    particles = found.b_components[found.scatterers.index("particles")]
    np.testing.assert_allclose(particles, np.maximum(table - molecules, 0.0), atol=1e-9)
    assert (kind == "I") == bool(np.any(np.asarray(particles) == 0.0))


def test_blue_jerlov_water_is_as_bright_as_hydrolight_says():
    """Rrs at 412 and 443 nm of types IA and IB, without Raman scattering, against the fit of Lee,
    Carder & Du 2004 (Applied Optics 43:4957, eqs 17 and 19) to HydroLight, which has the
    backscattering of water and of particles apart; r_rs to Rrs by Lee, Carder & Arnone 2002."""
    wavelength = [412.0, 443.0]
    for kind, worst in (("IA", 0.03), ("IB", 0.037)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            water = oi.jerlov(kind, wavelength)
        scene = oi.Scene(water, oi.Light(30.0, jnp.ones(2)), oi.FlatSurface())
        found = oi.apparent.remote_sensing_reflectance(scene, oi.PlaneParallel(streams=8))
        of_water = pure_water.scattering(wavelength) / 2
        below = water.a + water.bb
        u_water, u_particles = of_water / below, (water.bb - of_water) / below
        g_particles = 0.197 * (1 - 0.636 * np.exp(-2.552 * u_particles))
        r_rs = 0.113 * u_water + g_particles * u_particles
        np.testing.assert_allclose(found, 0.52 * r_rs / (1 - 1.7 * r_rs), rtol=worst)


def test_measured_coefficients_are_shared_between_sea_water_and_particles():
    wavelength = [412.0, 550.0]
    molecules = pure_water.scattering(wavelength)
    with pytest.warns(UserWarning, match="in 1 of 2 bands .first at 412 nm"):
        found = oi.measured_iops(wavelength, [0.02, 0.06], [0.004, 0.1])
    np.testing.assert_allclose(
        found.b_components, [[0.004, molecules[1]], [0.0, 0.1 - molecules[1]]], atol=1e-9
    )
    petzold = float(found.phases[1].backscatter_ratio)
    np.testing.assert_allclose(found.bb, [0.002, molecules[1] / 2 + petzold * (0.1 - molecules[1])])

    def backscattered(b):
        return oi.measured_iops(wavelength, jnp.full(2, 0.1), b, oi.phase.Isotropic()).bb

    # Traced, and without a warning.
    slope = jax.jit(jax.jacfwd(backscattered))(jnp.asarray([0.0, 0.1]))
    np.testing.assert_allclose(slope, [[0.5, 0.0], [0.0, 0.5]])
    # Sea water alone is no reason to warn.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = oi.measured_iops(wavelength, [0.02, 0.06], molecules)
    np.testing.assert_allclose(alone.bb, molecules / 2)
    with pytest.raises(ValueError, match=r"b must have shape \(2,\)"):
        oi.measured_iops(wavelength, [0.02, 0.06], 0.1)
    with pytest.raises(ValueError, match="b must be finite"):
        oi.measured_iops(wavelength, [0.02, 0.06], [np.nan, 0.1])
    with pytest.raises(ValueError, match="covers 300-800 nm"):
        oi.measured_iops([412.0, 850.0], [0.02, 0.06], [0.1, 0.1])


def test_jerlov_refusals():
    with pytest.raises(ValueError, match="Jerlov water type '4C'"):
        oi.jerlov("4C", [450.0])
    with pytest.raises(ValueError, match="Near it"):
        oi.jerlov("3c", [450.0])
    with pytest.raises(ValueError, match="source 'Solonenko'"):
        oi.jerlov("II", [450.0], "Solonenko")
    with pytest.raises(ValueError, match="leaves it blank"):
        oi.jerlov("5C", [650.0])
    with pytest.raises(ValueError, match="covers 300-700 nm"):
        oi.jerlov("II", [750.0])
