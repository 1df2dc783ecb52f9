"""Photographs: what is read, and a sentence for all that is not."""

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
    """An image file that states no curve, unless `attributes` do."""
    values = np.asarray(values)
    values = values[:, :, None] if values.ndim == 2 else values
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], kind)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    attributes = {"oiio:ColorSpace": "unknown"} | attributes
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


# Red, green and blue (0, 1, 2) of the six by six cells of an X-Trans sensor.
X_TRANS = np.array([
    [1, 1, 0, 1, 1, 2], [1, 1, 2, 1, 1, 0], [2, 0, 1, 0, 2, 1],
    [1, 1, 2, 1, 1, 0], [1, 1, 0, 1, 1, 2], [0, 2, 1, 2, 0, 1],
])  # fmt: skip


def write_dng(path, mosaic, flash, cells=((0, 1), (1, 2))):
    """A minimal raw file: one uncompressed 16-bit mosaic, black 100, white 4100."""
    cells = np.asarray(cells)
    height, width = mosaic.shape
    exif = [(0x829A, 5, (1, 200)), (0x829D, 5, (8, 1)), (0x8827, 3, (125,)), (0x9209, 3, (flash,))]
    main = [
        (254, 4, (0,)), (256, 4, (width,)), (257, 4, (height,)), (258, 3, (16,)), (259, 3, (1,)),
        (262, 3, (32803,)), (271, 2, b"NIKON CORPORATION\0"), (272, 2, b"NIKON D810\0"),
        (273, 4, (8,)), (277, 3, (1,)), (278, 4, (height,)), (279, 4, (2 * width * height,)),
        (0x8769, 4, (8 + 2 * width * height,)), (33421, 3, cells.shape),
        (33422, 1, tuple(cells.ravel().tolist())),
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
    with pytest.raises(ValueError, match="cannot be read as a raw file: it is damaged") as raised:
        read_photograph(cut)
    assert "b'" not in str(raised.value)  # no words of the library


@pytest.mark.parametrize("brightest", [0.6, 0.74, 0.76, 0.9, 1.0])
def test_a_raw_value_does_not_depend_on_what_else_is_in_the_frame(tmp_path, brightest):
    """LibRaw scales by the brightest pixel of a frame where this is above 0.75 of the white level.

    Truth: (counts - black) / (white - black), of 0.3 and of each share written.
    """
    mosaic = np.full((32, 40), 100.0 + 4000 * 0.3)
    mosaic[6:8, 8:10] = 100 + 4000 * brightest
    mosaic[10:12, 12:14] = [[100 + 400, 100 + 800], [100 + 1000, 100 + 1600]]
    photo = read_photograph(write_dng(tmp_path / "a.dng", mosaic, flash=0))
    np.testing.assert_allclose(photo.values[0, 0], 0.3, rtol=1e-12)
    np.testing.assert_allclose(photo.values[3, 4], brightest, rtol=1e-12)
    np.testing.assert_allclose(photo.values[5, 6], [0.1, 0.225, 0.4], rtol=1e-12)
    assert (~photo.mask.all(axis=2)).sum() == (1 if brightest == 1.0 else 0)
    assert photo.step == pytest.approx(1 / 4000 / np.sqrt(12))


@pytest.mark.parametrize("brightest", [0.6, 0.76, 0.9, 1.0])
def test_raw_values_of_other_mosaics_are_on_the_same_scale(tmp_path, brightest):
    """Three by three cells of an X-Trans sensor hold 2 red, 5 green and 2 blue ones."""
    share = np.array([0.1, 0.3, 0.5])
    mosaic = 100 + 4000 * np.tile(share[X_TRANS], (6, 8))
    mosaic[12:18, 12:18] = 100 + 4000 * brightest
    photo = read_photograph(write_dng(tmp_path / "a.dng", mosaic, flash=0, cells=X_TRANS))
    assert photo.values.shape == (12, 16, 3)
    truth = np.broadcast_to(share, (12, 16, 3)).copy()
    truth[4:6, 4:6] = brightest
    np.testing.assert_allclose(photo.values, truth, rtol=1e-12)
    np.testing.assert_array_equal(~photo.mask.all(axis=2), truth[:, :, 0] >= 1.0)


@pytest.mark.parametrize("brightest", [0.6, 0.76, 0.9, 1.0])
def test_raw_values_without_a_mosaic_are_on_the_same_scale(tmp_path, brightest):
    """A linear DNG: three counts at every pixel."""
    import tifffile

    counts = np.full((32, 40, 3), 100 + 4000 * np.array([0.1, 0.3, 0.5]))
    counts[6, 8] = 100 + 4000 * brightest
    identity = tuple(v for row in np.eye(3, dtype=int) for one in row for v in (int(one), 1))
    tags = [(50706, 1, 4, (1, 4, 0, 0), True), (50714, 3, 3, (100,) * 3, True),
            (50717, 3, 3, (4100,) * 3, True), (50721, 10, 9, identity, True)]  # fmt: skip
    path = tmp_path / "a.dng"
    tifffile.imwrite(path, np.round(counts).astype(np.uint16), photometric=34892, extratags=tags)
    photo = read_photograph(path)
    truth = np.broadcast_to([0.1, 0.3, 0.5], (32, 40, 3)).copy()
    truth[6, 8] = brightest
    np.testing.assert_allclose(photo.values, truth, rtol=1e-12)
    np.testing.assert_array_equal(~photo.mask.all(axis=2), truth[:, :, 0] >= 1.0)


def test_saturation_below_the_stated_white_level_of_a_raw_file_is_masked(tmp_path):
    share = np.random.default_rng(1).uniform(0.1, 0.7, (64, 80))
    share[:20] = 0.83
    path = write_dng(tmp_path / "a.dng", np.round(100 + 4000 * share), flash=0)
    with pytest.warns(UserWarning, match="saturates below .* 4100 counts; 1600 at 3420 are left"):
        photo = read_photograph(path)
    assert not photo.mask[:10].any()
    assert photo.mask[10:].all()
    np.testing.assert_allclose(photo.values[0, 0], 0.83, rtol=1e-12)


def with_chunks(path, *chunks):
    """The PNG with chunks (name, bytes) put before its pixels."""
    import zlib

    whole = path.read_bytes()
    at = whole.index(b"IDAT") - 4
    added = b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
    path.write_bytes(whole[:at] + added + whole[at:])
    return path


def icc_profile(curve):
    """An RGB matrix profile of three like tone curves (the bytes of a curv or para tag)."""
    tags = b"".join(
        struct.pack(">4sII", name, 168, len(curve)) for name in (b"rTRC", b"gTRC", b"bTRC")
    )
    head = bytearray(128)
    head[8:12], head[12:24], head[36:40] = b"\x02\x40\0\0", b"mntrRGB XYZ ", b"acsp"
    body = bytes(head) + struct.pack(">I", 3) + tags + curve
    return struct.pack(">I", len(body)) + body[4:]


def png_profile(curve):
    import zlib

    return b"iCCP", b"made\0\0" + zlib.compress(icc_profile(curve))


def srgb_decoded(v):
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


SRGB_PARA = struct.pack(
    ">4sIHH7i", b"para", 0, 4, 0,
    *(round(65536 * v) for v in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045, 0, 0)),
)  # fmt: skip


@pytest.mark.parametrize(
    ("chunk", "truth", "error"),
    [
        ((b"sRGB", b"\1"), srgb_decoded, 2e-5),
        ((b"gAMA", struct.pack(">I", 45455)), lambda v: v ** (1 / 0.45455), 2e-5),
        ((b"gAMA", struct.pack(">I", 100000)), lambda v: v, 1e-5),
        ((b"cICP", bytes([1, 8, 0, 1])), lambda v: v, 1e-5),
        ((b"cICP", bytes([1, 13, 0, 1])), srgb_decoded, 2e-5),
        (png_profile(struct.pack(">4sIIH", b"curv", 0, 1, round(1.8 * 256))),
         lambda v: v ** (round(1.8 * 256) / 256), 2e-5),
        (png_profile(struct.pack(">4sII", b"curv", 0, 0)), lambda v: v, 1e-5),
        (png_profile(struct.pack(">4sII3H", b"curv", 0, 3, 0, 16384, 65535)),
         lambda v: np.interp(v, [0, 0.5, 1], [0, 16384 / 65535, 1]), 2e-5),
        (png_profile(struct.pack(">4sIHH4i", b"para", 0, 2, 0, 131072, 65536, -6554, 3277)),
         lambda v: np.maximum(v - 6554 / 65536, 0) ** 2 + 3277 / 65536, 2e-5),
        (png_profile(SRGB_PARA), srgb_decoded, 4e-5),
    ],
)  # fmt: skip
def test_sixteen_bits_are_read_by_the_curve_that_they_state(tmp_path, chunk, truth, error):
    path = with_chunks(write(tmp_path / "a.png", IMAGE, "uint16"), chunk)
    photo = read_photograph(path)
    expected = truth(IMAGE)
    np.testing.assert_allclose(photo.values, expected, atol=error, rtol=0)
    assert photo.relative == (0.0 if np.allclose(expected, IMAGE) else 0.05)


def test_full_scale_is_judged_before_the_curve(tmp_path):
    """The curve ends at 0.25 + 0.05; full scale is no measurement there either."""
    image = IMAGE.copy()
    image[3, 4] = 1.0
    curve = struct.pack(">4sIHH4i", b"para", 0, 2, 0, 131072, 32768, 0, 3277)
    path = with_chunks(write(tmp_path / "a.png", image, "uint16"), png_profile(curve))
    photo = read_photograph(path)
    np.testing.assert_allclose(photo.values, 0.25 * image**2 + 3277 / 65536, atol=2e-5)
    np.testing.assert_array_equal(np.argwhere(~photo.mask.all(axis=2)), [[3, 4]])


def test_a_tiff_is_read_by_its_profile(tmp_path):
    """As raw developers write them; the profile of a 16-bit TIFF is that of its tone curve."""
    import tifffile

    counts = np.round(65535 * IMAGE).astype(np.uint16)
    curve = struct.pack(">4sIIH", b"curv", 0, 1, 2 * 256)
    tifffile.imwrite(tmp_path / "a.tif", counts, photometric="rgb", iccprofile=icc_profile(curve))
    np.testing.assert_allclose(read_photograph(tmp_path / "a.tif").values, IMAGE**2, atol=2e-5)


@pytest.mark.parametrize(
    ("chunk", "encoding", "words"),
    [
        ((b"sRGB", b"\0"), "linear", "states the sRGB curve, which contradicts .*'linear'"),
        ((b"gAMA", struct.pack(">I", 45455)), "linear", "states a gamma of 2.2 "),
        ((b"gAMA", struct.pack(">I", 100000)), "sRGB", "states linear .*contradicts .*'sRGB'"),
    ],
)
@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_a_file_that_contradicts_the_encoding_is_named(tmp_path, chunk, encoding, words, kind):
    path = with_chunks(write(tmp_path / "a.png", IMAGE, kind), chunk)
    with pytest.warns(UserWarning, match=words):
        photo = read_photograph(path, encoding)
    expected = IMAGE if encoding == "linear" else srgb_decoded(IMAGE)
    np.testing.assert_allclose(photo.values, expected, atol=5e-3)


def test_a_curve_that_is_not_understood_is_a_sentence(tmp_path):
    for chunk, words in (
        ((b"cICP", bytes([9, 16, 0, 1])), "transfer function 16"),
        ((b"gAMA", b"\0\0\0\0"), "a gamma of zero"),
        (png_profile(b"mAB \0\0\0\0"), "ICC profile without tone curves"),
    ):
        path = with_chunks(write(tmp_path / "a.png", IMAGE, "uint16"), chunk)
        with pytest.raises(ValueError, match=words):
            read_photograph(path)
        np.testing.assert_allclose(read_photograph(path, "linear").values, IMAGE, atol=1e-5)


def test_transparent_pixels_are_left_out_and_colours_are_not_multiplied(tmp_path):
    alpha = np.ones((12, 16, 1))
    alpha[2:4, 3:8], alpha[5, 5] = 0.5, 0.0
    path = write(tmp_path / "a.png", np.concatenate([IMAGE, alpha], axis=2), "uint16")
    with pytest.warns(UserWarning, match="11 pixels are transparent"):
        photo = read_photograph(path)
    np.testing.assert_allclose(photo.values, IMAGE, atol=1e-5)
    np.testing.assert_array_equal(photo.mask.all(axis=2), alpha[:, :, 0] == 1)
    write(path, np.concatenate([IMAGE, 0 * alpha], axis=2), "uint16")
    with pytest.raises(ValueError, match="alpha is below 1 in every pixel"):
        read_photograph(path)


def test_the_full_image_of_a_file_with_a_preview_is_read(tmp_path):
    import tifffile

    counts = np.round(65535 * IMAGE).astype(np.uint16)
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as file:
        file.write(np.ascontiguousarray(counts[::2, ::2]), photometric="rgb")
        file.write(counts, photometric="rgb")
    np.testing.assert_allclose(read_photograph(path).values, IMAGE, atol=1e-5)
    with tifffile.TiffWriter(path) as file:
        for _ in range(2):
            file.write(counts, photometric="rgb")
    with pytest.raises(ValueError, match="2 images of its largest size"):
        read_photograph(path)
    tifffile.imwrite(path, counts, photometric="rgb", subfiletype=1)
    with pytest.raises(ValueError, match="nothing but a reduced preview"):
        read_photograph(path)


def test_channels_are_taken_by_their_names(tmp_path):
    planes = np.concatenate([IMAGE, RANGE[:, :, None]], axis=2)
    path = tmp_path / "a.exr"
    spec = oiio.ImageSpec(16, 12, 4, "float")
    spec.channelnames = ("R", "G", "B", "Z")
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(planes.astype(np.float32))
    out.close()
    np.testing.assert_allclose(read_photograph(path).values, IMAGE, atol=1e-6)
    np.testing.assert_allclose(read_range(path, (12, 16)), RANGE, atol=1e-5)
    spec.channelnames = ("X", "Y", "Z", "W")
    assert out.open(str(path), spec)
    assert out.write_image(planes.astype(np.float32))
    out.close()
    with pytest.raises(ValueError, match=r"4 channel.*X, Y, Z, W.*red, green and blue wanted"):
        read_photograph(path)
    colours = write(tmp_path / "b.exr", IMAGE, "float")
    with pytest.raises(ValueError, match="is a picture in colours"):
        read_range(colours, (12, 16))


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


def test_commands_print_warnings_as_sentences(tmp_path, capsys):
    picture = write(tmp_path / "a.png", IMAGE, "uint16")
    marked = RANGE.repeat(2, axis=0).repeat(2, axis=1) * 1000 / 65535
    marked[:3, :5] = 1.0
    ranges = write(tmp_path / "r.png", marked, "uint16")
    assert cli.run(["check", str(picture), "--range-map", str(ranges)]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith(f"oceaninv: {ranges}: 15 of 768 pixels hold 65535")
    assert lines[1].startswith(f"oceaninv: {ranges} is 32 x 24, the photograph 16 x 12: the map")
    assert len(lines) == 2


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
