import subprocess
import sys

import jax
import numpy as np
import pytest
import xarray as xr

from fitting import Profile, fit_profile
from fitting.commands import main as cli
from fitting.report import netcdf_file
from tests.paths import SCENES

CAST = str(SCENES / "argo_6903247.csv")


def test_fit_profile_writes_a_cf_dataset_and_a_picture(tmp_path, capsys):
    assert cli.run(["fit-profile", CAST, "-o", str(tmp_path / "cast.nc"), "--kd-only"]) == 0
    shown = capsys.readouterr().out
    assert "mean from the surface to the depth of 10 % light" in shown
    assert "search: converged" in shown
    assert "self-shading, immersion: not applied" in shown
    assert {p.name for p in tmp_path.iterdir()} == {"cast.nc", "cast.png"}
    with xr.open_dataset(tmp_path / "cast.nc") as data:
        assert data.Kd.attrs["units"] == "m-1"
        assert data.Kd.attrs["standard_name"].startswith("volume_attenuation_coefficient")
        assert data.depth.attrs["positive"] == "down"
        # The float's Kd(490) in the blue eastern Mediterranean.
        assert 0.035 < float(data.Kd.sel(wavelength=490)) < 0.05
        assert bool(np.all(data.Kd_low < data.Kd) & np.all(data.Kd < data.Kd_high))


def uv_cast(folder, bands):
    """A cast of light that falls with exponents that the model of the water can hold."""
    depth = np.linspace(0.5, 20.0, 60)
    rows = np.exp(-np.array([[0.08 + 0.0004 * abs(nm - 480) for nm in bands]]) * depth[:, None])
    lines = ["# units: depth=m, Ed_*=W m-2 nm-1", ",".join(["depth", *(f"Ed_{b}" for b in bands)])]
    lines += [",".join(f"{v:.8g}" for v in (z, *row)) for z, row in zip(depth, rows, strict=True)]
    path = folder / "cast.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_kd_of_bands_beyond_all_tables_is_not_lost(tmp_path, capsys):
    """No table of phytoplankton reaches these bands: Kd is written all the same, with code 3."""
    path = uv_cast(tmp_path, (305, 325))
    assert cli.run(["fit-profile", str(path), "-o", str(tmp_path / "out")]) == 3
    printed = capsys.readouterr()
    assert "constituents need a band of 380-780 nm" in printed.err
    assert "wrote" in printed.out
    with xr.open_dataset(tmp_path / "out.nc") as data:
        np.testing.assert_allclose(data.Kd, [0.15, 0.142], rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bands", "left_out"),
    [
        ((340, 412, 490, 555), "340 nm"),
        ((412, 490, 555, 790), "790 nm"),
        ((305, 340, 380, 395, 412, 443, 490, 555, 665, 705, 750, 800), "305, 340, 800 nm"),
        ((380, 395, 412, 490, 555), None),
    ],
)
def test_bands_beyond_tables_count_where_a_table_holds_them(bands, left_out, tmp_path, capsys):
    path = uv_cast(tmp_path, bands)
    assert cli.run(["fit-profile", str(path), "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    if left_out is None:
        assert "fitted without" not in printed
    else:
        assert f"constituents were fitted without {left_out}" in printed
    with xr.open_dataset(tmp_path / "out.nc") as data:
        assert data.wavelength.values.tolist() == list(bands)
        assert np.all(np.isfinite(data.Kd))
    with xr.open_dataset(tmp_path / "out.nc", group="constituents") as data:
        assert data.wavelength.values.tolist() == [nm for nm in bands if 380 <= nm <= 780]


@pytest.mark.slow
def test_fit_profile_adds_constituents_as_a_group(tmp_path, capsys):
    assert cli.run(["fit-profile", CAST, "-o", str(tmp_path / "cast")]) == 0
    shown = capsys.readouterr().out
    # Three bands cannot tell three constituents apart, and no bare number pretends that they do.
    assert shown.count("not identifiable") == 3
    with xr.open_dataset(tmp_path / "cast.nc", group="constituents") as data:
        named = dict(zip(data.parameter.values, data.identifiable.values, strict=True))
        assert named["chlorophyll"] == 0
        assert float(data.Kd_490_low) < 0.043 < float(data.Kd_490_high)


@pytest.mark.slow
def test_fit_photo_reports_intervals_on_the_real_frame(tmp_path, capsys):
    charts = str(SCENES / "red_sea_charts.csv")
    code = cli.run(["fit-photo", charts, "--depth", "5+-2", "-o", str(tmp_path / "reef")])
    assert code == 0
    shown = capsys.readouterr().out
    assert "left out: 5 clipped rows" in shown
    assert "search: converged" in shown
    with xr.open_dataset(tmp_path / "reef.nc") as data:
        assert 0.02 < float(data.Kd_490_low) < float(data.Kd_490_high) < 0.15
        assert 0.15 < float(data.c_550_low) < float(data.c_550_high) < 0.6


@pytest.mark.slow
def test_a_fit_to_photographs_is_written_even_where_sampling_fails(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    charts = str(SCENES / "red_sea_charts.csv")
    command = ["fit-photo", charts, "--depth", "5+-2", "--sample", "-o", str(tmp_path / "reef")]
    assert cli.run(command) == 3
    printed = capsys.readouterr()
    assert "the posterior could not be found: NUTS needs blackjax" in printed.err
    assert "wrote" in printed.out
    with xr.open_dataset(tmp_path / "reef.nc") as data:
        assert 0.15 < float(data.c_550) < 0.6


@pytest.mark.slow
def test_photographs_at_two_depths_share_the_camera_by_their_exposures(tmp_path, capsys):
    text = (SCENES / "red_sea_charts.csv").read_text()
    files = []
    for name, exposure in (("a.csv", 1e-4), ("b.csv", 2e-4)):
        (tmp_path / name).write_text(f"# relative_exposure: {exposure}\n{text}")
        files.append(str(tmp_path / name))
    depths = ["--depth", "5+-2", "--depth", "8+-2"]
    assert cli.run(["fit-photo", *files, *depths, "-o", str(tmp_path / "two")]) == 0
    assert "left out: 10 clipped rows" in capsys.readouterr().out
    with xr.open_dataset(tmp_path / "two.nc") as data:
        names = data.parameter.values.tolist()
        assert {"gain_R", "exposure_0", "exposure_1", "depth_1", "chart_1_3"} <= set(names)
        assert "gain_0_R" not in names
        assert 0.15 < float(data.c_550) < 0.6


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["fit-profile", "nowhere.csv"], "nowhere.csv"),
        (["fit-profile", CAST, "--from", "400", "--to", "500"], "leaves 0 usable depths at 380 nm"),
        (["fit-profile", CAST, "--solar-zenith", "95"], "must lie in [0, 90)"),
        (
            ["fit-profile", CAST, "--tolerance", "0.1", "--transport", "two-stream"],
            "--tolerance chooses the transport",
        ),
        (["fit-photo", CAST, "--depth", "5"], "column 'kind'"),
        (["fit-photo", CAST, "--depth", "deep"], "--depth is 'deep'"),
        (["fit-photo", CAST, "--depth", "-3+-1"], "both positive"),
        (["fit-photo", CAST, "--depth", "5", "--know", "cdom=0.1"], "write name=value+-sd"),
        (["fit-photo", CAST, "--depth", "5", "--robust", "-1"], "--robust is -1"),
        (["fit-photo", CAST, CAST, *["--depth", "5"] * 3], "given 3 times for 2 photographs"),
        (["fit-photo", CAST, "--depth", "5", "--pixels"], "needs --picture and --range-map"),
        (
            ["fit-photo", CAST, CAST, "--depth", "5", "--picture", "a.png", "--range-map", "a.exr"],
            "--picture belongs to one photograph",
        ),
    ],
)
def test_bad_input_ends_with_a_sentence_and_code_3(
    arguments, sentence, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert cli.run(arguments) == 3
    printed = capsys.readouterr().err
    assert sentence in printed
    assert "Traceback" not in printed
    assert list(tmp_path.iterdir()) == []


def test_an_unwritable_output_leaves_nothing_behind(tmp_path, capsys):
    stem = tmp_path / "missing" / "cast"
    assert cli.run(["fit-profile", CAST, "-o", str(stem), "--kd-only"]) == 3
    assert "does not exist" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_survives_a_round_trip(tmp_path):
    depth = np.linspace(0.5, 20.0, 40)
    fit = fit_profile(
        Profile(depth, [490.0], np.exp(-0.1 * depth)[:, None]), depth_range=(0.0, 30.0)
    )
    netcdf_file.save(tmp_path / "fit.nc", fit)
    with xr.open_dataset(tmp_path / "fit.nc") as data:
        np.testing.assert_allclose(data.Kd, [0.1], rtol=1e-6)
        assert data.parameter.values.tolist() == ["Ed0_490", "Kd_490"]
        assert data.attrs["Conventions"] == "CF-1.11"


def test_the_console_script_sets_float64_before_any_array():
    code = (
        "import sys; sys.argv = ['oceaninv', 'fit-profile', 'nowhere.csv']\n"
        "import fitting.commands.main, jax\n"
        "try:\n    fitting.commands.main.main()\n"
        "except SystemExit as end:\n    print(end.code, jax.config.jax_enable_x64, "
        "bool(jax.config.jax_compilation_cache_dir))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["3", "True", "True"]
    assert "nowhere.csv" in done.stderr
    assert jax.config.jax_enable_x64


def test_check_reports_unmarked_clipping_alone(tmp_path, capsys):
    assert cli.run(["check", str(SCENES / "red_sea_charts.csv")]) == 0
    assert "3 of 6 patches are clipped below full scale" in capsys.readouterr().out
    unmarked = tmp_path / "charts.csv"
    text = (SCENES / "red_sea_charts.csv").read_text()
    unmarked.write_text("\n".join(
        line[:-1] + "0" if line.startswith("chart,A") else line for line in text.splitlines()
    ))  # fmt: skip
    assert cli.run(["check", str(unmarked)]) == 1
    assert "1 problem(s)" in capsys.readouterr().out
    assert cli.run(["check", str(tmp_path / "no picture.png")]) == 3
    assert "does not exist" in capsys.readouterr().err
