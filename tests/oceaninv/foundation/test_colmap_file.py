"""COLMAP's files: what was written comes back, and a sentence for what is damaged."""

import struct

import numpy as np
import pytest

from oceaninv.foundation.colmap_file import (
    PARAMETERS,
    read_cameras,
    read_depth,
    read_image_cameras,
)

MODELS = list(PARAMETERS)
DEPTH = np.random.default_rng(5).uniform(1.0, 9.0, (5, 7)).astype(np.float32)


def write_colmap(path, depth):
    """A dense map as COLMAP writes one: x runs first, then y."""
    rows, columns = depth.shape
    with open(path, "wb") as file:
        file.write(f"{columns}&{rows}&1&".encode())
        for row in range(rows):
            file.write(struct.pack(f"<{columns}f", *depth[row]))
    return path


def write_cameras(path, cameras):
    """`cameras`: number -> (model, width, height, parameters)."""
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for number, (model, width, height, parameters) in cameras.items():
            file.write(struct.pack("<IiQQ", number, MODELS.index(model), width, height))
            file.write(struct.pack(f"<{len(parameters)}d", *parameters))
    return path


def write_images(path, images):
    """`images`: name -> number of the camera; each image has some points."""
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for number, (name, camera) in enumerate(images.items(), start=1):
            file.write(struct.pack("<I7dI", number, 1, 0, 0, 0, 0.5, 0.6, 0.7, camera))
            file.write(name.encode() + b"\0" + struct.pack("<Q", number))
            for point in range(number):
                file.write(struct.pack("<2dq", 10.0, 20.0, point))
    return path


def camera(model, first=1.0):
    values = [first * (50.0 + k) for k in range(len(PARAMETERS[model].split()))]
    return model, 640, 480, tuple(values)


def test_maps_come_back_as_written(tmp_path):
    path = write_colmap(tmp_path / "a.bin", DEPTH)
    np.testing.assert_array_equal(read_depth(path, 35), DEPTH)
    with pytest.raises(ValueError, match=r"has 7 x 5 pixels; at most 3\.4e-05 megapixels"):
        read_depth(path, 34)


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (b"7&5&1&" + bytes(139), "should hold 7 x 5 x 1 floats .* has 139 bytes"),
        (b"7&5&1&" + bytes(141), "has 141 bytes"),
        (b"7&5&3&" + bytes(420), "7 x 5 x 3 floats of one channel"),
        (b"0&5&1&", "0 x 5 x 1"),
        (b"-7&5&1&" + bytes(140), "does not begin like a COLMAP map"),
        (b"7&5&", "does not begin like a COLMAP map"),
        (b"1000000000000&1000000000000&1&" + bytes(140), "cut short"),
        (b"9" * 64, "does not begin like a COLMAP map"),
    ],
)
def test_damaged_maps_are_a_sentence(tmp_path, raw, words):
    (tmp_path / "a.bin").write_bytes(raw)
    with pytest.raises(ValueError, match=words):
        read_depth(tmp_path / "a.bin", 10**6)


def test_models_have_the_numbers_that_colmap_gives_them():
    """The numbers stand in COLMAP's documentation; pinhole models come first."""
    numbers = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4,
               "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8,
               "RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10}  # fmt: skip
    assert {name: MODELS.index(name) for name in MODELS} == numbers


def test_cameras_come_back_as_written(tmp_path):
    given = {7 + 2 * k: camera(model) for k, model in enumerate(MODELS)}
    write_cameras(tmp_path / "cameras.bin", given)
    lines = ["# Camera list", "", *(f"{n} {m} {w} {h} {' '.join(map(repr, p))}"
                                    for n, (m, w, h, p) in given.items())]  # fmt: skip
    (tmp_path / "cameras.txt").write_text("\n".join(lines))
    for name in ("cameras.bin", "cameras.txt"):
        found = read_cameras(tmp_path / name)
        assert list(found) == list(given)
        for number, (model, width, height, values) in given.items():
            one = found[number]
            assert (one.model, one.width, one.height) == (model, width, height)
            assert list(one.parameters) == PARAMETERS[model].split()
            assert tuple(one.parameters.values()) == values


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda raw: raw[:-1], "is cut short"),
        (lambda raw: raw[:7], "is cut short"),
        (lambda raw: raw + b"1", "holds 1 bytes more than its 1 cameras"),
        (lambda raw: struct.pack("<Q", 2**62) + raw[8:], "is cut short"),
        (lambda raw: bytes(8), "holds no camera"),
        (lambda raw: raw[:12] + struct.pack("<i", 99) + raw[16:], "of model number 99"),
        (lambda raw: raw[:12] + struct.pack("<i", -1) + raw[16:], "of model number -1"),
        (lambda raw: raw[:16] + struct.pack("<Q", 0) + raw[24:], "sizes and focal lengths must"),
        (lambda raw: raw[:16] + struct.pack("<Q", 2**60) + raw[24:], "sizes and focal lengths"),
        (lambda raw: raw[:32] + struct.pack("<d", -1.0) + raw[40:], "sizes and focal lengths must"),
        (lambda raw: raw[:32] + struct.pack("<d", np.nan) + raw[40:], "sizes and focal lengths"),
    ],
)
def test_damaged_cameras_are_a_sentence(tmp_path, change, words):
    path = write_cameras(tmp_path / "cameras.bin", {1: camera("PINHOLE")})
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ValueError, match=words):
        read_cameras(path)


@pytest.mark.parametrize(
    "text",
    ["1", "1 PINHOLE 6 4 1 1 1", "1 PINHOLE six 4 1 1 1 1", "1 LENS 6 4 1 1 1 1",
     "1 PINHOLE 6 4 1 1 1 1 1", "9" * 5000 + " PINHOLE 6 4 1 1 1 1"],
)  # fmt: skip
def test_lines_that_are_no_camera_are_named(tmp_path, text):
    (tmp_path / "cameras.txt").write_text(f"# cameras\n{text}\n")
    with pytest.raises(ValueError, match="line 2 is no camera"):
        read_cameras(tmp_path / "cameras.txt")
    (tmp_path / "cameras.txt").write_bytes(b"1 PINHOLE \xff")
    with pytest.raises(ValueError, match="no text in UTF-8"):
        read_cameras(tmp_path / "cameras.txt")


def test_the_camera_of_each_image_comes_back(tmp_path):
    given = {"a b/IMG 1.JPG": 3, "Übung.png": 4, "c.png": 3}
    write_images(tmp_path / "images.bin", given)
    lines = "# list\n\n1 1 0 0 0 1 2 3 3 a b/IMG 1.JPG\n10 20 -1\n2 1 0 0 0 1 2 3 4 Übung.png\n\n"
    (tmp_path / "images.txt").write_text(f"{lines}3 1 0 0 0 1 2 3 3 c.png\n5 6 7\n", "utf-8")
    for name in ("images.bin", "images.txt"):
        assert read_image_cameras(tmp_path / name) == given


def test_damaged_images_are_a_sentence(tmp_path):
    """Cut at every byte, lengthened, with a count of points that no file holds, and of text."""
    path = write_images(tmp_path / "images.bin", {"a.png": 1, "b.png": 2})
    whole = path.read_bytes()
    for end in range(len(whole)):
        path.write_bytes(whole[:end])
        with pytest.raises(ValueError, match="is cut short, or no list"):
            read_image_cameras(path)
    path.write_bytes(whole + b"12")
    with pytest.raises(ValueError, match="holds 2 bytes more"):
        read_image_cameras(path)
    at = whole.index(b"a.png\0") + 6
    path.write_bytes(whole[:at] + struct.pack("<Q", 2**63) + whole[at + 8 :])
    with pytest.raises(ValueError, match="is cut short"):
        read_image_cameras(path)
    text = tmp_path / "images.txt"
    for line in ("1 2 3", "1 1 0 0 0 1 2 3 x c.png", "1 1 0 0 0 1 2 3 " + "9" * 5000 + " c.png"):
        text.write_text(line)
        with pytest.raises(ValueError, match="line 1 is no image"):
            read_image_cameras(text)
    text.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match="no text in UTF-8"):
        read_image_cameras(text)
