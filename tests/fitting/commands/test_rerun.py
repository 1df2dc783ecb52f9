"""`rerun` repeats a fit from its result, or says in one sentence why it does not."""

import functools
import hashlib
import re
import shutil

import h5netcdf
import jax
import numpy as np
import pytest

import fitting
from fitting.commands import main as cli
from fitting.commands import rerun
from tests.fitting.commands.test_output_files import CAST
from tests.fitting.images.test_photo_csv import PHOTO

SHA = re.compile(r"[0-9a-f]{64}")


def run(*arguments):
    return cli.run([str(argument) for argument in arguments])


@functools.cache
def _made(folder):
    (folder / "cast.csv").write_text(CAST)
    arguments = ["fit-profile", folder / "cast.csv", "--kd-only", "-o", folder / "fit"]
    assert run(*arguments, "--table", folder / "table.csv") == 0
    return folder


@pytest.fixture
def folder(tmp_path, tmp_path_factory, monkeypatch):
    """A folder with a cast, its fit (netCDF, picture) and a table, in which the test runs."""
    made = _made(tmp_path_factory.getbasetemp())
    work = tmp_path / "work"
    work.mkdir()
    for path in ("cast.csv", "fit.nc", "fit.png", "table.csv"):
        shutil.copy(made / path, work)
    monkeypatch.chdir(work)
    return work


def content(folder):
    """What the files of a folder hold, by their names in it."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def refused(folder, capsys, *arguments):
    """What `rerun` says where it writes nothing: one sentence, code 3."""
    before = content(folder)
    assert run("rerun", *arguments) == 3
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("oceaninv: ")
    assert said.err.count("\n") == 1
    assert "Traceback" not in said.err
    assert content(folder) == before
    return said.err


def changed(path, **attributes):
    with h5netcdf.File(path, "a") as file:
        for name, value in attributes.items():
            if value is None:
                del file.attrs[name]
            else:
                file.attrs[name] = value
    return path


def test_a_fit_is_repeated_into_a_file_of_its_own(folder, capsys):
    before = content(folder)
    assert run("rerun", "fit.nc") == 0
    said = capsys.readouterr()
    assert said.out.startswith("wrote fit_rerun.nc\nlargest relative difference of ")
    assert said.out.endswith(" variables: 0\n")
    assert content(folder).keys() - before.keys() == {"fit_rerun.nc"}
    assert {name: content(folder)[name] for name in before} == before
    # The new result names the fit, not its repetition, and can be repeated itself.
    with h5netcdf.File("fit.nc") as old, h5netcdf.File("fit_rerun.nc") as new:
        for name in ("command_line", "input_files", "metadata", "oceaninv_version"):
            assert new.attrs[name] == old.attrs[name]
    assert run("rerun", "fit_rerun.nc", "-o", "third.nc") == 0
    capsys.readouterr()
    assert "exists, and rerun replaces nothing" in refused(folder, capsys, "fit.nc")
    assert "no_folder does not exist" in refused(folder, capsys, "fit.nc", "-o", "no_folder/a.nc")


def test_a_difference_is_found_and_named(folder, capsys):
    with h5netcdf.File("fit.nc", "a") as file:
        file["Kd"][0] = file["Kd"][0] * (1 + 1e-9)
        file["Kd_low"][:] = np.nan
        file.create_variable("mine", ("wavelength",), float)
    assert run("rerun", "fit.nc") == 0
    said = capsys.readouterr().out
    assert "mine cannot be compared: the new result lacks it" in said
    assert "variables: inf, in Kd_low" in said
    with h5netcdf.File("fit.nc", "a") as file, h5netcdf.File("fit_rerun.nc") as new:
        file["Kd_low"][:] = new["Kd_low"][:]
    assert run("rerun", "fit.nc", "-o", "b.nc") == 0
    assert re.search(r"variables: 1e-09, in Kd\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("a", "b", "scale", "largest"),
    [
        ([1.0, -2.0, 0.0, np.nan], [1.0, -2.0, 0.0, np.nan], None, 0.0),
        ([1.0, -2.0], [1.0, 2.0], None, 2.0),
        ([1.0, 4.0], [0.0, 4.0], None, 1.0),
        ([np.nan], [1.0], None, np.inf),
        ([np.inf], [1.0], None, np.inf),
        ([1e-17], [-1e-17], 1.0, 2e-17),
        ([], [], None, 0.0),
    ],
)
def test_relative_differences(a, b, scale, largest):
    assert rerun.largest_difference(a, b, scale) == pytest.approx(largest, rel=1e-12)


def test_inputs_must_be_those_of_the_fit(folder, capsys):
    digest = hashlib.sha256((folder / "cast.csv").read_bytes()).hexdigest()
    text = (folder / "cast.csv").read_text()
    (folder / "cast.csv").write_text(text + "\n")
    new = hashlib.sha256((text + "\n").encode()).hexdigest()
    said = refused(folder, capsys, "fit.nc")
    assert "cast.csv has changed" in said
    assert SHA.findall(said) == [new, digest]
    (folder / "cast.csv").unlink()
    said = refused(folder, capsys, "fit.nc")
    assert "the input cast.csv" in said
    assert SHA.findall(said) == [digest]
    (folder / "data").mkdir()
    (folder / "data" / "cast.csv").write_text(text)
    assert run("rerun", "fit.nc", "--inputs", "data") == 0
    # The folder of the result is looked in, too.
    (folder / "data" / "fit.nc").write_bytes((folder / "fit.nc").read_bytes())
    assert run("rerun", "data/fit.nc") == 0
    assert (folder / "data" / "fit_rerun.nc").exists()


def test_another_version_is_said(folder, capsys):
    changed("fit.nc", oceaninv_version="0.1.7")
    assert run("rerun", "fit.nc") == 0
    assert "fit.nc was made by oceaninv 0.1.7; this is 0.2.0" in capsys.readouterr().out


CAST_ARGUMENT = "oceaninv fit-profile cast.csv --kd-only "


@pytest.mark.parametrize(
    ("attributes", "sentence"),
    [
        ({"command_line": None}, "names no command"),
        ({"command_line": 7}, "names no command"),
        ({"command_line": ""}, "no command of oceaninv"),
        ({"command_line": "oceaninv"}, "no command of oceaninv"),
        ({"command_line": "rm -rf ."}, "no command of oceaninv"),
        ({"command_line": "oceaninv fit-profile 'cast.csv"}, "No closing quotation"),
        ({"command_line": "oceaninv render cast.csv -o cast.csv"}, "made by 'render'"),
        ({"command_line": "oceaninv rerun fit.nc"}, "made by 'rerun'"),
        ({"command_line": "oceaninv --version"}, "made by '--version'"),
        ({"command_line": "oceaninv fit-profile --help"}, "cannot be repeated"),
        ({"command_line": "oceaninv fit-profile"}, "cannot be repeated"),
        ({"command_line": "oceaninv fit-profile --show-completion"}, "cannot be repeated"),
        ({"command_line": CAST_ARGUMENT + "--no-such-option"}, "cannot be repeated"),
        ({"command_line": CAST_ARGUMENT + "--from deep"}, "cannot be repeated"),
        ({"command_line": CAST_ARGUMENT + "--layers 9999999999"}, "layers"),
        ({"command_line": CAST_ARGUMENT + "other.csv"}, "no checksum of its input other.csv"),
        ({"command_line": CAST_ARGUMENT + "/dev/zero"}, "no checksum of its input zero"),
        ({"command_line": "oceaninv fit-profile '' "}, "no checksum of its input"),
        ({"command_line": "oceaninv fit-profile $(touch a);touch b"}, "no checksum"),
        ({"input_files": None}, "names its version and inputs"),
        ({"input_files": "cast.csv"}, "names with checksums wanted"),
        ({"input_files": "; cast.csv (SHA-256 12)"}, "names with checksums wanted"),
        ({"input_files": np.arange(9.0)}, "names its version and inputs"),
        ({"oceaninv_version": None}, "names its version and inputs"),
    ],
)
def test_a_hostile_result_ends_in_a_sentence(attributes, sentence, folder, capsys):
    changed("fit.nc", **attributes)
    assert sentence in refused(folder, capsys, "fit.nc")


@pytest.mark.parametrize(
    "options",
    [
        "-o fit --overwrite --table cast.csv",
        "-o cast --overwrite --table table.csv",
        "--output=../evil --table=../evil.csv",
        "-ofit.nc --overwrite",
    ],
)
def test_nothing_that_the_command_names_is_written(options, folder, capsys):
    changed("fit.nc", command_line=CAST_ARGUMENT + options)
    before = content(folder.parent)
    assert run("rerun", "fit.nc", "-o", "new.nc") == 0
    after = content(folder.parent)
    assert after.pop("work/new.nc")
    assert after == before


def test_no_address_that_the_command_names_is_called(folder, capsys):
    changed("fit.nc", command_line=CAST_ARGUMENT + "--cluster tcp://127.0.0.1:1")
    assert run("rerun", "fit.nc") == 0


def test_every_argument_that_names_a_file_is_known(monkeypatch, folder, capsys):
    """A command that gets a new one must not write where a result says."""
    found = set()
    for command in rerun._COMMANDS.values():
        found |= rerun.names_of_files(command)
    assert found == {"paths", "output", "table", "picture_of", "range_map", "intrinsics"}
    monkeypatch.setattr(rerun, "NOT_REPEATED", {"output": None})
    assert "does not know what table names" in refused(folder, capsys, "fit.nc")


def test_what_is_no_result_ends_in_a_sentence(folder, capsys):
    (folder / "empty.nc").write_bytes(b"")
    (folder / "text.nc").write_text("written by oceaninv")
    (folder / "cut.nc").write_bytes((folder / "fit.nc").read_bytes()[:3000])
    for name in ("empty.nc", "text.nc", "cut.nc"):
        assert "cannot be read as netCDF" in refused(folder, capsys, name)
    for name in ("absent.nc", "/dev/zero", "."):
        assert "does not exist or is no file" in refused(folder, capsys, name, "-o", "a.nc")
    with h5netcdf.File("other.nc", "w") as file:
        file.attrs.update({"oceaninv_version": "0.2.0", "input_files": ""})
    assert "no result of oceaninv" in refused(folder, capsys, "other.nc")
    with h5netcdf.File("fit.nc") as file:
        depth, light = np.asarray(file["depth"][:]), np.asarray(file["Ed_observed"][:])
    profile = fitting.Profile(depth, [490.0], light)
    fitting.fit_profile(profile).to_netcdf("python.nc")
    assert "no result of oceaninv that names" in refused(folder, capsys, "python.nc")


def mutated(good, rng):
    """The bytes with some of them changed, cut out, repeated, or the end missing."""
    content = bytearray(good)
    for _ in range(rng.integers(1, 6)):
        at, length = rng.integers(len(content)), rng.integers(1, 40)
        kind = rng.integers(4)
        if kind == 0:
            content[at] ^= 1 << rng.integers(8)
        elif kind == 1:
            content[at : at + length] = rng.bytes(len(content[at : at + length]))
        elif kind == 2:
            del content[at : at + length]
        else:
            content[at:at] = content[at : at + length]
    return bytes(content[: rng.integers(len(content))] if rng.integers(20) == 0 else content)


def fuzz(folder, capsys, count, seed):
    good, rng = (folder / "fit.nc").read_bytes(), np.random.default_rng(seed)
    # Most of the file is empty space and numbers: half of the mutations meet the attributes.
    at = good.index(b"command_line")
    codes = []
    for i in range(count):
        part = slice(at - 2000, at + 2000) if i % 2 else slice(None)
        whole = bytearray(good)
        whole[part] = mutated(good[part], rng)
        (folder / "bad.nc").write_bytes(whole)
        before = content(folder)
        codes.append(run("rerun", "bad.nc"))
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        (folder / "bad_rerun.nc").unlink(missing_ok=True)
        assert content(folder) == before
        assert codes[-1] in (0, 3), said.err
    return codes


def test_some_mutated_results(folder, capsys):
    codes = fuzz(folder, capsys, 12, 0)
    assert 3 in codes


@pytest.mark.slow
def test_many_mutated_results(folder, capsys):
    codes = fuzz(folder, capsys, 300, 1)
    assert 0 in codes
    assert codes.count(3) > 50


def worst(said):
    return float(re.search(r"variables: (\S+)", said)[1].rstrip(","))


@pytest.mark.slow
def test_ten_casts_ten_archives_and_ten_photographs_are_repeated(tmp_path, capsys):
    rng, found = np.random.default_rng(0), []
    depth = np.linspace(0.5, 20.0, 40)
    for i in range(10):
        noise = 1 + 0.02 * rng.standard_normal((40, 2))
        light = np.exp(-np.outer(depth, [0.05 + 0.01 * i, 0.1])) * noise
        rows = [f"{z:.6g},{a:.8g},{b:.8g}" for z, (a, b) in zip(depth, light, strict=True)]
        head = "# units: depth=m, Ed_*=W m-2 nm-1\ndepth,Ed_490,Ed_555\n"
        (tmp_path / f"cast{i}.csv").write_text(head + "\n".join(rows) + "\n")
        (tmp_path / f"photo{i}.csv").write_text(PHOTO.replace("0.5,2,90", f"0.5,{2 + i},90"))
    options = [[], ["--kd-only"], ["--layers", "2", "--kd-only"], ["--from", "1"], ["--smooth"]]
    with jax.enable_x64(True):
        for i in range(10):
            cast = tmp_path / f"cast{i}.csv"
            assert run("fit-profile", cast, *options[i % 5], "-o", tmp_path / f"c{i}") == 0
            photo, depth = tmp_path / f"photo{i}.csv", f"{3 + i}+-0.5"
            assert run("fit-photo", photo, "--depth", depth, "-o", tmp_path / f"p{i}") == 0
            found += [tmp_path / f"c{i}.nc", tmp_path / f"p{i}.nc"]
        many = [tmp_path / f"cast{i}.csv" for i in range(10)]
        assert run("fit-profile", *many, "--from", "1", "-o", tmp_path / "kd") == 0
        found += sorted((tmp_path / "kd").glob("*.kd.nc"))
        assert len(found) == 30
        capsys.readouterr()
        for path in found:
            assert run("rerun", path, "--inputs", tmp_path) == 0, capsys.readouterr().err
            assert worst(capsys.readouterr().out) <= 1e-12, path
