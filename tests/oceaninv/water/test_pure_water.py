"""Pure water against published check values, limits and the definitions behind the formula."""

import csv

import numpy as np
import pytest

from oceaninv.foundation import tables
from oceaninv.water import pure_water as water
from tests.paths import REFERENCE

CHECK = REFERENCE / "pure_water_check_values.csv"
WAVELENGTH = np.arange(400.0, 701.0, 25.0)

# b in 1/m at 20 degC for S = 0, 35, 38.4 (Zhang, Hu & He 2009, computed independently, 5 digits).
ZHANG = {
    400: (0.0050386, 0.0065918, 0.0067127),
    450: (0.0030499, 0.0039797, 0.0040521),
    500: (0.0019575, 0.0025473, 0.0025932),
    600: (0.00091636, 0.0011866, 0.0012076),
    700: (0.00048494, 0.0006255, 0.00063641),
}


@pytest.mark.parametrize("wavelength", ZHANG)
def test_zhang2009_check_values(wavelength):
    got = [water.scattering([wavelength], salinity=s)[0] for s in (0.0, 35.0, 38.4)]
    # Half a unit of the fifth printed digit.
    np.testing.assert_allclose(got, ZHANG[wavelength], rtol=1.5e-5 + 5e-5)


def test_zhang2009_against_the_whole_check_table():
    with open(CHECK, encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    wavelength = np.array([float(row["wavelength"]) for row in rows])
    assert len(wavelength) == 13
    for salinity in (0.0, 35.0, 38.4):
        expected = [float(row[f"b_{salinity:g}"]) for row in rows]
        got = water.scattering(wavelength, salinity=salinity)
        np.testing.assert_allclose(got, expected, rtol=2.8e-5)  # worst 2.7e-5: their rounding
    at_90 = [float(row["beta90_35"]) for row in rows]
    factor = 4 * np.pi * (1 + water.phase_constant() / 3)
    np.testing.assert_allclose(water.scattering(wavelength) / factor, at_90, rtol=4.6e-5)


def test_zhang2009_density_part_against_zhang_and_hu_2009():
    # Fresh water, 20 degC: beta(90) at 366 and 578 nm of their table 1, three digits.
    factor = 4 * np.pi * (1 + water.phase_constant() / 3)
    got = water.scattering([366.0, 578.0], salinity=0.0) / factor
    np.testing.assert_allclose(got, [4.50e-4, 0.650e-4], rtol=1.2e-3)


def test_parts_of_zhang2009_against_published_standards():
    # UNESCO 1981 (Fofonoff & Millard 1983) check values of density and secant bulk modulus.
    assert water._density(5.0, 0.0) == pytest.approx(999.96675, rel=1e-8)
    assert water._density(5.0, 35.0) == pytest.approx(1027.67547, rel=1e-8)
    assert water._density(25.0, 35.0) == pytest.approx(1023.34306, rel=1e-8)
    assert 1e-5 / water._compressibility(25.0, 35.0) == pytest.approx(23726.34949, rel=1e-9)
    # Quan & Fry against air: 1.3330 (fresh) and 1.3394 (S = 35) at the sodium line, 20 degC.
    air = 1.000277
    for salinity, expected in ((0.0, 1.33300), (35.0, 1.33940)):
        index, _ = water._refractive_index(np.array([589.3]), 20.0, salinity)
        assert index[0] / air == pytest.approx(expected, abs=1.5e-4)


def test_slope_of_the_index_with_salinity_is_its_derivative():
    wavelength = np.array([400.0, 550.0, 700.0])
    low, slope = water._refractive_index(wavelength, 12.0, 20.0)
    high, _ = water._refractive_index(wavelength, 12.0, 21.0)
    np.testing.assert_allclose(high - low, slope, rtol=1e-11)


def test_zhang2009_is_continuous_into_fresh_water_and_grows_with_salt():
    fresh = water.scattering(WAVELENGTH, salinity=0.0)
    np.testing.assert_allclose(water.scattering(WAVELENGTH, salinity=1e-9), fresh, rtol=1e-9)
    steps = np.array([water.scattering(WAVELENGTH, salinity=s) for s in range(0, 41, 5)])
    assert np.all(np.diff(steps, axis=0) > 0)
    assert np.all(np.diff(steps, axis=1) < 0)


def test_morel1974_against_his_table():
    # b in 1/m, sea water and fresh water, as in Mobley 1994 table 3.8.
    wavelength = [350, 400, 450, 500, 525]
    sea = [0.01345, 0.00755, 0.00454, 0.00288, 0.00233]
    fresh = [0.01035, 0.00581, 0.00349, 0.00222, 0.00179]
    got = water.scattering(wavelength, "Morel1974")
    np.testing.assert_allclose(got, sea, rtol=1.3e-3)
    np.testing.assert_allclose(
        water.scattering(wavelength, "Morel1974", salinity=0.0), fresh, rtol=4.6e-3
    )
    # His last entries leave the power law.
    last = water.scattering([575, 600], "Morel1974") / [0.00162, 0.00141] - 1
    np.testing.assert_allclose(last, [-0.028, -0.071], atol=5e-4)


def test_morel1974_is_linear_between_fresh_and_sea_water_and_flat_above():
    at = [water.scattering([500.0], "Morel1974", salinity=s)[0] for s in (0, 17.5, 35, 39)]
    np.testing.assert_allclose(at, [0.00222, 0.00255, 0.00288, 0.00288], rtol=1e-14)


def test_the_two_sources_differ_as_documented():
    wavelength = np.arange(350.0, 701.0, 10.0)
    ratio = water.scattering(wavelength) / water.scattering(wavelength, "Morel1974")
    assert 0.87 < ratio.min() < 0.875
    assert 0.92 < ratio.max() < 0.93


def test_phase_constants():
    assert water.phase_constant("Morel1974") == 0.835
    assert water.phase_constant("Zhang2009") == pytest.approx(0.961 / 1.039, rel=1e-15)
    with pytest.raises(ValueError, match="Near it: Zhang2009"):
        water.phase_constant("Zhang")
    # b is the integral of beta(90) (1 + k cos^2), in Zhang's own form 8 pi/3 (2 + d)/(1 + d).
    k, d = water.phase_constant(), 0.039
    assert 4 * np.pi * (1 + k / 3) == pytest.approx(8 * np.pi / 3 * (2 + d) / (1 + d), rel=1e-15)


@pytest.mark.parametrize(
    ("source", "at_400"),
    [("SmithBaker1981", 0.0171), ("PopeFry1997", 0.00663), ("IOCCG2018", 0.0046)],
)
def test_absorption_at_400_nm(source, at_400):
    condition = {"temperature": 22.0, "salinity": 0.0} if source == "IOCCG2018" else {}
    assert water.absorption([400.0], source, **condition)[0] == pytest.approx(at_400, rel=1e-12)


def test_absorption_slopes():
    # 740 nm, where warm water absorbs more: 2.78 + 161e-4 (T - 22) + 1.8e-4 S.
    got = water.absorption([740.0], "IOCCG2018", temperature=5.0, salinity=30.0)[0]
    assert got == pytest.approx(2.78 - 17 * 161.0e-4 + 30 * 1.8e-4, rel=1e-12)
    got = water.absorption([600.0], "WOPPv3", temperature=5.0, salinity=30.0)[0]
    assert got == pytest.approx(0.23525 - 15 * 0.000759 - 30 * 4.33e-5, rel=1e-12)


def test_absorption_defaults_to_the_tables_own_condition():
    for source, temperature in (("IOCCG2018", 22.0), ("WOPPv3", 20.0)):
        got = water.absorption(WAVELENGTH, source)
        np.testing.assert_array_equal(got, tables.load(source).at(WAVELENGTH, "a"))
        np.testing.assert_array_equal(got, water.absorption(WAVELENGTH, source, temperature, 0.0))


def test_absorption_stays_positive_over_all_conditions():
    for source in ("IOCCG2018", "WOPPv3"):
        for temperature in (0.0, 30.0):
            for salinity, start in ((0.0, 300.0), (40.0, 400.0)):
                wavelength = np.arange(start, 800.5)
                assert water.absorption(wavelength, source, temperature, salinity).min() > 8e-4


def test_tables_without_slopes_refuse_other_conditions():
    own = water.absorption(WAVELENGTH, "PopeFry1997", temperature=22.0, salinity=0.0)
    np.testing.assert_array_equal(own, tables.load("PopeFry1997").at(WAVELENGTH, "a"))
    with pytest.raises(ValueError, match=r"its own temperature, 22, but temperature=20"):
        water.absorption(WAVELENGTH, "PopeFry1997", temperature=20.0)
    with pytest.raises(ValueError, match=r"its own salinity, 0, but salinity=35"):
        water.absorption(WAVELENGTH, "PopeFry1997", salinity=35)


def test_smith_baker_is_the_same_in_all_natural_waters():
    expected = tables.load("SmithBaker1981").at(WAVELENGTH, "a")
    for condition in ((None, None), (20.0, 35.0), (5, 0)):
        got = water.absorption(WAVELENGTH, "SmithBaker1981", *condition)
        np.testing.assert_array_equal(got, expected)
    with pytest.raises(ValueError, match="salinity must lie in 0 to 40"):
        water.absorption(WAVELENGTH, "SmithBaker1981", salinity=41.0)


def test_salinity_slope_missing_in_the_ultraviolet():
    with pytest.raises(ValueError, match=r"'a_salinity' at 390 nm.*Ask for salinity=0"):
        water.absorption([390.0, 500.0], salinity=35.0)
    assert water.absorption([390.0], temperature=22.0, salinity=0.0)[0] == 0.0048


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: water.absorption([500.0], "PopeFry"), "Near it: PopeFry1997"),
        (lambda: water.absorption([379.0], "PopeFry1997"), "covers 380-727.5 nm, but 379 nm"),
        (lambda: water.absorption([500.0], temperature=31.0), "0 to 30 degC, but is 31"),
        (lambda: water.absorption([500.0], salinity=-1.0), "salinity must lie in 0 to 40"),
        (lambda: water.scattering([500.0], salinity=float("nan")), "but is nan"),
        (lambda: water.scattering([500.0], "Morel"), "Near it: Morel1974"),
        (lambda: water.scattering([299.0, 500.0]), "300-800 nm, .* from 299 to 500"),
        (lambda: water.scattering([500.0], "Morel1974", temperature=10.0), "take Zhang2009"),
        (lambda: water.scattering([500.0], "Morel1974", salinity=39.5), "take Zhang2009"),
        (lambda: water.scattering(500.0), "one-dimensional"),
    ],
)
def test_errors(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()
