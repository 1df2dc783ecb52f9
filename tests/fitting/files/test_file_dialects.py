"""Tables of text as instruments and other programs write them, each with a known Kd."""

import numpy as np
import pytest

from fitting import fit_profile
from fitting.files.cast_file import Reading, raw_casts, read_cast, read_casts
from fitting.files.irradiance_units import (
    depth_kind,
    irradiance_factor,
    irradiance_units_in,
    par_factor,
)

DEPTH = np.linspace(0.5, 20.0, 40)
BANDS, KD = (412, 490, 555), np.array([0.12, 0.08, 0.10])


def light(depth=DEPTH):
    return np.exp(-depth[:, None] * KD)


def table(names, columns, mark=",", decimal="."):
    cells = [[f"{v:.8g}".replace(".", decimal) for v in row] for row in zip(*columns, strict=True)]
    rows = [mark.join(row) for row in cells]
    return "\n".join([mark.join(names), *rows]) + "\n"


def kd_of(path, reading=None):
    fit = fit_profile(read_cast(path, reading), depth_range=(0.0, 30.0))
    return fit.quantities["Kd"].value


NAMES = ["depth [m]", *(f"Ed_{nm} [W m-2 nm-1]" for nm in BANDS)]
COLUMNS = [DEPTH, *light().T]
DIALECTS = {
    "semicolons and decimal commas": table(NAMES, COLUMNS, ";", ","),
    "tabs": table(NAMES, COLUMNS, "\t"),
    "tabs and decimal commas": table(NAMES, COLUMNS, "\t", ","),
    "a delimiter at each line's end": table(NAMES, COLUMNS, ";").replace("\n", ";\n"),
    "PANGAEA": "/* DATA DESCRIPTION:\nCitation:\tSomebody (2020)\nUnit:\tno, unit\n*/\n"
    + table(["Depth water [m]", *(f"Ed_{nm} [W/m**2/nm]" for nm in BANDS)], COLUMNS, "\t"),
    "C-OPS": "Start of Header\nChannel,Tag\nEdZ490,A,µW/(cm² nm)\nEnd of Header\n"
    + table(
        ["EdZDepth (m)", *(f"EdZ{nm} (µW/(cm² nm))" for nm in BANDS), "Ed0Tilt (°)"],
        [DEPTH, *100 * light().T, 0 * DEPTH],
    ),
    "missing values by name": table(NAMES, COLUMNS).replace("\n2.5,", "\nNA,", 1)
    + "20.5,NA,n/a,--\n",
    "negative depths": table(NAMES, [-DEPTH, *light().T]),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "latin-1"])
@pytest.mark.parametrize("text", DIALECTS.values(), ids=list(DIALECTS))
def test_a_dialect_is_read_as_what_it_says(text, encoding, tmp_path):
    path = tmp_path / "cast.csv"
    path.write_text(text, encoding=encoding)
    np.testing.assert_allclose(kd_of(path), KD, rtol=1e-5)


def test_odv_names_a_station_once(tmp_path):
    rows = [["Station", *NAMES]]
    for name, factor in (("A", 1.0), ("B", 2.0)):
        for i, (z, seen) in enumerate(zip(DEPTH, light(factor * DEPTH), strict=True)):
            rows.append([name if i == 0 else "", f"{z:g}", *(f"{v:.8g}" for v in seen)])
    path = tmp_path / "odv.txt"
    path.write_text("//<Creator>me</Creator>\n" + "\n".join("\t".join(r) for r in rows) + "\n")
    casts = read_casts(path)
    assert [cast.source.rsplit(":")[-1] for cast in casts] == ["A", "B"]
    for cast, factor in zip(casts, (1.0, 2.0), strict=True):
        found = fit_profile(cast, depth_range=(0.0, 30.0)).quantities["Kd"].value
        np.testing.assert_allclose(found, factor * KD, rtol=1e-4)


def test_decimal_commas_between_commas_are_told(tmp_path):
    path = tmp_path / "cast.csv"
    path.write_text(table(NAMES, COLUMNS, ",", ","))
    with pytest.raises(ValueError, match="Decimal commas need ; or tabs"):
        read_cast(path)


def test_the_table_of_one_sensor_says_what_is_missing(tmp_path):
    path = tmp_path / "hp.tsv"
    path.write_text("SN\tINTTIME(ED)\tSAMPLE(DELAY)\tED(412.06)\n1\t64\t0\t1.5\n")
    with pytest.raises(ValueError, match=r"one sensor \(ED\) as SatCon writes it"):
        read_cast(path)


def test_a_renamed_column_keeps_the_unit_in_its_name(tmp_path):
    path = tmp_path / "cast.csv"
    path.write_text(table(["z (m)", "irr (uW cm-2 nm-1)"], [DEPTH, 100 * light()[:, 1]]))
    reading = Reading(columns={"depth": "z (m)", "Ed_490": "irr (uW cm-2 nm-1)"})
    raw = raw_casts(path, reading)[0]
    assert raw.units == {"depth": "m", "Ed_490": "uW cm-2 nm-1"}
    np.testing.assert_allclose(kd_of(path, reading), KD[1], rtol=1e-5)
    np.testing.assert_allclose(read_cast(path, reading).Ed[:, 0], light()[:, 1], rtol=1e-6)


def test_bands_that_differ_by_tenths_are_one_band(tmp_path):
    path, names = tmp_path / "cast.csv", ["depth [m]"]
    names += [f"Ed_{nm - 0.1:g} [W m-2 nm-1]" for nm in BANDS]
    names += [f"Lu_{nm + 0.1:g} [W m-2 nm-1 sr-1]" for nm in (412, 490, 683)]
    upward = 0.005 * light()
    path.write_text(table(names, [DEPTH, *light().T, *upward.T]))
    cast = read_cast(path)
    assert np.isfinite(cast.Lu).all(axis=0).tolist() == [True, True, False]
    (reason,) = cast.counts
    assert reason == "bands of Lu without a band of Ed within 5 nm (683.1 nm)"
    found = fit_profile(cast, depth_range=(0.0, 30.0)).quantities["KLu"].value
    np.testing.assert_allclose(found[:2], KD[:2], rtol=1e-3)


@pytest.mark.parametrize(
    ("unit", "factor", "base"),
    [
        ("uE cm-2 s-1", 1e4, "umol m-2 s-1"),
        ("uE/cm^2/s", 1e4, "umol m-2 s-1"),
        ("µmol photons m⁻² s⁻¹", 1.0, "umol m-2 s-1"),
        ("microMoleQuanta/m^2/sec", 1.0, "umol m-2 s-1"),
        ("mol m-2 d-1", 1e6 / 86400, "umol m-2 s-1"),
        ("quanta cm-2 s-1", 1e10 / 6.02214076e23, "umol m-2 s-1"),
        ("W m-2", 1.0, "W m-2"),
    ],
)
def test_par_comes_in_the_unit_that_its_header_states(unit, factor, base, tmp_path):
    assert par_factor(unit) == (pytest.approx(factor, rel=1e-12), base)
    path = tmp_path / "cast.sb"
    fields = "EsPAR,depth,Ed490,EdPAR"
    head = [
        "/begin_header", "/delimiter=comma", "/missing=-999", f"/fields={fields}",
        f"/units={unit},m,uW/cm^2/nm,{unit}", "/end_header",
    ]  # fmt: skip
    par = 1700.0 / factor * np.exp(-0.09 * DEPTH)
    rows = [f"9,{z:g},{e:.8g},{p:.8g}" for z, e, p in zip(DEPTH, light()[:, 1], par, strict=True)]
    path.write_text("\n".join([*head, *rows]) + "\n")
    fit = fit_profile(read_cast(path))
    assert fit.quantities["PAR_0"].unit == base
    np.testing.assert_allclose(fit.quantities["PAR_0"].value, 1700.0, rtol=1e-3)
    np.testing.assert_allclose(fit.quantities["Z_eu"].value, np.log(100) / 0.09, rtol=1e-3)


def test_par_without_a_unit_gives_depths_alone_and_an_unknown_one_is_refused(tmp_path):
    path = tmp_path / "cast.csv"
    columns = [DEPTH, light()[:, 1], np.exp(-0.09 * DEPTH)]
    path.write_text("# units: depth=m, Ed_490=W m-2 nm-1\n" + table(
        ["depth", "Ed_490", "PAR"], columns))  # fmt: skip
    found = fit_profile(read_cast(path)).quantities
    assert "PAR_0" not in found
    np.testing.assert_allclose(found["Z_10"].value, np.log(10) / 0.09, rtol=1e-3)
    path.write_text(path.read_text().replace("nm-1\n", "nm-1, PAR=lux\n", 1))
    with pytest.raises(ValueError, match="PAR is in 'lux'"):
        read_cast(path)


@pytest.mark.parametrize("value", ["1e20", "9.96921e36", "99999"])
def test_fill_values_are_masked_and_counted(value, tmp_path):
    path = tmp_path / "cast.csv"
    lines = table(NAMES, COLUMNS).splitlines()
    for row in (7, 8, 30):
        cells = lines[row].split(",")
        lines[row] = ",".join([*cells[:2], value, cells[3]])
    path.write_text("\n".join(lines) + "\n")
    cast = read_cast(path)
    assert cast.counts == {"fill values or light above 50 W m-2 nm-1": 3}
    np.testing.assert_allclose(kd_of(path), KD, rtol=1e-5)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("µW/(cm² nm)", 0.01), ("W m⁻² nm⁻¹", 1.0), ("W m**-2 nm**-1", 1.0),
        ("uW cm^{-2} nm^{-1}", 0.01), ("µW/(sr cm² nm)", 0.01), ("mW m-2 sr-1 nm-1", 1e-3),
        ("W/m^2/um/sr", 1e-3), ("mW cm-2 um-1", 0.01), ("nW/cm^2/nm", 1e-5),
        ("microwatts/cm^2/nm", 0.01), ("watt/m^2/nanometer", 1.0), ("W per sq m per nm", 1.0),
        ("1e-2 W m-2 nm-1", 0.01), ("uW/cm^2 nm", 0.01), ("kW/m2/nm", 1e3),
        ("MW m-2 nm-1", None), ("W m-2 nm", None), ("W m-3", None), ("uE/m^2/s", None),
        ("quanta/cm^2/s/nm", None), ("", None), ("lux", None),
    ],
)  # fmt: skip
def test_units_as_they_are_spelt(unit, factor):
    assert irradiance_factor(unit) == factor


def test_units_of_depth_and_in_comments():
    assert [depth_kind(u) for u in ("Meters (m)", "M", "DECIBAR", "cm", "ft", "kPa")] == [
        "m", "m", "dbar", None, None, None,
    ]  # fmt: skip
    assert irradiance_units_in("Ed in µW/(cm² nm), Lu likewise") == ["µW/(cm² nm)"]


def test_rows_sorted_by_depth_are_put_back_in_order_by_their_time(tmp_path):
    """Down and up in one file, sorted by depth: the time column says which way each row belongs
    to."""
    way = np.concatenate([DEPTH, DEPTH[::-1]])
    seen = np.concatenate([light(), 1.3 * light(DEPTH[::-1])])
    order = np.argsort(way, kind="stable")
    path = tmp_path / "cast.csv"
    columns = [np.arange(80.0)[order], way[order], *seen[order].T]
    path.write_text(table(["time", *NAMES], columns))
    # The deepest sample may count to either way.
    assert min(np.bincount(read_cast(path).segment)) >= 39
