"""No file that oceaninv did not write is ever replaced, and none is ever half-written."""

import itertools
import os
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import oceaninv
from fitting import Profile, fit_profile
from fitting.commands import main as cli
from fitting.report import netcdf_file
from fitting.report.spectra_table import write_spectra
from oceaninv.foundation.atomic_write import atomic_write, checksum_line, is_own, with_checksum
from tests.fitting.images.test_photo_csv import PHOTO
from tests.fitting.images.test_photograph_file import IMAGE, write
from tests.paths import SCENES

CAST = "# units: depth=m, Ed_490=W m-2 nm-1\ndepth,Ed_490\n" + "\n".join(
    f"{z},{np.exp(-0.1 * z):.6g}" for z in np.linspace(0.5, 20.0, 40)
)
SCENE = SCENES / "green_coast.toml"
CHART = ["--chart", "a DGK18 2 1,1 14,1 14,10 1,10"]


def _inputs(folder):
    """One file of every kind that a command reads, some under names of results."""
    write(folder / "dive.png", IMAGE, "uint16")
    np.savez(folder / "range.npz", np.ones(IMAGE.shape[:2]))
    (folder / "dive.csv").write_text(PHOTO)
    (folder / "chart.csv").write_text(PHOTO)
    (folder / "scene.toml").write_text(SCENE.read_text())
    for name in ("cast.csv", "cast.nc", "cast.png", "Güte 1.csv", "Güte 1.nc"):
        (folder / name).write_text(CAST)
    for ending in (".html", "_restored.exr", "_restored.png", "_residual.png", "_patches.png"):
        (folder / f"dive{ending}").write_text("somebody's")
    return {path: path.read_bytes() for path in folder.iterdir()}


def _commands(name):
    """(arguments without output, option, endings of what is written) of every kind of output."""
    profile = ["fit-profile", name("cast.csv"), "--kd-only"]
    photo = ["fit-photo", name("dive.csv"), "--depth", "5"]
    picture = ["--picture", name("dive.png"), "--range-map", name("range.npz")]
    yield profile, "-o", [name("cast"), name("cast.nc"), name("Güte 1")]
    yield profile, "--table", [name("cast.csv"), name("dive.csv"), name("chart.csv")]
    yield [*photo, "--report"], "-o", [name("dive"), name("cast")]
    yield [*photo, *picture], "-o", [name("dive")]
    yield ["read-charts", name("dive.png"), *CHART], "-o", [name("dive"), name("chart")]
    yield ["render", name("scene.toml")], "-o", [name("dive.png"), name("dive_restored.exr")]
    yield ["trade", name("scene.toml")], "-o", [name("dive"), name("cast")]
    yield ["trade", "--fit", name("cast.csv")], "-o", [name("dive"), name("cast")]


def _spellings(folder):
    """Ways to name a file of `folder`: as it is, absolute, by a detour, by a link to the folder."""
    yield lambda name: name
    yield lambda name: str(folder / name)
    yield lambda name: f"../{folder.name}/./{name}"
    yield lambda name: str(folder.parent / "a link" / name)


def test_no_command_replaces_an_input_or_a_file_of_somebody_else(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "ünder water"
    folder.mkdir()
    (tmp_path / "a link").symlink_to(folder)
    monkeypatch.chdir(folder)
    before = _inputs(folder)
    tried = 0
    # The way to spell the output and the way to spell the inputs are independent.
    for ours, theirs in itertools.product(_spellings(folder), repeat=2):
        for (command, option, _), (*_, outputs) in zip(
            _commands(ours), _commands(theirs), strict=True
        ):
            for output in outputs:
                assert cli.run([*command, option, output]) == 3, (command, output)
                said = capsys.readouterr().err
                assert "would replace the input" in said or "oceaninv did not write it" in said
                tried += 1
    assert tried >= 200
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_hard_and_symbolic_links_to_an_input_are_not_replaced(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("cast.csv").write_text(CAST)
    Path("soft.csv").symlink_to("cast.csv")
    os.link("cast.csv", "hard.csv")
    for name in ("soft.csv", "hard.csv"):
        assert cli.run(["fit-profile", "cast.csv", "--kd-only", "--table", name]) == 3
        assert "would replace the input cast.csv" in capsys.readouterr().err
    assert Path("soft.csv").is_symlink()
    assert Path("cast.csv").read_text() == CAST


def test_results_get_names_of_their_own_and_may_be_renewed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("cast.csv").write_text(CAST)
    command = ["fit-profile", "cast.csv", "--kd-only", "--table", "spectra.csv"]
    assert cli.run(command) == 0
    names = {"cast.csv", "cast_fit.nc", "cast_fit.png", "spectra.csv"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert cli.run(command) == 0  # what oceaninv wrote it may write again
    # A table that oceaninv wrote is an input, too, where the command reads it.
    assert cli.run(["fit-profile", "spectra.csv", "--table", "spectra.csv"]) == 3
    capsys.readouterr()
    Path("spectra.csv").write_text(Path("spectra.csv").read_text() + "# my own remark\n")
    assert cli.run(command) == 3
    assert "spectra.csv exists and oceaninv did not write it, or it was edited" in (
        capsys.readouterr().err
    )
    assert cli.run([*command, "--overwrite"]) == 0
    assert "my own remark" not in Path("spectra.csv").read_text()


def test_an_archive_replaces_neither_its_inputs_nor_files_of_others(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("a.csv", "b.csv"):
        Path(name).write_text(CAST)
    Path("kd").mkdir()
    Path("kd/a.csv.kd.nc").write_text("somebody's")
    os.utime("kd/a.csv.kd.nc", (0, 0))
    assert cli.run(["fit-profile", "a.csv", "b.csv", "-o", "kd"]) == 3
    assert "kd/a.csv.kd.nc exists and oceaninv did not write it" in capsys.readouterr().err
    assert Path("kd/a.csv.kd.nc").read_text() == "somebody's"
    Path("a.csv.kd.nc").write_text(CAST)
    os.utime("a.csv.kd.nc", (0, 0))
    assert cli.run(["fit-profile", "a.csv", "a.csv.kd.nc", "-o", "."]) == 3
    said = capsys.readouterr().err
    assert "would replace the input a.csv.kd.nc: name another folder with -o" in said


def test_python_does_not_replace_files_of_others_either(tmp_path):
    depth = np.linspace(0.5, 20.0, 40)
    fit = fit_profile(Profile(depth, [490.0], np.exp(-0.1 * depth)[:, None]))
    for name, save in (
        ("fit.png", lambda path, **more: fit.report(path, **more)),
        ("fit.nc", lambda path, **more: netcdf_file.save(path, fit, **more)),
        ("fit.sb", lambda path, **more: write_spectra(path, fit, **more)),
        ("fit.csv", lambda path, **more: write_spectra(path, fit, **more)),
    ):
        path = tmp_path / name
        path.write_text("somebody's")
        with pytest.raises(ValueError, match="overwrite=True"):
            save(path)
        assert path.read_text() == "somebody's"
        save(path, overwrite=True)
        assert is_own(path)
        save(path)
    with pytest.raises(ValueError, match=r"ends in \.png"):
        fit.report(tmp_path / "fit")
    # Another program that adds to a result keeps its attributes; the picture is what it was.
    with xr.open_dataset(tmp_path / "fit.nc") as data:
        assert data.attrs["history"].endswith(f"Z: written by oceaninv {oceaninv.__version__}")


def test_a_failed_write_keeps_the_old_file_and_no_temporary(tmp_path):
    target = tmp_path / "result.txt"
    target.write_text(with_checksum(f"# {checksum_line()}\nold\n"))

    def fail():
        with atomic_write(target) as temporary:
            temporary.write_text("half")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fail()
    assert target.read_text().endswith("old\n")
    assert [p.name for p in tmp_path.iterdir()] == ["result.txt"]


def test_a_link_is_followed(tmp_path):
    own = with_checksum(f"# {checksum_line()}\nold\n")
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "result.txt").write_text(own)
    (tmp_path / "result.txt").symlink_to(tmp_path / "there" / "result.txt")
    with atomic_write(tmp_path / "result.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "result.txt").is_symlink()
    assert (tmp_path / "there" / "result.txt").read_text() == "new"


@pytest.mark.parametrize("text", ["", "somebody's", "0" * 16, f"{checksum_line()}\n0\n"])
def test_a_file_without_the_mark_and_its_checksum_is_not_ours(text, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text)
    assert not is_own(path)
    path.write_bytes(with_checksum(f"{checksum_line()}\n{text}\n").encode())
    assert is_own(path)
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert is_own(path)
