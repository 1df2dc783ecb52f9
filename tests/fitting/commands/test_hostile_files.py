"""Damaged and hostile files at the command line: a sentence, code 3, nothing left behind."""

import numpy as np
import pytest

import fitting.commands.main as cli
from tests.fitting.images.test_photo_csv import PHOTO
from tests.fitting.images.test_photograph_file import IMAGE, broken, write

PICTURES = ["missing.png", "empty.png", "text.png", "cut.png", "one.png", "grey.png", "five.tif",
            "black.png", "white.png", "huge.png", "cut.exr", "nan.exr", "text.jpg", "text.nef",
            "a folder – ünder water"]  # fmt: skip
CHART = ["--chart", "a DGK18 2 1,1 14,1 14,10 1,10"]


def picture(folder, name):
    """A file of `tests.test_photographs.broken`, or one of the kinds that only appear here."""
    path = folder / name
    if name == "cut.exr":
        whole = write(folder / "whole.exr", np.tile(IMAGE, (20, 20, 1)), "half").read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
    elif name == "nan.exr":
        write(path, np.nan * IMAGE, "float")
    elif name == "text.jpg":
        path.write_text("no picture")
    elif name.startswith("a folder"):
        path.mkdir()
    else:
        return broken(folder, name)
    return path


def range_map(folder, name):
    """A range map that cannot be used."""
    path = folder / name
    if name == "empty.exr":
        path.write_bytes(b"")
    elif name == "cut.npz":
        np.savez(path, np.ones((12, 16)))
        path.write_bytes(path.read_bytes()[:200])
    elif name == "objects.npz":
        np.savez(path, np.array([{}, None], dtype=object))
    elif name == "words.npz":
        np.savez(path, np.array([["a", "b"]]))
    elif name == "many.npz":
        np.savez(path, a=np.ones((12, 16)), b=np.ones((12, 16)))
    elif name == "flat.npz":
        np.savez(path, np.ones(192))
    elif name == "infinite.npz":
        np.savez(path, np.full((12, 16), np.inf))
    elif name == "nan.exr":
        write(path, np.full((12, 16), np.nan), "float")
    elif name == "short.bin":
        path.write_bytes(b"16&12&1&1234")
    elif name == "words.bin":
        path.write_text("no map at all")
    elif name == "turned.npz":
        np.savez(path, np.ones((16, 12)))
    elif name == "8 bits.png":
        write(path, np.ones((12, 16)) * 0.5, "uint8")
    return path


def refused(arguments, capsys, folder):
    """The sentence of a command that must end with code 3 and leave `folder` as it was."""
    before = sorted(folder.iterdir())
    assert cli.run(arguments) == 3
    said = capsys.readouterr().err
    assert said.startswith("oceaninv: ")
    assert "Traceback" not in said
    assert len(said) > 30
    assert sorted(folder.iterdir()) == before
    return said


@pytest.mark.parametrize("name", PICTURES)
def test_no_command_takes_a_broken_picture(name, tmp_path, capsys):
    folder = tmp_path / "ein Bild – ünder water"
    folder.mkdir()
    path = picture(folder, name)
    stem = str(folder / "out")
    encoding = ["--encoding", "sRGB"] if name.endswith("jpg") else []
    for command in (["check", str(path)], ["read-charts", str(path), *CHART, "-o", stem]):
        assert name in refused([*command, *encoding], capsys, folder)


@pytest.mark.parametrize(
    "name",
    ["missing.exr", "empty.exr", "cut.npz", "objects.npz", "words.npz", "many.npz", "flat.npz",
     "infinite.npz", "nan.exr", "short.bin", "words.bin", "turned.npz", "8 bits.png"],
)  # fmt: skip
def test_no_command_takes_a_broken_range_map(name, tmp_path, capsys):
    photo = write(tmp_path / "photo.png", IMAGE, "uint16")
    readings = tmp_path / "charts.csv"
    readings.write_text(PHOTO)
    ranges = ["--range-map", str(range_map(tmp_path, name))]
    assert name in refused(["check", str(photo), *ranges], capsys, tmp_path)
    stem = ["-o", str(tmp_path / "out")]
    fit = ["fit-photo", str(readings), "--depth", "5", "--picture", str(photo)]
    assert name in refused([*fit, *ranges, *stem], capsys, tmp_path)
    assert name in refused(["read-charts", str(photo), *CHART, *ranges, *stem], capsys, tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no data"),
        ("\0" * 64, "NUL bytes"),
        (PHOTO[: PHOTO.index("0.3,0.01") + 2], "data row 2 has 8 values for 12 columns"),
        (PHOTO.split("chart,A", 1)[0], "holds no data"),
        (PHOTO.replace("0.4,0.5", "0.4,bright"), "'bright' is not a number"),
        (PHOTO.replace("0.4,0.5", "nan,nan").replace("0.2,0.3", ",").replace("0.2,0.4", "0,-1")
         .replace("0.2,nan", "nan,nan").replace(",0.1,,", ",nan,,").replace("0.05,", "nan,"),
         "readings are usable"),
        (PHOTO.replace(",0.5,2,", ",0.5,nan,").replace(",0.1,2,", ",0.1,,"), "distance of chart"),
        (PHOTO.replace(",90,", ",nan,"), "zenith"),
        (PHOTO.replace("0.01,0\n", "0.01,1\n"), "readings are usable"),
    ],
)  # fmt: skip
def test_no_fit_of_broken_readings(text, words, tmp_path, capsys):
    path = tmp_path / "Fotos – ünder water.csv"
    path.write_text(text, encoding="utf-8")
    command = ["fit-photo", str(path), "--depth", "5", "-o", str(tmp_path / "out")]
    assert words in refused(command, capsys, tmp_path)
