"""Photographs and range maps: what is read, and a sentence for all that is not."""

import dataclasses
import struct

import numpy as np
import OpenImageIO as oiio
import pytest

from fitting import read_photograph, read_range
from fitting.commands import main as cli
from fitting.images.photograph_file import pixels_of
from tests.paths import SCENES

RNG = np.random.default_rng(4)
IMAGE = RNG.uniform(0.05, 0.9, (12, 16, 3))
RANGE = RNG.uniform(1.0, 9.0, (12, 16))


def write(path, values, kind, **attributes):
    values = np.asarray(values)
    values = values[:, :, None] if values.ndim == 2 else values
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], kind)
    for name, value in attributes.items():
        spec.attribute(name, value)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(np.ascontiguousarray(values, dtype=np.float32))
    out.close()
    return path


@pytest.mark.parametrize(
    ("name", "kind", "step"),
    [
        ("a.exr", "float", 1e-6),
        ("half.exr", "half", 1e-3),
        ("ein Bild – ünder water.png", "uint16", 1 / 65535),
        ("a.tif", "uint16", 1 / 65535),
    ],
)
def test_linear_files_come_back_as_written(tmp_path, name, kind, step):
    photo = read_photograph(write(tmp_path / name, IMAGE, kind))
    np.testing.assert_allclose(photo.values, IMAGE, atol=step)
    assert photo.mask.all()
    assert photo.relative == 0
    assert photo.step == pytest.approx(0 if name.endswith("exr") else step / np.sqrt(12))


def test_eight_bits_and_jpeg_must_be_told(tmp_path):
    png = write(tmp_path / "a.png", IMAGE, "uint8")
    with pytest.raises(ValueError, match='8 bits: say encoding="linear"'):
        read_photograph(png)
    np.testing.assert_allclose(read_photograph(png, "linear").values, IMAGE, atol=1 / 500)
    curve = np.where(IMAGE <= 0.0031308, 12.92 * IMAGE, 1.055 * IMAGE ** (1 / 2.4) - 0.055)
    jpeg = write(tmp_path / "a.jpg", np.repeat(np.repeat(curve, 16, 0), 16, 1), "uint8")
    for encoding in (None, "linear"):
        with pytest.raises(ValueError, match="JPEG is not linear"):
            read_photograph(jpeg, encoding)
    photo = read_photograph(jpeg, "sRGB")
    assert photo.relative == 0.05
    block = photo.values.reshape(12, 16, 16, 16, 3).mean(axis=(1, 3))
    assert np.median(np.abs(block - IMAGE)) < 0.02
    with pytest.raises(ValueError, match="'gamma'"):
        read_photograph(png, "gamma")


def test_the_mask_leaves_out_what_is_no_measurement(tmp_path):
    image = IMAGE.copy()
    image[0, 0], image[1, 1, 2], image[2, 2, 1] = 1.0, 0.0, np.nan
    photo = read_photograph(write(tmp_path / "a.exr", image, "float"))
    # A float file has no full scale.
    assert (~photo.mask).sum() == 2
    photo = read_photograph(write(tmp_path / "a.png", np.nan_to_num(image), "uint16"))
    assert (~photo.mask).sum() == 5


def test_exif_gives_exposure_and_flash(tmp_path):
    stated = {"ExposureTime": 0.005, "FNumber": 8.0, "Exif:Flash": 1}
    photo = read_photograph(write(tmp_path / "a.tif", IMAGE, "uint16", **stated))
    assert photo.flash
    assert photo.exposure is None
    assert photo.camera is None
    photo = dataclasses.replace(photo, exif={**photo.exif, "ISO": 200})
    assert photo.exposure == pytest.approx(0.005 * 2 / 64, rel=1e-3)
    bare = read_photograph(write(tmp_path / "b.exr", IMAGE, "half"))
    assert (bare.exposure, bare.flash, bare.camera) == (None, None, None)
    named = dataclasses.replace(bare, exif={"Make": "NIKON CORPORATION", "Model": "NIKON D810"})
    assert named.camera == "Nikon D810"


def write_dng(path, mosaic, flash):
    """A minimal raw file: one uncompressed 16-bit RGGB mosaic, black 100, white 4100."""
    height, width = mosaic.shape
    exif = [(0x829A, 5, (1, 200)), (0x829D, 5, (8, 1)), (0x8827, 3, (125,)), (0x9209, 3, (flash,))]
    main = [
        (254, 4, (0,)), (256, 4, (width,)), (257, 4, (height,)), (258, 3, (16,)), (259, 3, (1,)),
        (262, 3, (32803,)), (271, 2, b"NIKON CORPORATION\0"), (272, 2, b"NIKON D810\0"),
        (273, 4, (8,)), (277, 3, (1,)), (278, 4, (height,)), (279, 4, (2 * width * height,)),
        (0x8769, 4, (8 + 2 * width * height,)), (33421, 3, (2, 2)), (33422, 1, (0, 1, 1, 2)),
        (50706, 1, (1, 4, 0, 0)), (50714, 3, (100,)), (50717, 3, (4100,)),
        (50721, 10, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1)),
    ]  # fmt: skip
    form = {1: "B", 3: "H", 4: "I", 5: "I", 10: "i"}

    def directory(entries, start):
        head, tail, at = struct.pack("<H", len(entries)), b"", start + 2 + 12 * len(entries) + 4
        for tag, kind, values in entries:
            data = values if kind == 2 else struct.pack(f"<{len(values)}{form[kind]}", *values)
            count = len(values) // (2 if kind in (5, 10) else 1)
            place = data.ljust(4, b"\0") if len(data) <= 4 else struct.pack("<I", at + len(tail))
            tail += data if len(data) > 4 else b""
            head += struct.pack("<HHI", tag, kind, count) + place
        return head + b"\0\0\0\0" + tail

    pixels = mosaic.astype("<u2").tobytes()
    inner = directory(exif, 8 + len(pixels))
    start = 8 + len(pixels) + len(inner)
    outer = directory(main, start)
    path.write_bytes(b"II*\0" + struct.pack("<I", start) + pixels + inner + outer)
    return path


def test_raw_files_are_linear_counts_above_black(tmp_path):
    pytest.importorskip("rawpy")
    share = RNG.uniform(0.1, 0.8, (16, 20, 3))
    mosaic = np.zeros((32, 40))
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        mosaic[row::2, column::2] = 100 + 4000 * share[:, :, channel]
    mosaic[6, 8] = 4100
    photo = read_photograph(write_dng(tmp_path / "ünder water.dng", np.round(mosaic), flash=25))
    assert photo.camera == "Nikon D810"
    assert photo.flash
    assert photo.exposure == pytest.approx(1 / 200 * 1.25 / 64)
    np.testing.assert_array_equal(np.argwhere(~photo.mask.all(axis=2)), [[3, 4]])
    share[3, 4, 0] = 1.0
    np.testing.assert_allclose(photo.values / photo.values[0, 0], share / share[0, 0], rtol=3e-3)
    cut = tmp_path / "cut.dng"
    cut.write_bytes((tmp_path / "ünder water.dng").read_bytes()[:400])
    with pytest.raises(ValueError, match="cannot be read as a raw file"):
        read_photograph(cut)


def broken(tmp_path, name):
    path = tmp_path / name
    whole = write(tmp_path / "whole.png", np.tile(IMAGE, (20, 20, 1)), "uint16").read_bytes()
    if name == "cut.png":
        path.write_bytes(whole[: len(whole) // 2])
    elif name == "empty.png":
        path.write_bytes(b"")
    elif name == "text.png":
        path.write_text("no picture")
    elif name == "text.nef":
        path.write_text("no raw file")
    elif name == "one.png":
        write(path, IMAGE[:1, :1], "uint16")
    elif name == "grey.png":
        write(path, IMAGE[:, :, :1], "uint16")
    elif name == "five.tif":
        write(path, np.tile(IMAGE, 2)[:, :, :5], "uint16")
    elif name == "black.png":
        write(path, 0 * IMAGE, "uint16")
    elif name == "white.png":
        write(path, 0 * IMAGE + 1, "uint16")
    elif name == "huge.png":
        # Its header alone claims 10000 x 10000.
        at = whole.index(b"IHDR") + 4
        claim = whole[at - 4 : at] + struct.pack(">II", 10000, 10000) + whole[at + 8 : at + 13]
        import zlib

        path.write_bytes(whole[: at - 4] + claim + struct.pack(">I", zlib.crc32(claim))
                         + whole[at + 17 :])  # fmt: skip
    return path


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing.png", "does not exist"),
        ("empty.png", "is empty"),
        ("text.png", "cannot be read"),
        ("text.nef", "cannot be read as a raw file"),
        ("cut.png", "damaged or cut short"),
        ("one.png", "1 x 1 pixels"),
        ("grey.png", r"has 1 channel"),
        ("five.tif", r"has 5 channel"),
        ("black.png", "is black"),
        ("white.png", "clipped everywhere"),
        ("huge.png", "10000 x 10000 pixels"),
    ],
)
def test_hostile_files_are_a_sentence(tmp_path, name, words):
    if name.endswith("nef"):
        pytest.importorskip("rawpy")
    with pytest.raises(ValueError, match=words):
        read_photograph(broken(tmp_path, name))


@pytest.mark.parametrize(
    "name",
    [
        "empty.png",
        "cut.png",
        "one.png",
        "five.tif",
        "black.png",
        "white.png",
        "huge.png",
        "nan.npz",
    ],
)
def test_hostile_files_end_the_command_with_a_sentence_and_nothing_written(tmp_path, capsys, name):
    """In a folder with a space and an umlaut; the last is a range map without a range."""
    folder, out = tmp_path / "am Riff, \u00fc", tmp_path / "out"
    folder.mkdir()
    out.mkdir()
    ranges = folder / "nan.npz"
    np.savez(ranges, np.full(IMAGE.shape[:2], np.nan))
    bad = name != ranges.name
    picture = broken(folder, name) if bad else write(folder / "a.png", IMAGE, "uint16")
    charts = str(SCENES / "red_sea_charts.csv")
    files = ["--picture", str(picture), "--range-map", str(ranges), "-o", str(out / "fit")]
    assert cli.run(["fit-photo", charts, "--depth", "5", *files]) == 3
    said = capsys.readouterr().err
    assert str(picture if bad else ranges) in said
    assert "Traceback" not in said
    assert list(out.iterdir()) == []


def save_range(tmp_path, name):
    path = tmp_path / name
    if name.endswith("npz"):
        np.savez(path, depth=RANGE)
    elif name.endswith("bin"):
        path.write_bytes(b"16&12&1&" + RANGE.T.astype("<f4").tobytes(order="F"))
    elif name.endswith("mm.tif"):
        write(path, RANGE / 65.535, "uint16")
    else:
        write(path, RANGE, "half" if "half" in name else "float")
    return path


@pytest.mark.parametrize(
    ("name", "error"),
    [("r.exr", 1e-6), ("half.exr", 4e-3), ("r.tif", 1e-6), ("mm.tif", 6e-4), ("half.tif", 4e-3),
     ("r.npz", 0), ("r.bin", 1e-6)],
)  # fmt: skip
def test_range_maps_in_every_form(tmp_path, name, error):
    found = read_range(save_range(tmp_path, name), (12, 16))
    np.testing.assert_allclose(found, RANGE, atol=error, rtol=0)


def test_ranges_of_another_size_and_missing_ones(tmp_path):
    values = np.repeat(np.arange(1.0, 101.0)[:, None], 100, axis=1)
    values[:5], values[5, 0], values[6, 0], values[7, 0] = 0.0, np.nan, np.inf, -1.0
    path = tmp_path / "r.npz"
    np.savez(path, values)
    found = read_range(path, (102, 101))
    assert found.shape == (102, 101)
    assert np.isnan(found[:5]).all()
    assert np.isnan(found[6:8, 0]).all()
    assert np.nanmax(np.abs(found[10:, 50] - np.arange(10.5, 102) * 100 / 102)) < 1.1
    with pytest.raises(ValueError, match="another shape"):
        read_range(path, (100, 150))
    np.savez(path, values * np.nan)
    with pytest.raises(ValueError, match="holds no range"):
        read_range(path, (100, 100))
    bad = tmp_path / "r.bin"
    bad.write_bytes(b"16&12&1&1234")
    with pytest.raises(ValueError, match="cut short"):
        read_range(bad, (12, 16))


def test_pixels_with_a_range_are_readings(tmp_path):
    image, distance = IMAGE.copy(), RANGE.copy()
    image[0, :4], distance[1, :3] = 1.0, np.nan
    photo = read_photograph(write(tmp_path / "a.png", image, "uint16"))
    seen = pixels_of(photo, distance, surfaces=50.0, zenith=100.0)
    assert seen.values.shape == (12 * 16 - 7, 3)
    assert (seen.surfaces, seen.zenith, seen.masked) == (50.0, 100.0, 0)
    np.testing.assert_allclose(seen.distance[-1], RANGE[-1, -1])
    with pytest.raises(ValueError, match=r"distance has shape \(3, 3\)"):
        pixels_of(photo, np.ones((3, 3)))
