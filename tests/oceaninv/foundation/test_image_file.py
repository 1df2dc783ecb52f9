"""Image and numpy files: sizes checked before anything is decoded, windows, several images."""

import io
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import OpenImageIO as oiio
import pytest

from oceaninv.foundation.image_file import read_image, read_numpy
from oceaninv.scene._toml_section import picture

VALUES = np.random.default_rng(7).uniform(0.1, 0.9, (8, 10, 3)).astype(np.float32)


def npy_header(shape, dtype="<f8"):
    stream = io.BytesIO()
    header = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("window", "display"),
    [((3, 2), (0, 0, 20, 16)), ((-4, -1), (0, 0, 6, 9)), ((105, 203), (100, 200, 12, 14))],
)
def test_a_data_window_lies_where_the_display_window_says(tmp_path, window, display):
    path = tmp_path / "a.exr"
    spec = oiio.ImageSpec(10, 8, 3, "float")
    spec.x, spec.y = window
    spec.full_x, spec.full_y, spec.full_width, spec.full_height = display
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(VALUES)
    out.close()
    found = read_image(path, 10**6).values
    assert found.shape == (display[3], display[2], 3)
    truth = np.full_like(found, np.nan)
    for row in range(8):
        for column in range(10):
            y, x = window[1] + row - display[1], window[0] + column - display[0]
            if 0 <= y < display[3] and 0 <= x < display[2]:
                truth[y, x] = VALUES[row, column]
    assert np.isfinite(truth).any()
    np.testing.assert_array_equal(found, truth)


@pytest.mark.parametrize("place", [b"remark", b"worded"])
def test_metadata_that_is_not_unicode_is_passed_over(tmp_path, place):
    path = tmp_path / "a.exr"
    spec = oiio.ImageSpec(10, 8, 3, "float")
    spec.attribute("remark", "worded")
    spec.attribute("other", "text")
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(VALUES)
    out.close()
    whole = path.read_bytes()
    assert place in whole
    path.write_bytes(whole.replace(place, place[:2] + b"\xff" + place[3:]))
    found = read_image(path, 10**6)
    np.testing.assert_array_equal(found.values, VALUES)
    assert found.attributes["other"] == "text"


def write_deep(path):
    spec = oiio.ImageSpec(10, 8, 4, "float")
    spec.deep = True
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    data = oiio.DeepData()
    data.init(spec)
    for pixel in range(80):
        data.set_samples(pixel, 2)
    assert out.write_deep_image(data)
    out.close()


def test_deep_images_are_refused_by_their_header(tmp_path):
    write_deep(tmp_path / "a.exr")
    for read in (lambda p: read_image(p, 10**6), picture):
        with pytest.raises(ValueError, match="is a deep image, several samples at one pixel"):
            read(tmp_path / "a.exr")


def claiming(path, width, height):
    """A PNG of a few bytes whose header claims width x height."""

    def chunk(name, data):
        check = struct.pack(">I", zlib.crc32(name + data))
        return struct.pack(">I", len(data)) + name + data + check

    head = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0" * 99))
    )
    return path


def test_a_texture_of_59_megapixels_is_refused_before_it_is_decoded(tmp_path):
    path = claiming(tmp_path / "a.png", 8840, 6700)
    with pytest.raises(ValueError, match="8840 x 6700 pixels; at most 25 megapixels"):
        picture(path)
    with pytest.raises(ValueError, match="damaged or cut short"):
        picture(claiming(tmp_path / "a.png", 800, 600))


def hostile(path, kind):
    member = "arr_0.npy"
    content = npy_header((4, 5)) + np.arange(20.0).tobytes()
    if kind == "terabytes":
        content = npy_header((10**6, 10**6))
    elif kind == "short":
        content = content[:-8]
    elif kind == "negative":
        content = npy_header((4, -5))
    elif kind == "objects":
        content = npy_header((4, 5), "|O") + b"\0" * 160
    elif kind == "text":
        content = b"no array"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(member, content)
        if kind == "two":
            archive.writestr("other.npy", content)
    whole = bytearray(path.read_bytes())
    if kind == "damaged":
        at = whole.index(b"arr_0.npy") + 40
        whole[at : at + 8] = b"\xff" * 8
    elif kind == "offset":  # of the directory, by 100 bytes too large
        whole[-6:-2] = (int.from_bytes(whole[-6:-2], "little") + 100).to_bytes(4, "little")
    elif kind == "cut":
        whole = whole[: len(whole) // 2]
    path.write_bytes(bytes(whole))
    return path


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("terabytes", r"claims an array of shape \(1000000, 1000000\)"),
        ("short", "is cut short"),
        ("negative", "claims an array of shape"),
        ("objects", "no array of numbers"),
        ("text", "holds no numpy array"),
        ("two", r"must hold one array, not 2 \(arr_0, other\)"),
        ("damaged", "damaged or cut short"),
        ("offset", "damaged or cut short"),
        ("cut", "damaged or cut short"),
    ],
)
def test_hostile_numpy_files_are_a_sentence(tmp_path, kind, words):
    for read in (lambda p: read_numpy(p, 10**6), picture):
        with pytest.raises(ValueError, match=words):
            read(hostile(tmp_path / "a.npz", kind))


def test_deep_images_and_damaged_ones_are_a_sentence(tmp_path):
    """Two samples at every pixel; then 100 copies of the file with bytes changed at random."""
    path = tmp_path / "deep.exr"
    spec = oiio.ImageSpec(16, 12, 2, "float")
    spec.channelnames = ("Z", "A")
    spec.deep = True
    samples = oiio.DeepData()
    samples.init(spec)
    for pixel in range(16 * 12):
        samples.set_samples(pixel, 2)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_deep_image(samples)
    out.close()
    with pytest.raises(ValueError, match="is a deep image"):
        read_image(path, 10**6)
    whole, rng = path.read_bytes(), np.random.default_rng(2)
    for _ in range(100):
        changed = bytearray(whole)
        for place in rng.integers(0, len(whole), 4):
            changed[place] = rng.integers(0, 256)
        path.write_bytes(bytes(changed))
        with pytest.raises(ValueError, match=str(path)):
            read_image(path, 10**6)


def test_a_packed_header_of_gigabytes_is_not_unpacked(tmp_path):
    """100 MB of blanks that take 100 kB in the file, as a header that claims 4 GB."""
    head = b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", head + b" " * 100_000_000)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="holds no numpy array"):
            read_numpy(tmp_path / "a.npz", 10**6)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2, zipfile.ZIP_DEFLATED])
def test_damage_of_every_way_of_packing_is_a_sentence(tmp_path, method):
    stream = io.BytesIO()
    np.save(stream, VALUES[:, :, 0])
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("a.npy", stream.getvalue())
    np.testing.assert_array_equal(read_numpy(path, 80), VALUES[:, :, 0])
    whole = path.read_bytes()
    refused = 0
    for place in range(30, len(whole) - 100, 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 255]) + whole[place + 1 :])
        try:
            read_numpy(path, 80)
        except ValueError as error:
            assert str(error).startswith(str(path))  # noqa: PT017
            refused += 1
    assert refused > 10


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_numpy_files_come_back_as_written(tmp_path, order, save):
    values = np.asarray(np.arange(20, dtype=np.int16).reshape(4, 5), order=order)
    save(tmp_path / "a.npz", values)
    np.save(tmp_path / "a.npy", values)
    for name in ("a.npz", "a.npy"):
        np.testing.assert_array_equal(read_numpy(tmp_path / name, 20), values)
        with pytest.raises(ValueError, match=r"at most 1\.9e-05 million"):
            read_numpy(tmp_path / name, 19)


def test_every_mutated_file_is_read_or_a_sentence(tmp_path):
    """600 files with bytes changed at random: an array or ValueError, nothing else."""
    rng = np.random.default_rng(11)
    for kind in ("npz", "png", "exr", "tif"):
        path = tmp_path / f"a.{kind}"
        if kind == "npz":
            np.savez_compressed(path, VALUES)
        else:
            spec = oiio.ImageSpec(10, 8, 3, "float" if kind == "exr" else "uint16")
            out = oiio.ImageOutput.create(str(path))
            assert out.open(str(path), spec)
            assert out.write_image(VALUES)
            out.close()
        whole = path.read_bytes()
        for _ in range(150):
            changed = bytearray(whole)
            for place in rng.integers(0, len(whole), rng.integers(1, 12)):
                changed[place] = rng.integers(0, 256)
            path.write_bytes(bytes(changed[: rng.integers(len(whole) // 2, len(whole) + 1)]))
            try:
                found = read_numpy(path, 10**6) if kind == "npz" else picture(path)
            except ValueError as error:
                assert str(error).startswith(str(path))  # noqa: PT017
                assert "Error" not in str(error)  # noqa: PT017
            else:
                assert found.size <= 3 * 25_000_000
