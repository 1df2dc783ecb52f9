"""The priors of a fitted water, a number a row with where it comes from, and its defaults."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from fitting import Identity, Log, Logit
from fitting.water_model import unknowns
from oceaninv.foundation.tables import load
from oceaninv.water.phase import backscatter_ratio_of

GRID = np.array([400.0, 440.0, 500.0, 550.0, 600.0, 700.0])

# name: centre, spread, unit, transform.  Spreads are of the logarithm unless the transform says.
PRIORS = {
    # A factor of ten either way is one standard deviation: a hundred waters from the clearest to
    # the most turbid lie within two.
    "chlorophyll": (0.5, 2.3, "mg m-3", Log()),
    "cdom": (0.05, 2.3, "m-1", Log()),
    "detritus": (0.03, 2.3, "m-1", Log()),
    # Scattering of detritus over its absorption at 400 nm: 5 within a factor of 2.
    "detritus_scattering_ratio": (5.0, 0.6931, "1", Log()),
    # Babin et al. 2003: European means 0.0176 and 0.0123 /nm; other seas 0.010 to 0.025 (Bricaud
    # et al. 1981; Twardowski et al. 2004) and 0.009 to 0.016.
    "cdom_slope": (0.0176, 0.25, "nm-1", Log()),
    "detritus_slope": (0.0123, 0.15, "nm-1", Log()),
    # Between 0.3 (Babin et al. 2003) and 0.9 (Stramski et al. 2001).
    "detritus_exponent": (0.6, 0.5, "1", Identity()),
    # Between 1 (Gordon & Morel 1983) and 0 (Morel & Maritorena 2001).
    "phytoplankton_exponent": (0.5, 0.5, "1", Identity()),
    # Bricaud et al. 1998: r2 of 0.90 at 440 nm over three decades, a factor of 1.5.
    "phytoplankton_absorption": (1.0, 0.4, "1", Log()),
    # Gordon & Morel 1983: 0.12 to 0.45 about 0.30.
    "phytoplankton_scattering": (1.0, 0.5, "1", Log()),
    # Within the two phase functions at hand.
    "backscatter": (1.0, 1.1, "1", Logit(0.4, 2.75)),
}


def check(parameter, centre, spread, unit, transform):
    assert parameter.centre == pytest.approx(centre, rel=1e-9), parameter.name
    assert parameter.spread == pytest.approx(spread, rel=1e-4), parameter.name
    assert (parameter.unit, parameter.transform) == (unit, transform), parameter.name


def test_priors_of_constituents_and_shapes_are_those_of_the_table():
    found = {p.name: p for p in (*unknowns.constituents(), *unknowns.shape_nuisances())}
    assert set(found) == set(PRIORS)
    for name, row in PRIORS.items():
        check(found[name], *row)
        assert found[name].nuisance == (name not in ("chlorophyll", "cdom", "detritus"))


def test_a_spread_of_backscatter_is_a_factor_of_one_point_six():
    (one,) = (p for p in unknowns.shape_nuisances() if p.name == "backscatter")
    assert one.spread is not None
    x = one.transform.coordinate(1.0)
    low, high = (one.transform.physical(np.float64(x + s * one.spread)) for s in (-1, 1))
    assert math.sqrt(high / low) == pytest.approx(1.6, rel=0.02)


@pytest.mark.parametrize(
    ("sun", "centre", "spread"), [(None, 40.0, 0.4), (35.0, 35.0, 0.05), (0.0, 1.0, 0.05)]
)
def test_the_sun_is_known_to_five_percent_or_hardly(sun, centre, spread):
    """0.05 of ln zenith stands for the share of sky light; an unknown sun is between 27 and 60."""
    found = {p.name: p for p in unknowns.water_unknowns(sun)}
    check(found["solar_zenith"], centre, spread, "degree", Log())
    assert found["solar_zenith"].nuisance


def test_kd_of_the_closed_forms_errs_by_two_percent():
    """0.6 % in the median and 2.2 % at the 90th percentile (tests/acceptance, four streams)."""
    found = {p.name: p for p in unknowns.water_unknowns(40.0)}
    check(found["kd_model_error"], 0.0, 0.02, "1", Identity())
    assert set(found) == {*PRIORS, "solar_zenith", "kd_model_error"}


def test_spectra_of_absorption_depart_by_a_third():
    """Bricaud et al. 1995, fig. 3, at the wavelengths of common ocean colour bands."""
    found = unknowns.absorption_shapes()
    assert [p.name for p in found] == [f"shape_{nm}" for nm in (412, 443, 490, 555, 620, 670)]
    for one in found:
        check(one, 1.0, 0.3, "1", Log())


def test_a_spread_of_packaging_moves_red_over_blue_by_a_quarter():
    """A factor of 3.3 on the chlorophyll that sets the shape, within the third by which algae of
    one chlorophyll differ (Bricaud et al. 1995, fig. 3)."""
    one = unknowns.pigment_packaging()
    check(one, 1.0, 1.2, "1", Log())
    table = load("Bricaud1998")
    red, blue = (float(table.at(np.array([nm]), "E_phi")[0]) for nm in (676.0, 440.0))
    assert math.exp(1.2 * (red - blue)) == pytest.approx(1.255, rel=0.01)


def test_factors_on_absorption_go_linearly_between_their_wavelengths():
    grid = np.array([412.0, 427.5, 522.5, 587.5, 645.0, 690.0])
    values = {"chlorophyll": jnp.asarray(1.0), "cdom": jnp.asarray(0.1)}
    factors = {f"shape_{nm}": jnp.asarray(1.0 + 0.1 * i) for i, nm in
               enumerate((412, 443, 490, 555, 620, 670))}  # fmt: skip
    plain = unknowns.water_iops(values, grid)
    shaped = unknowns.water_iops({**values, **factors}, grid)
    expected = [1.0, 1.05, 1.25, 1.35, 1.45, 1.5]
    for name, before, after in zip(
        plain.absorbers, plain.a_components, shaped.a_components, strict=True
    ):
        np.testing.assert_allclose(after / before, 1.0 if name == "water" else expected, rtol=1e-9)


def rows(**amounts):
    water = unknowns.water_iops({k: jnp.asarray(v) for k, v in amounts.items()}, GRID)
    return water, dict(zip(water.absorbers, np.asarray(water.a_components), strict=True))


def particles(water):
    """b and bb of all but the water itself, whose molecules are the first row."""
    b = np.asarray(water.b_components[1:])
    ratio = np.array([float(backscatter_ratio_of(p)) for p in water.phases[1:]])
    return b.sum(axis=0), ratio @ b


def test_algae_scatter_as_gordon_and_morel_say():
    """0.30 C^0.62 (550/wl) 1/m, one part in a hundred backwards."""
    b, bb = particles(rows(chlorophyll=2.0)[0])
    np.testing.assert_allclose(b, 0.30 * 2.0**0.62 * 550.0 / GRID, rtol=1e-9)
    np.testing.assert_allclose(bb / b, 0.010, rtol=2e-3)


def test_detritus_is_that_of_babin_and_stramski():
    water, a = rows(detritus=0.04)
    np.testing.assert_allclose(a["detritus"], 0.04 * np.exp(-0.0123 * (GRID - 400.0)), rtol=1e-9)
    b, bb = particles(water)
    np.testing.assert_allclose(b, 5.0 * 0.04 * (400.0 / GRID) ** 0.9, rtol=1e-9)
    np.testing.assert_allclose(bb / b, 0.018, rtol=2e-3)


def test_minerals_are_those_of_babin():
    water, a = rows(minerals=3.0)
    expected = 3.0 * 0.041 * np.exp(-0.0123 * (GRID - 443.0))
    np.testing.assert_allclose(a["minerals"], expected, rtol=1e-9)
    b, bb = particles(water)
    np.testing.assert_allclose(b, 3.0 * 0.51 * (555.0 / GRID) ** 0.3, rtol=1e-9)
    np.testing.assert_allclose(bb / b, 0.020, rtol=2e-3)


def test_cdom_absorbs_as_babin_says_and_scatters_nothing():
    water, a = rows(cdom=0.2)
    np.testing.assert_allclose(a["cdom"], 0.2 * np.exp(-0.0176 * (GRID - 440.0)), rtol=1e-9)
    assert len(water.b_components) == 1


def test_alternatives_of_backscattering_are_half_a_percent_to_two_and_a_half():
    """bb/b of 0.005 for algae and 0.025 for the rest; or falling as wavelength^-0.5 from 550 nm."""
    one = jnp.asarray(1.0)
    for name, ratio in (("chlorophyll", 0.005), ("detritus", 0.0252)):
        water = unknowns.water_iops({name: one, "assumed_backscatter_split": one}, GRID)
        b, bb = particles(water)
        np.testing.assert_allclose(bb / b, ratio, rtol=2e-3, err_msg=name)
    slanted = unknowns.water_iops({"detritus": one, "assumed_backscatter_slant": one}, GRID)
    b, bb = particles(slanted)
    np.testing.assert_allclose(bb / b, 0.018 * (550.0 / GRID) ** 0.5, rtol=2e-3)


def test_wavelengths_are_modelled_where_algal_absorption_is_tabulated():
    """380 to 780 nm (Sathyendranath, Lazzara & Prieur 1987)."""
    asked = np.array([379.0, 380.0, 550.0, 780.0, 781.0])
    assert unknowns.modelled_bands(asked).tolist() == [False, True, True, True, False]
