"""The tables against published numbers, their headers, and the errors of the loader."""

import csv
import doctest
import importlib.util
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oceaninv.foundation import spectrum, tables
from oceaninv.water import pure_water as water
from tests.paths import REFERENCE, ROOT

# Typed from the publications, not read from the csv files.
PUBLISHED = [
    ("IOCCG2018", "a", 440, 0.00635),
    ("IOCCG2018", "a", 750, 2.85),
    ("IOCCG2018", "a_temperature", 740, 161.0e-4),
    ("IOCCG2018", "a_salinity", 400, 0.43e-4),
    ("PopeFry1997", "a", 380, 0.01137),
    ("PopeFry1997", "a", 417.5, 0.00442),
    ("PopeFry1997", "a", 550, 0.0565),
    ("PopeFry1997", "a", 727.5, 1.678),
    ("SmithBaker1981", "a", 200, 3.07),
    ("SmithBaker1981", "a", 430, 0.0144),
    ("SmithBaker1981", "a", 800, 2.07),
    ("WOPPv3", "a", 400, 0.00222),
    ("WOPPv3", "a", 500, 0.02073),
    ("WOPPv3", "a_temperature", 600, 0.000759),
    ("Bricaud1995", "A", 400, 0.0263),
    ("Bricaud1995", "E", 700, -0.034),
    ("Bricaud1995", "A", 440, 0.0403),
    ("Bricaud1998", "A_phi", 400, 0.0240515),
    ("Bricaud1998", "E_p", 404, 0.697132),
    ("MorelMaritorena2001", "Kw", 490, 0.0166),
    ("MorelMaritorena2001", "chi", 490, 0.07242),
    ("MorelMaritorena2001", "e", 490, 0.68955),
    ("Jerlov1976", "I", 475, 0.018),
    ("Jerlov1976", "II", 310, 0.37),
    ("Jerlov1976", "9C", 700, 1.1),
    ("SolonenkoMobley2015", "a_II", 450, 0.0241),
    ("SolonenkoMobley2015", "b_9C", 700, 2.07),
    ("SolonenkoMobley2015", "KdH_1C", 500, 0.103),
    ("WilliamsonHollins2022", "a_IB", 410, 0.0436),
    ("WilliamsonHollins2022", "b_5C", 800, 1.07),
    ("Gutierrez2008", "a_water", 500, 0.0257),
    ("Gutierrez2008", "a_phytoplankton", 440, 0.035),
    ("Hawes1992", "A0", 310, 5.18e-5),
    ("Hawes1992", "A0", 450, 1.348e-4),
]


# The package stays small; 52 cameras of three channels take more than others.
MOST_BYTES = {"cameras": 130_000}


@pytest.mark.parametrize("name", tables.names())
def test_header_units_and_range_are_complete(name):
    table = tables.load(name)
    assert table.title
    assert table.note
    assert any(character.isdigit() for character in table.citation)
    assert set(table.columns) <= set(table.units)
    assert all(table.units.values())
    extent, unit = table.range.split()
    axis = table.wavelength
    if axis.size == 0:
        axis = table.columns[{"deg": "angle", "1/cm": "shift"}[unit]]
    assert (unit == "nm") == (table.wavelength.size > 0)
    assert [float(end) for end in extent.split("-")] == [axis[0], axis[-1]]
    assert np.all(np.diff(axis) > 0)
    assert all(column.shape == axis.shape for column in table.columns.values())
    assert (ROOT / "oceaninv" / "data" / f"{name}.csv").stat().st_size < MOST_BYTES.get(
        name, 60_000
    )


@pytest.mark.parametrize(("name", "column", "wavelength", "value"), PUBLISHED)
def test_published_value(name, column, wavelength, value):
    assert tables.load(name).at([wavelength], column)[0] == pytest.approx(value, rel=1e-12)


def test_blanks_are_where_the_publications_have_none():
    blank = {
        (name, column): values[np.isnan(table.columns[column])].tolist()
        for name in tables.names()
        for table in [tables.load(name)]
        for column in table.columns
        for values in [table.wavelength]
        if np.isnan(table.columns[column]).any()
    }
    below_400 = list(np.arange(300.0, 400.0, 5.0))
    gap = {"3C": [675.0, 700.0], "5C": [600.0, 625.0, 650.0, 675.0, 700.0]}
    expected = {
        ("IOCCG2018", "a_salinity"): below_400,
        ("Jerlov1976", "7C"): [310.0],
        ("Jerlov1976", "9C"): [310.0],
    } | {
        ("SolonenkoMobley2015", f"{quantity}_{kind}"): where
        for kind, where in gap.items()
        for quantity in ("a", "Kd0", "Kd", "KdH")
    }
    assert blank == expected


def test_totals_printed_beside_the_detritus_and_minerals():
    table = tables.load("Gutierrez2008")
    total = table.columns["b_detritus"] + table.columns["b_minerals"]
    printed = [0.1125, 0.09, 0.0825, 0.075, 0.0685, 0.0635, 0.061, 0.059]
    np.testing.assert_allclose(total, printed, rtol=1e-14)
    smith_baker = tables.load("SmithBaker1981").at([380, 440, 500, 550, 610, 670], "a")
    np.testing.assert_allclose(table.columns["a_water"][:6], smith_baker, rtol=1e-12)


def test_solonenko_mobley_flags():
    table = tables.load("SolonenkoMobley2015")
    assert np.all(table.columns["flag_I"].astype(int) & 16 == 16)
    assert not np.any(table.columns["flag_9C"].astype(int) & 24)
    assert table.units["flag_I"] == "bits"
    below = table.columns["b_I"] < water.scattering(table.wavelength)
    np.testing.assert_array_equal(below, table.wavelength <= 550)


def test_petzold_integrates_to_one_with_the_stated_forward_slope():
    table = tables.load("Petzold1972")
    angle, p = np.deg2rad(table.columns["angle"]), table.columns["phase_function"]
    # Below the first angle p = p0 (t0/t)^1.3467: 2 pi p0 t0^2/(2 - 1.3467).
    forward = 2 * np.pi * p[0] * angle[0] ** 2 / (2 - 1.3467)
    assert forward == pytest.approx(0.052, abs=5e-4)
    fine = np.geomspace(angle[0], np.pi, 200_001)
    between = np.exp(np.interp(np.log(fine), np.log(angle), np.log(p)))
    element = 2 * np.pi * between * np.sin(fine)
    back = fine >= np.pi / 2
    assert forward + np.trapezoid(element, fine) == pytest.approx(1, abs=2e-3)
    assert np.trapezoid(element[back], fine[back]) == pytest.approx(0.0183, abs=1e-4)
    assert forward + np.trapezoid(element * np.cos(fine), fine) == pytest.approx(0.924, abs=2e-3)


def test_cameras_peak_at_one_in_green():
    assert len(spectrum.camera_names()) == 52
    for name in spectrum.camera_names():
        table = tables.load("cameras")
        assert table.columns[f"{name} G"].max() == 1.0
        assert min(table.columns[f"{name} {c}"].min() for c in "RGB") >= 0


def test_interpolation_is_linear_and_exact_at_nodes():
    table = tables.load("MorelMaritorena2001")
    np.testing.assert_array_equal(table.at(table.wavelength, "chi"), table.columns["chi"])
    assert table.at([492.0], "chi")[0] == pytest.approx(0.6 * 0.07242 + 0.4 * 0.06907, rel=1e-14)


def test_tables_are_shared_and_read_only():
    assert tables.load("WOPPv3") is tables.load("WOPPv3")
    with pytest.raises(ValueError, match="read-only"):
        tables.load("WOPPv3").columns["a"][0] = 1.0


def test_outside_the_range_is_an_error_that_names_table_range_and_wavelength():
    table = tables.load("Bricaud1995")
    with pytest.raises(ValueError, match=r"Bricaud1995 covers 400-700 nm, but 399 nm"):
        table.at([399, 500], "A")
    with pytest.raises(ValueError, match=r"Bricaud1995 covers 400-700 nm, but 701 nm"):
        table.at([500, 701], "A")
    with pytest.raises(ValueError, match="does not run over wavelength"):
        tables.load("Petzold1972").at([500.0], "phase_function")


def test_a_blank_is_an_error_only_where_it_would_be_used():
    table = tables.load("Jerlov1976")
    with pytest.raises(ValueError, match=r"no value of '7C' at 310 nm"):
        table.at([310], "7C")
    with pytest.raises(ValueError, match=r"no value of '7C' at 349 nm"):
        table.at([349], "7C")
    assert table.at([350.0], "7C")[0] == 3.0
    blue = tables.load("SolonenkoMobley2015")
    assert blue.at([650.0], "a_3C")[0] == 0.346
    with pytest.raises(ValueError, match=r"no value of 'a_3C' at 650.5 nm"):
        blue.at([650.5], "a_3C")


def test_unknown_names_list_near_names():
    with pytest.raises(ValueError, match=r"Table 'pope & fry' is unknown. Near it: PopeFry1997"):
        tables.load("pope & fry")
    with pytest.raises(ValueError, match=r"Column of table Jerlov1976 'IC'.*Known: 1C, 3C"):
        tables.load("Jerlov1976").at([500], "IC")
    assert "Near" not in str(tables.unknown("Thing", "zzz", ["abc"]))
    assert "Near it: Nikon D850." in str(tables.unknown("Camera", "d850", ["Nikon D850"]))


@pytest.mark.parametrize(
    ("wavelength", "sentence"),
    [
        (500.0, r"one-dimensional, but came with shape \(\)"),
        ([[500.0]], r"one-dimensional, but came with shape \(1, 1\)"),
        ([], "at least one value"),
        ([400.0, np.nan], "finite, but holds nan at position 1"),
        ([400.0, np.inf], "finite, but holds inf at position 1"),
        ([-1.0, 400.0], "positive .* holds -1"),
        ([0.0, 400.0], "positive .* holds 0"),
        ([500.0, 500.0], "strictly increasing, but 500 nm follows 500 nm"),
        ([500.0, 600.0, 400.0], "strictly increasing, but 400 nm follows 600 nm"),
        ([500.0 + 0j], "real numbers in nm, but came as complex128"),
        (["blue"], "real numbers in nm"),
    ],
)
def test_check_wavelength_refuses(wavelength, sentence):
    with pytest.raises(ValueError, match=sentence):
        tables.check_wavelength(wavelength)


def test_check_wavelength_refuses_traced_arrays():
    @jax.jit
    def inside(wavelength):
        return tables.check_wavelength(wavelength)

    with pytest.raises(ValueError, match="must be concrete"):
        inside(jnp.array([400.0, 500.0]))


def test_check_wavelength_returns_float64():
    for given in ([400, 500], np.float32([400, 500]), jnp.array([400, 500]), (400, 500)):
        checked = tables.check_wavelength(given)
        assert checked.dtype == np.float64
        np.testing.assert_array_equal(checked, [400.0, 500.0])


def _regenerate_tables():
    """The module tests/reference/regenerate_tables.py."""
    path = REFERENCE / "regenerate_tables.py"
    spec = importlib.util.spec_from_file_location("regenerate_tables", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_committed_tables_have_the_digests_they_were_written_with():
    with open(REFERENCE / "table_digests.csv", encoding="utf-8") as file:
        listed = {row["table"]: row["sha256"] for row in csv.DictReader(file)}
    module = _regenerate_tables()
    found = {path.name: module.digest(path) for path in (ROOT / "oceaninv/data").glob("*.csv")}
    assert sorted(found) == [f"{name}.csv" for name in sorted(tables.names())]
    assert found == listed


def test_a_changed_table_is_named(tmp_path, capsys):
    """The comparison behind --check: header, numbers, missing files; and a folder without data."""
    module = _regenerate_tables()
    data = ROOT / "oceaninv/data"
    for path in data.glob("*.csv"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    assert module.differences(tmp_path, data) == []
    name = "PopeFry1997.csv"
    text = (data / name).read_text(encoding="utf-8")
    for old, new, said in (
        ("0.00442", "0.00443", "numbers differ"),
        ("Pope & Fry", "Pope and Fry", "the header differs"),
    ):
        assert old in text
        (tmp_path / name).write_text(text.replace(old, new), encoding="utf-8")
        assert module.differences(tmp_path, data) == [f"{name}: {said}"]
        assert module.digest(tmp_path / name) != module.digest(data / name)
    (tmp_path / name).unlink()
    assert module.differences(tmp_path, data) == [f"{name}: only committed"]
    with pytest.raises(SystemExit):
        module.main([str(tmp_path)])
    assert "lacks aw_pope_fry_1997.csv" in capsys.readouterr().err


@pytest.mark.parametrize("module", [tables, water, spectrum], ids=lambda module: module.__name__)
def test_examples_in_docstrings(module):
    result = doctest.testmod(sys.modules[module.__name__])
    assert result.attempted > 0
    assert result.failed == 0
