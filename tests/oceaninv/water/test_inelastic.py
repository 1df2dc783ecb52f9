"""Inelastic processes as matrices between bands: unit integrals, yields, what leaves the grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.water import inelastic
from oceaninv.water.inelastic import CDOMFluorescence, ChlorophyllFluorescence, Inelastic, Raman
from oceaninv.water.phase import HenyeyGreenstein

GRID = np.arange(310.0, 801.0, 10.0)


def water(wavelength=GRID, absorbers=("water", "chlorophyll", "cdom")):
    n = len(wavelength)
    a = jnp.stack([jnp.full(n, value) for value in (0.1, 0.02, 0.03)])
    return oi.IOPs(wavelength, a, jnp.full(n, 0.2), HenyeyGreenstein(0.9), absorbers)


def row_sums(term, wavelength=GRID, photons=False):
    shares = term.shares(wavelength, photons)
    return shares.inside.sum(axis=1) + shares.outside


def at(wavelength):
    """Three narrow bands, the middle one around a wavelength."""
    return wavelength + np.array([-0.01, 0.0, 0.01])


@pytest.mark.parametrize("grid", [GRID, np.linspace(400.0, 700.0, 8), np.array([350.0, 351.0])])
def test_raman_has_unit_integral(grid):
    np.testing.assert_allclose(row_sums(Raman(), grid), 1.0, rtol=1e-13)


@pytest.mark.parametrize(
    ("excitation", "centroid", "peak", "width"),
    [(350.0, 397.03, 397.52, 6.33), (488.0, 584.56, 585.6, 13.72), (550.0, 675.83, 677.19, 18.33)],
)
def test_raman_band_against_the_corrected_equation(excitation, centroid, peak, width):
    """Centroid, peak and width by direct evaluation of eq 20 of Gutierrez et al., put right."""
    fine = np.concatenate([at(excitation), np.arange(centroid - 30, centroid + 40, 0.25)])
    density = Raman().shares(fine).inside[1, 5:-1]
    place = fine[5:-1]
    assert np.sum(place * density) / density.sum() == pytest.approx(centroid, abs=0.02)
    assert place[density.argmax()] == pytest.approx(peak, abs=0.2)
    assert np.ptp(place[density > density.max() / 2]) == pytest.approx(width, abs=0.4)


def test_raman_coefficient_is_a_band_mean():
    fine = oi.IOPs(at(488.0), jnp.ones(3), jnp.ones(3), HenyeyGreenstein(0.0))
    assert Raman().coefficient(fine)[1] == pytest.approx(2.6e-4, rel=1e-8)
    wide = oi.IOPs([450.0, 550.0], jnp.ones(2), jnp.ones(2), HenyeyGreenstein(0.0))
    w = np.linspace(400.0, 500.0, 100_001)
    mean = np.trapezoid(2.6e-4 * (488 / w) ** 5.5, w) / 100
    assert Raman().coefficient(wide)[0] == pytest.approx(mean, rel=1e-9)


@pytest.mark.parametrize("grid", [GRID, np.arange(400.0, 701.0, 5.0), np.linspace(400, 700, 8)])
def test_chlorophyll_photons_add_up(grid):
    """One photon for each that is emitted at all, 370-690 nm, none otherwise."""
    share = np.clip(np.minimum(690.0, grid_edges(grid)[1:]), 370.0, None) - np.clip(
        grid_edges(grid)[:-1], 370.0, 690.0
    )
    np.testing.assert_allclose(
        row_sums(ChlorophyllFluorescence(), grid, True),
        share / np.diff(grid_edges(grid)),
        rtol=1e-10,
        atol=1e-14,
    )


def grid_edges(grid):
    return oi.spectrum.band_edges(grid)


def test_chlorophyll_energy_is_photons_times_wavelength_ratio():
    """Energy per photon: integral of h(v) w/v over v, mean over the band of excitation w."""
    v = np.linspace(600.0, 770.0, 200_001)
    h = np.exp(-(((v - 685) / 10.6) ** 2) / 2) / (10.6 * np.sqrt(2 * np.pi))
    whole = GRID[(GRID > 375) & (GRID < 685)]
    expected = whole * np.trapezoid(h / v, v)
    found = row_sums(ChlorophyllFluorescence())[(GRID > 375) & (GRID < 685)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_what_leaves_the_grid_is_not_put_back():
    """685 nm emission on a grid that ends at 700 nm loses 7.9 % of its photons."""
    grid = np.arange(402.5, 700.0, 5.0)
    shares = ChlorophyllFluorescence().shares(grid, photons=True)
    np.testing.assert_allclose(shares.outside[:50], 0.0785, atol=2e-4)


@pytest.mark.parametrize(
    ("excitation", "photons", "energy", "peak"),
    [
        (310.0, 0.00943, 0.00643, 430.3),
        (350.0, 0.01376, 0.00991, 465.0),
        (390.0, 0.01506, 0.01142, 496.8),
        (430.0, 0.0186, 0.01477, 526.1),
        (490.0, 0.01175, 0.00994, 566.0),
    ],
)
def test_cdom_yields(excitation, photons, energy, peak):
    term = CDOMFluorescence()
    grid = at(excitation)
    # At the ends of the table half of the band lies outside.
    inside = 0.5 if excitation in (310.0, 490.0) else 1.0
    assert row_sums(term, grid, True)[1] / inside == pytest.approx(photons, rel=1.2e-3)
    assert row_sums(term, grid)[1] / inside == pytest.approx(energy, rel=1.2e-3)
    fine = np.concatenate([grid, np.arange(peak - 30.2, peak + 30, 1.0)])
    density = term.shares(fine, photons=True).inside[1, 5:-1]
    assert fine[5:-1][density.argmax()] == pytest.approx(peak, abs=0.7)


def test_what_a_grid_from_400_nm_leaves_out():
    """Shares of the emission that daylight excites from 400 nm on: the numbers of `Inelastic`."""
    grid = np.arange(300.0, 701.0, 10.0)
    algae, cdom = np.exp(-(((grid - 440) / 80) ** 2)), np.exp(-0.017 * (grid - 440))
    water = oi.IOPs(
        grid,
        jnp.asarray([algae, cdom]),
        jnp.ones(grid.size),
        oi.phase.Isotropic(),
        ("chlorophyll", "cdom"),
    )
    processes = oi.Inelastic(oi.Raman(), oi.ChlorophyllFluorescence(), oi.CDOMFluorescence())
    raman, chlorophyll, fulvic = (
        oi.spectrum.daylight(grid)[:, None] * np.asarray(matrix)
        for matrix, _ in inelastic.sources(processes, water)
    )

    def left(power, emission):
        column = power[:, grid == emission][:, 0]
        return column[grid >= 400].sum() / column.sum()

    found = [left(raman, v) for v in (440, 450, 460, 470)]
    np.testing.assert_allclose(found, [0.0, 0.115, 0.866, 1.0], atol=2e-3)
    found = [left(fulvic, v) for v in (440, 500, 600)]
    np.testing.assert_allclose(found, [0.205, 0.525, 0.706], atol=2e-3)
    np.testing.assert_allclose(left(chlorophyll, 680), 0.947, atol=2e-3)


def test_no_emission_before_the_excitation():
    """Only within a band can light be emitted as if at shorter waves."""
    for term in (Raman(), CDOMFluorescence()):
        assert np.all(np.tril(term.shares(GRID).inside, -1) == 0)


def test_wide_bands_are_means_of_narrow_ones():
    narrow, wide = np.arange(400.5, 700.0, 1.0), np.arange(405.0, 700.0, 10.0)
    for term in (ChlorophyllFluorescence(), CDOMFluorescence()):
        fine = term.shares(narrow).inside.reshape(30, 10, 30, 10).sum(axis=3).mean(axis=1)
        np.testing.assert_allclose(term.shares(wide).inside, fine, rtol=1e-7, atol=1e-13)


def test_sources_give_power_per_volume():
    """What is emitted on a wide grid is the yield of what was absorbed, in the excitation band."""
    iops, width = water(), np.diff(grid_edges(GRID))
    everything = Inelastic(Raman(), ChlorophyllFluorescence(), CDOMFluorescence())
    (raman, phase), (algae, _), (cdom, isotropic) = inelastic.sources(everything, iops)
    assert phase.asymmetry == 0
    assert isotropic.backscatter_ratio == 0.5
    light = np.zeros(len(GRID))
    light[9] = 1.0  # 400 nm
    power = [float((light @ m) @ width) for m in (raman, algae, cdom)]
    at_400 = float(Raman().coefficient(iops)[9]) * width[9]
    assert power[0] == pytest.approx(at_400, rel=1e-12)
    assert power[1] == pytest.approx(
        0.02 * 0.02 * ChlorophyllFluorescence().shares(GRID).inside[9].sum() * width[9], rel=1e-12
    )
    assert power[2] == pytest.approx(
        0.03 * CDOMFluorescence().shares(GRID).inside[9].sum() * width[9], rel=1e-12
    )


def test_absent_processes_leave_nothing():
    assert inelastic.sources(Inelastic(), water()) == ()
    assert len(inelastic.sources(Inelastic(cdom=CDOMFluorescence()), water())) == 1


def test_parameters_are_differentiable_and_the_dtype_is_kept():
    def total(quantum_yield):
        terms = Inelastic(chlorophyll=ChlorophyllFluorescence(quantum_yield))
        return jnp.sum(inelastic.sources(terms, water())[0][0])

    value, slope = jax.value_and_grad(total)(0.02)
    np.testing.assert_allclose(value, 0.02 * slope, rtol=1e-12)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), water())
    assert inelastic.sources(Inelastic(raman=Raman()), single)[0][0].dtype == np.float32


def test_errors_say_what_is_missing():
    nameless = water(absorbers=("a", "b", "c"))
    with pytest.raises(ValueError, match="absorber named 'cdom'; this water has a, b, c"):
        inelastic.sources(Inelastic(cdom=CDOMFluorescence()), nameless)
    one = oi.IOPs([500.0], jnp.ones(1), jnp.ones(1), HenyeyGreenstein(0.0))
    with pytest.raises(ValueError, match="two bands"):
        inelastic.sources(Inelastic(raman=Raman()), one)
    with pytest.raises(ValueError, match="quantum_yield must be finite and between 0 and 1"):
        ChlorophyllFluorescence(1.5)
    scene = oi.Scene(water(), oi.Light(30.0, jnp.ones(50)), inelastic=Inelastic(Raman()))
    with pytest.raises(ValueError, match="TwoStream does not solve inelastic processes"):
        oi.irradiance(scene, [1.0])
