"""Every file that a command writes says which version, command and input files made it."""

import datetime
import hashlib
import json
from pathlib import Path

import h5netcdf
import jax
import numpy as np
import OpenImageIO as oiio
import pytest

import fitting
import oceaninv
from fitting.commands import main as cli
from fitting.files.csv_sheet import read_sheet
from fitting.images.photo_csv import read_photo
from oceaninv.foundation import provenance
from oceaninv.foundation.atomic_write import is_own
from tests.fitting.commands.test_output_files import CAST
from tests.fitting.files.test_cast_file import argo
from tests.fitting.images.test_chart_reading import CORNERS, painted
from tests.fitting.images.test_photo_csv import PHOTO
from tests.fitting.images.test_photograph_file import IMAGE, write
from tests.paths import SCENES


def digest(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def test_the_version_is_said(capsys):
    assert cli.run(["--version"]) == 0
    assert capsys.readouterr().out == f"oceaninv {oceaninv.__version__}\n"
    assert fitting.__version__ == oceaninv.__version__ == provenance.version() == "0.2.0"


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("/home/me/dives/cast.csv", "cast.csv"),
        ("~/dives/cast.csv", "cast.csv"),
        ("/home/me/my dives/cast 2.csv", "cast 2.csv"),
        ("/home/me/kd/", "kd"),
        ("C:\\Users\\me\\cast.csv", "cast.csv"),
        ("-o/home/me/kd", "-okd"),
        ("--output=/home/me/my dives/kd", "--output=kd"),
        ("/a/one.csv; /b/two.csv", "one.csv; two.csv"),
        ("/a/one.csv and 2 more", "one.csv and 2 more"),
        ("A /home/me/chart.csv 4.65 1,2 3,4", "A chart.csv 4.65 1,2 3,4"),
        ("dives/cast.csv", "dives/cast.csv"),
        ("../cast.csv", "../cast.csv"),
        ("tcp://127.0.0.1:8786", "tcp://127.0.0.1:8786"),
        ("W/m^2/nm", "W/m^2/nm"),
        ("cdom=0.12+-0.01", "cdom=0.12+-0.01"),
    ],
)
def test_folders_of_absolute_paths_are_left_out(given, kept):
    assert provenance.without_folders(given) == kept


def test_what_a_block_records_ends_with_it(tmp_path):
    path = tmp_path / "a\nb.csv"
    path.write_text("a")
    with provenance.recording(provenance.Provenance(("x\ny",))):
        provenance.record_inputs([path, path, tmp_path / "absent"])
        assert provenance.current().inputs == ((path.name, digest(path)),)
        assert provenance.current().lines[2:] == [
            "command_line: oceaninv 'x y'",
            f"input_files: a b.csv (SHA-256 {digest(path)})",
        ]
    assert provenance.current() == provenance.Provenance()
    assert provenance.current().lines[0] == "oceaninv_version: 0.2.0"
    assert len(provenance.current().lines) == 2


def test_the_date_is_now_or_the_one_that_the_environment_sets(monkeypatch):
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    before = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    said = datetime.datetime.fromisoformat(provenance.date_created())
    assert before <= said <= datetime.datetime.now(datetime.UTC)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1577934245")
    assert provenance.current().facts["date_created"] == "2020-01-02T03:04:05Z"
    assert provenance.current().history == "2020-01-02T03:04:05Z: written by oceaninv 0.2.0"
    for wrong in ("yesterday", "", "1e9", "9" * 30):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", wrong)
        with pytest.raises(ValueError, match="whole seconds since 1970"):
            provenance.date_created()


def facts_of(path):
    """The provenance that a file of any kind states."""
    if path.suffix == ".nc":
        with h5netcdf.File(path) as data:
            written, made = data.attrs["history"].split(": ", 1)
            assert written == data.attrs["date_created"]
            assert made.startswith("written by oceaninv 0.2.0: oceaninv ")
            return dict(data.attrs)
    if path.suffix == ".csv":
        return read_sheet(path).header
    if path.suffix in (".png", ".exr", ".tif"):
        spec = oiio.ImageInput.open(str(path)).spec()
        if note := spec.getattribute("ImageDescription"):
            return json.loads(note)
        lines = spec.getattribute("Comment").splitlines()
        return dict(line.split(": ", 1) for line in lines)
    text = path.read_text()
    names = ("oceaninv_version", "date_created", "command_line", "input_files")
    if path.suffix == ".html":
        cut = "</td><td style='text-align:left'>"
        return {n: text.split(n.replace("_", " ") + cut)[1].split("</td>")[0] for n in names}
    return {n: text.split(f"{n}: ")[1].splitlines()[0] for n in names}


def commands(folder):
    """(arguments, inputs, outputs)."""
    profile = ["fit-profile", str(folder / "cast.csv"), "--kd-only"]
    for table in ("t.csv", "t.sb"):
        outputs = [f"fit{table}.nc", f"fit{table}.png", table]
        stem = str(folder / f"fit{table}")
        yield [*profile, "-o", stem, "--table", str(folder / table)], ["cast.csv"], outputs
    corners = " ".join(f"{x},{y}" for x, y in CORNERS)
    chart = ["--chart", f"A ColorChecker24 2 {corners}", "--encoding", "linear"]
    yield (
        ["read-charts", str(folder / "chart.png"), *chart, "-o", str(folder / "charts")],
        ["chart.png"],
        ["charts.csv", "charts_patches.png"],
    )
    for name in ("a.png", "a.exr", "a.tif"):
        scene = ["render", str(folder / "scene.toml"), "--width", "8", "--bands", "3"]
        yield [*scene, "-o", str(folder / name)], ["scene.toml"], [name]


def test_every_result_names_version_command_and_inputs(tmp_path, capsys):
    (tmp_path / "cast.csv").write_text(CAST)
    (tmp_path / "scene.toml").write_text((SCENES / "green_coast.toml").read_text())
    write(tmp_path / "chart.png", painted()[0].values, "uint16")
    for arguments, inputs, outputs in commands(tmp_path):
        assert cli.run(arguments) == 0, capsys.readouterr().err
        for name in outputs:
            facts = facts_of(tmp_path / name)
            assert facts["oceaninv_version"] == "0.2.0", name
            assert len(facts["date_created"]) == len("2020-01-02T03:04:05Z"), name
            assert facts["command_line"].startswith(f"oceaninv {arguments[0]} {inputs[0]} "), name
            assert str(tmp_path) not in facts["command_line"]
            for path in inputs:
                assert f"{path} (SHA-256 {digest(tmp_path / path)})" in facts["input_files"], name
            assert is_own(tmp_path / name)
            assert str(tmp_path).encode() not in (tmp_path / name).read_bytes(), name


@pytest.mark.slow
def test_pages_and_restored_pictures_name_them_too(tmp_path, capsys):
    write(tmp_path / "dive.png", IMAGE, "uint16")
    np.savez(tmp_path / "range.npz", np.full(IMAGE.shape[:2], 3.0))
    (tmp_path / "dive.csv").write_text(PHOTO)
    arguments = ["fit-photo", str(tmp_path / "dive.csv"), "--depth", "5", "--report"]
    arguments += ["--picture", str(tmp_path / "dive.png")]
    arguments += ["--range-map", str(tmp_path / "range.npz"), "-o", str(tmp_path / "water")]
    assert cli.run(arguments) == 0, capsys.readouterr().err
    made = [path for path in tmp_path.iterdir() if path.name.startswith("water")]
    assert len(made) == 6
    for path in made:
        facts = facts_of(path)
        assert facts["command_line"].startswith("oceaninv fit-photo dive.csv --depth 5 --report")
        for name in ("dive.csv", "dive.png", "range.npz"):
            assert f"{name} (SHA-256 {digest(tmp_path / name)})" in facts["input_files"], path
        assert str(tmp_path).encode() not in path.read_bytes(), path


def test_readings_with_their_provenance_are_read_as_before(tmp_path):
    (tmp_path / "a.csv").write_text(PHOTO)
    (tmp_path / "b.csv").write_text("# command_line: oceaninv x --light lamp\n" + PHOTO)
    (one, _), (two, _) = (read_photo(tmp_path / name, 5.0) for name in ("a.csv", "b.csv"))
    np.testing.assert_array_equal(one.charts[0].values, two.charts[0].values)
    assert one.lamp == two.lamp


def test_results_of_archives_are_equal_bit_by_bit(tmp_path, monkeypatch, capsys):
    """Whatever the folder and the company of a cast is, and whether its run was resumed."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    for i in range(3):
        (tmp_path / f"{i}.csv").write_text(CAST.replace("5,", f"{5 + i},"))
    paths = [str(tmp_path / f"{i}.csv") for i in range(3)]
    options = ["--from", "1", "--columns", "Ed_490=Ed_490"]
    one, two = tmp_path / "one", tmp_path / "two"
    with jax.enable_x64(True):
        assert cli.run(["fit-profile", *paths, "-o", str(one), *options]) == 0
        assert cli.run(["fit-profile", *paths[:2], *options, "--output", str(two)]) == 0
        assert cli.run(["fit-profile", *options, *paths, "--overwrite", f"-o{two}"]) == 0
    assert "2 files were done before" in capsys.readouterr().out
    for i in range(3):
        name = f"{i}.csv.kd.nc"
        assert (one / name).read_bytes() == (two / name).read_bytes()
        assert str(tmp_path).encode() not in (one / name).read_bytes()
        facts = facts_of(one / name)
        assert facts["command_line"] == "oceaninv fit-profile --from 1 --columns Ed_490=Ed_490"
        assert facts["input_files"] == f"{i}.csv (SHA-256 {digest(paths[i])})"


def test_place_time_and_float_are_kept_by_one_cast_and_by_archives(tmp_path, capsys):
    path = argo(tmp_path, casts=1)
    assert cli.run(["fit-profile", str(path), "--kd-only", "-o", str(tmp_path / "one")]) == 0
    with h5netcdf.File(tmp_path / "one.nc") as data:
        assert data.attrs["featureType"] == "profile"
        assert data.attrs["latitude"] == 35.0
        assert data.attrs["longitude"] == 20.5
        assert data.attrs["time"] == "2020-01-01T06:00:00Z"
        assert data.attrs["platform"] == "6903247"
        assert data.attrs["cycle"] == 112
        assert data.attrs["source"] == path.name
        # What stands in the metadata as lists is over wavelength, too.
        facts = json.loads(data.attrs["metadata"])
        for name, fact in (
            ("depths_used", "depths_used"),
            ("deepest_used", "deepest_used_m"),
            ("dark_level", "dark_level"),
            ("relative_noise", "relative_noise"),
            ("noise_correlation_length", "noise_correlated_over_m"),
            ("runs_test_p", "runs_test_p"),
        ):
            assert data[name].dimensions == ("wavelength",)
            assert {"units", "long_name"} <= set(data[name].attrs)
            np.testing.assert_array_equal(data[name][:], facts[fact])
    (tmp_path / "plain.csv").write_text(CAST)
    many = [str(path), str(tmp_path / "plain.csv")]
    assert cli.run(["fit-profile", *many, "-o", str(tmp_path / "kd")]) == 0
    with h5netcdf.File(tmp_path / "kd" / f"{path.name}.kd.nc") as data:
        for name, value in (("latitude", 35.0), ("longitude", 20.5), ("time", 25567.25)):
            assert data[name].dimensions == ("cast",)
            assert data[name].attrs["standard_name"] == name
            assert data[name][:].tolist() == [value]
        assert data["cycle"][:].tolist() == [112]
        assert [bytes(v).decode() for v in data["platform"][:]] == ["6903247"]
    with h5netcdf.File(tmp_path / "kd" / "plain.csv.kd.nc") as data:
        assert not {"latitude", "time", "platform", "cycle"} & set(data.variables)
