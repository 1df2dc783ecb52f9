"""What the commands tell: help with examples, names of cameras, templates to fill in."""

import re

import numpy as np
import pytest
import typer.main

import oceaninv as oi
from fitting import fit_profile
from fitting.commands import main as cli
from fitting.files.cast_file import read_cast
from fitting.images.photo_csv import read_photo
from tests.fitting.images.test_photo_csv import PHOTO

COMMANDS = typer.main.get_command(cli.app).commands


def words(text):
    """Text without the borders and line breaks that the help is drawn with."""
    return re.sub(r"[\s│╭╮╰╯─]+", " ", text)


def test_the_help_states_the_exit_status_and_every_command_has_an_example(capsys):
    assert cli.run(["--help"]) == 0
    shown = words(capsys.readouterr().out)
    assert "Exit status: 0 done, 1 check found problems, 2 wrong options, 3 bad input." in shown
    assert "--install-completion" in shown
    for name, command in COMMANDS.items():
        assert cli.run([name, "--help"]) == 0
        assert f"Example: oceaninv {name}" in words(capsys.readouterr().out)
        # Whatever the example asks for, there are such options.
        options = {option for parameter in command.params for option in parameter.opts}
        assert set(re.findall(r" (--?[a-z][\w-]*)", command.epilog)) <= options


def test_exit_status_is_as_the_help_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.csv").write_text("# flash: fired\n" + PHOTO)
    assert cli.run(["cameras"]) == 0
    assert cli.run(["check", "a.csv"]) == 1
    assert cli.run(["fit-profile", "a.csv", "--no-such-option"]) == 2
    assert cli.run(["fit-profile", "absent.csv"]) == 3


@pytest.mark.parametrize(
    ("name", "panels"),
    [
        ("fit-profile", {"Model", "How to read the files", "Output", "Sun and camera"}),
        ("fit-photo", {"Model", "Sun and camera", "Picture without water", "Range map", "Output"}),
        ("render", {"Model", "Animation", "Output"}),
    ],
)
def test_options_are_grouped(name, panels):
    found = {p.rich_help_panel for p in COMMANDS[name].params if p.opts[0].startswith("-")}
    assert found - {None} == panels


def test_cameras_are_listed_and_known_by_any_letters(tmp_path, capsys):
    assert cli.run(["cameras"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert listed == ["generic", *oi.spectrum.camera_names()]
    right = np.asarray(oi.spectrum.camera_response("Nikon D850").values)
    for name in ("nikon d850", " NIKON  D850 "):
        np.testing.assert_array_equal(oi.spectrum.camera_response(name).values, right)
    path = tmp_path / "dive.csv"
    path.write_text(PHOTO)
    for name in ("generic", "Generic", "GENERIC"):
        assert read_photo(path, 5.0, camera=name)[0].response is None
    assert "# camera: Nikon D850" in PHOTO
    path.write_text(PHOTO.replace("Nikon D850", "nikon d850"))
    np.testing.assert_array_equal(read_photo(path, 5.0)[0].response.values, right)
    with pytest.raises(ValueError, match=r"Near it: Nikon D850.*Write generic for a camera"):
        read_photo(path, 5.0, camera="Nikon D85")


def test_a_template_is_what_the_command_reads(tmp_path, capsys):
    cast, photo = tmp_path / "cast.csv", tmp_path / "photo.csv"
    for kind, path in (("cast", cast), ("photo", photo)):
        assert cli.run(["template", kind]) == 0
        shown = capsys.readouterr().out
        assert cli.run(["template", kind, "-o", str(path)]) == 0
        assert path.read_text() == shown
        path.write_text("filled in")
        assert cli.run(["template", kind, "-o", str(path)]) == 3
        assert f"{path} exists: name another file" in capsys.readouterr().err
        assert path.read_text() == "filled in"
        path.write_text(shown)
        assert cli.run(["template", kind, "-o", str(tmp_path / "no" / "file.csv")]) == 3
        assert "cannot write" in capsys.readouterr().err
    fit = fit_profile(read_cast(cast))
    np.testing.assert_allclose(fit.quantities["Kd"].value, [0.04, 0.05, 0.08], rtol=1e-3)
    found, clipped = read_photo(photo, 5.0)
    assert (len(found.charts), len(found.backgrounds), clipped) == (2, 1, 0)
    assert (found.response, found.solar_zenith, found.azimuth, found.lamp) == (None, 40, 90, False)
    assert cli.run(["check", str(photo)]) == 0, capsys.readouterr().out


@pytest.mark.slow
def test_a_template_of_a_photograph_can_be_fitted(tmp_path, capsys):
    path = tmp_path / "photo.csv"
    assert cli.run(["template", "photo", "-o", str(path)]) == 0
    assert cli.run(["fit-photo", str(path), "--depth", "5±1", "-o", str(tmp_path / "fit")]) == 0
    shown = capsys.readouterr().out
    assert "search: converged" in shown
    assert "does not describe" not in shown
    assert f"camera of {path}: generic (mean of 50" in shown
