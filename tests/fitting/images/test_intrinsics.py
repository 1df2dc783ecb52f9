"""Cameras: lines of sight of pixels, against the models' formulas written out by hand."""

import math

import numpy as np
import pytest

from fitting.images.intrinsics import Intrinsics, read_intrinsics, same_name
from tests.oceaninv.foundation.test_colmap_file import write_cameras, write_images

PINHOLE = {"fx": 500.0, "fy": 480.0, "cx": 330.0, "cy": 250.0}
SIMPLE = {"f": 500.0, "cx": 330.0, "cy": 250.0}
BENT = {"k1": -0.12, "k2": 0.03}
FULL = {"k1": 0.3, "k2": 0.05, "p1": 0.002, "p2": -0.003, "k3": 0.01, "k4": 0.45, "k5": 0.1,
        "k6": 0.02}  # fmt: skip
CAMERAS = {
    "SIMPLE_PINHOLE": SIMPLE,
    "PINHOLE": PINHOLE,
    "SIMPLE_RADIAL": SIMPLE | {"k1": -0.12},
    "RADIAL": SIMPLE | BENT,
    "OPENCV": PINHOLE | BENT | {"p1": 0.002, "p2": -0.003},
    "FULL_OPENCV": PINHOLE | FULL,
    "FOV": PINHOLE | {"omega": 0.9},
    "OPENCV_FISHEYE": PINHOLE | {"k1": -0.03, "k2": 0.01, "k3": -0.004, "k4": 0.001},
    "SIMPLE_RADIAL_FISHEYE": SIMPLE | {"k1": -0.03},
    "RADIAL_FISHEYE": SIMPLE | {"k1": -0.03, "k2": 0.01},
    "THIN_PRISM_FISHEYE": PINHOLE | {"k1": -0.03, "k2": 0.01, "p1": 0.002, "p2": -0.001,
                                     "k3": -0.004, "k4": 0.001, "sx1": 0.003, "sy1": -0.002},
}  # fmt: skip


def seen_at(model, p, x, y):
    """Where COLMAP says that a direction (x/z, y/z) appears: column and row from (0, 0)."""
    r = math.hypot(x, y)
    if model == "FOV":
        far = math.atan(2.0 * r * math.tan(p["omega"] / 2.0)) / p["omega"]
        u, v = x * far / r, y * far / r
    elif model == "FULL_OPENCV":
        ratio = 1 + p["k1"] * r**2 + p["k2"] * r**4 + p["k3"] * r**6
        ratio /= 1 + p["k4"] * r**2 + p["k5"] * r**4 + p["k6"] * r**6
        u = x * ratio + 2 * p["p1"] * x * y + p["p2"] * (r**2 + 2 * x**2)
        v = y * ratio + p["p1"] * (r**2 + 2 * y**2) + 2 * p["p2"] * x * y
    elif model.endswith("FISHEYE") and "PRISM" not in model:
        angle = math.atan(r)
        bent = angle
        for number in range(1, 5):
            bent += p.get(f"k{number}", 0.0) * angle ** (2 * number + 1)
        u, v = x * bent / r, y * bent / r
    else:
        if "PRISM" in model:
            x, y = x * math.atan(r) / r, y * math.atan(r) / r
            r = math.hypot(x, y)
        ratio = sum(p.get(f"k{number}", 0.0) * r ** (2 * number) for number in range(1, 5))
        u = x + x * ratio + 2 * p.get("p1", 0) * x * y + p.get("p2", 0) * (r**2 + 2 * x**2)
        v = y + y * ratio + p.get("p1", 0) * (r**2 + 2 * y**2) + 2 * p.get("p2", 0) * x * y
        u, v = u + p.get("sx1", 0.0) * r**2, v + p.get("sy1", 0.0) * r**2
    focal = p.get("f"), p.get("f")
    if "fx" in p:
        focal = p["fx"], p["fy"]
    return focal[0] * u + p["cx"] - 0.5, focal[1] * v + p["cy"] - 0.5


@pytest.mark.parametrize("model", CAMERAS)
def test_the_direction_of_a_pixel_appears_at_that_pixel(model):
    """To 1e-7 pixels, within 50 degrees of the axis; also in a copy of half the size."""
    camera = Intrinsics(model, 640, 480, CAMERAS[model])
    assert camera.distorted == ("PINHOLE" not in model)
    for x, y in ((0.0, 1e-9), (0.3, 0.1), (-0.55, 0.4), (0.6, -0.45), (-1.0, -0.6), (0.7, 0.9)):
        column, row = seen_at(model, CAMERAS[model], x, y)
        found = camera.tangents(column, row, (480, 640))
        np.testing.assert_allclose(found, (x, y), atol=2e-9)
        half = camera.tangents(column / 2 - 0.25, row / 2 - 0.25, (240, 320))
        np.testing.assert_allclose(half, (x, y), atol=2e-9)


def test_range_over_depth_is_one_over_the_cosine():
    for model, parameters in CAMERAS.items():
        camera = Intrinsics(model, 640, 480, parameters)
        ratio = camera.range_over_depth((120, 160))
        x, y = camera.tangents(150.0, 100.0, (120, 160))
        expected = 1.0 / math.cos(math.atan(math.hypot(float(x), float(y))))
        assert ratio[100, 150] == pytest.approx(expected, rel=1e-9)
        assert np.nanmin(ratio) == pytest.approx(1.0, abs=1e-4)


def test_what_a_distortion_cannot_show_is_missing():
    """r (1 + k r^2) is greatest, 2/3 r, at r = (-3 k)^-1/2; nothing appears further away."""
    camera = Intrinsics("SIMPLE_RADIAL", 640, 480, SIMPLE | {"k1": -0.5})
    at = 1.0 / math.sqrt(1.5)
    edge = 500.0 * at * 2.0 / 3.0 + 329.5
    inside, outside = (camera.tangents(edge + d, 249.5, (480, 640))
                       for d in (-0.01, 0.01))  # fmt: skip
    assert float(inside[0]) == pytest.approx(at, rel=0.01)
    assert float(inside[0]) < at
    assert np.isnan(outside).all()
    behind = Intrinsics("SIMPLE_RADIAL_FISHEYE", 640, 480, SIMPLE | {"k1": 0.0, "f": 100.0})
    assert np.isfinite(behind.tangents(329.5 + 157.0, 249.5, (480, 640))).all()
    assert np.isnan(behind.tangents(329.5 + 157.2, 249.5, (480, 640))).all()


def test_a_field_of_view_spans_the_picture():
    camera = Intrinsics.of_field_of_view(74.0, (60, 80))
    left, right = (camera.tangents(c, 29.5, (60, 80)) for c in (-0.5, 79.5))
    assert math.degrees(math.atan(float(right[0])) - math.atan(float(left[0]))) == pytest.approx(74)
    assert float(left[1]) == pytest.approx(0.0, abs=1e-15)
    below = camera.tangents(39.5, 59.5, (60, 80))
    assert float(below[1]) == pytest.approx(0.75 * float(right[0]))


def test_a_camera_fits_pictures_of_its_shape():
    camera = Intrinsics("PINHOLE", 1000, 1000, PINHOLE)
    fitting = [
        camera.fits(shape) for shape in ((1031, 1000), (1029, 1000), (971, 1000), (969, 1000))
    ]
    assert fitting == [False, True, True, False]
    assert camera.fits((300, 299))


def test_names_of_images_are_compared_without_folders_and_endings():
    assert same_name("a/IMG_1.JPG", "b\\img_1.nef")
    assert not same_name("IMG_1.JPG", "IMG_11.JPG")


def test_a_model_is_read_from_its_folder(tmp_path):
    with pytest.raises(ValueError, match=r"cameras\.bin does not exist"):
        read_intrinsics(tmp_path)
    (tmp_path / "cameras.txt").write_text("2 PINHOLE 640 480 500 480 330 250\n")
    assert read_intrinsics(tmp_path) == Intrinsics("PINHOLE", 640, 480, PINHOLE)
    given = {
        1: ("SIMPLE_PINHOLE", 640, 480, (500.0, 330.0, 250.0)),
        2: ("SIMPLE_PINHOLE", 9, 8, (1.0,) * 3),
    }
    write_cameras(tmp_path / "cameras.bin", given)
    write_images(tmp_path / "images.bin", {"x/a.jpg": 1, "x/b.jpg": 2})
    assert read_intrinsics(tmp_path, "A.tif").width == 640
    assert read_intrinsics(tmp_path / "cameras.bin", "b").width == 9
