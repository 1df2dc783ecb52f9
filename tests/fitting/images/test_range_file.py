"""Range maps: kinds, scales and cameras, and a sentence for what is no map of a photograph."""

import dataclasses
import re
import struct
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest

from fitting import Photograph, read_range
from fitting.commands import main as cli
from fitting.images.intrinsics import Intrinsics
from fitting.images.range_file import read_range_and_say
from tests.fitting.images.test_photograph_file import IMAGE, RANGE, write
from tests.oceaninv.foundation.test_colmap_file import write_cameras, write_colmap, write_images

WALL = np.full((60, 80), 5.0)  # depth along the axis


def photograph(shape=(60, 80), source="dive/IMG_7.NEF", **exif):
    values = np.full((*shape, 3), 0.5)
    return Photograph(values, values < 1, 0.0, 0.0, exif, source)


def save_range(tmp_path, name):
    path = tmp_path / name
    if name.endswith("npz"):
        np.savez(path, depth=RANGE)
    elif name.endswith("npy"):
        np.save(path, RANGE)
    elif name.endswith("bin"):
        write_colmap(path, RANGE)
    elif name.endswith("mm.tif"):
        write(path, RANGE / 65.535, "uint16")
    else:
        write(path, RANGE, "half" if "half" in name else "float")
    return path


@pytest.mark.parametrize(
    ("name", "error"),
    [("r.exr", 1e-6), ("half.exr", 4e-3), ("r.tif", 1e-6), ("mm.tif", 6e-4), ("half.tif", 4e-3),
     ("r.npz", 0), ("r.npy", 0), ("r.bin", 1e-6)],
)  # fmt: skip
def test_range_maps_in_every_form(tmp_path, name, error):
    told = {"scale": 1.0, "kind": "line"} if name.endswith("bin") else {}
    found = read_range(save_range(tmp_path, name), (12, 16), **told)
    np.testing.assert_allclose(found, RANGE, atol=error, rtol=0)


def test_ranges_of_another_size_and_missing_ones(tmp_path):
    values = np.repeat(np.arange(1.0, 101.0)[:, None], 100, axis=1)
    values[:5], values[5, 0], values[6, 0], values[7, 0] = 0.0, np.nan, np.inf, -1.0
    path = tmp_path / "r.npz"
    np.savez(path, values)
    with pytest.warns(UserWarning, match="100 x 100, the photograph 101 x 102: the map is resized"):
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


@pytest.mark.parametrize(
    ("name", "marker", "shown"),
    [("r.png", 65535, "65535"), ("r.tif", 65535, "65535"), ("r.npz", 1e10, "1e+10"),
     ("r.exr", 65504.0, "65504"), ("r.npz", 9999.0, "9999"), ("r.exr", 3.4e38, "3.4e+38")],
)  # fmt: skip
def test_markers_of_missing_ranges_are_left_out_with_their_count(tmp_path, name, marker, shown):
    path, values = tmp_path / name, RANGE.copy()
    if name in ("r.png", "r.tif"):
        values = values * 1000 / 65535
        marker = 1.0
    values[:3, :5] = marker
    if name.endswith("npz"):
        np.savez(path, values)
    else:
        write(path, values, "float" if name.endswith("exr") else "uint16")
    words = rf"15 of 192 pixels hold .*{re.escape(shown)} and are taken as missing"
    with pytest.warns(UserWarning, match=words):
        found = read_range(path, (12, 16))
    assert np.isnan(found[:3, :5]).all()
    np.testing.assert_allclose(found[3:], RANGE[3:], atol=6e-4)


@pytest.mark.parametrize(
    ("top", "others", "scale", "left_out"),
    [(101.0, 10.0, None, True), (99.0, 9.0, None, False), (200.0, 19.5, None, True),
     (200.0, 20.5, None, False), (101_000.0, 9_000.0, 0.001, True),
     (99_000.0, 9_000.0, 0.001, False)],
)  # fmt: skip
def test_a_marker_is_above_100_m_and_ten_times_all_others(tmp_path, top, others, scale, left_out):
    values = np.full((12, 16), others)
    values[3, 4] = top
    np.savez(tmp_path / "r.npz", values)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = read_range(tmp_path / "r.npz", (12, 16), scale=scale)
    assert np.isnan(found[3, 4]) == left_out == (len(said) == 1)


@pytest.mark.parametrize(("columns", "fits"), [(103, True), (104, False), (98, True), (97, False)])
def test_sides_may_differ_by_rounding_alone(tmp_path, columns, fits):
    """Ratios of sides that differ by 2.9 and 3.8 %, 2.0 and 3.1 %."""
    np.savez(tmp_path / "r.npz", np.full((100, columns), 5.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        if fits:
            assert read_range(tmp_path / "r.npz", (100, 100)).shape == (100, 100)
        else:
            with pytest.raises(ValueError, match="another shape"):
                read_range(tmp_path / "r.npz", (100, 100))


def test_a_distant_background_is_no_marker(tmp_path):
    values = np.linspace(1.0, 300.0, 192).reshape(12, 16)
    np.savez(tmp_path / "r.npz", values)
    np.testing.assert_array_equal(read_range(tmp_path / "r.npz", (12, 16)), values)


def true_range(depth, focal, centre):
    """Range of a depth along the axis at every pixel, by the angle of its line of sight."""
    rows, columns = depth.shape
    x = (np.arange(columns) + 0.5 - centre[0]) / focal[0]
    y = (np.arange(rows) + 0.5 - centre[1]) / focal[1]
    return depth / np.cos(np.arctan(np.hypot(*np.meshgrid(x, y))))


@pytest.mark.parametrize("name", ["w.bin", "w.npz"])
def test_a_wall_across_the_axis_is_further_away_in_the_corner(tmp_path, name):
    """A wall at 5 m fills a lens of 90 degrees with sides of 4 to 3: the outer corner is at
    5 m sqrt(1 + 1 + 9/16) = 8.00 m, the middle of the corner's pixel at 7.94 m."""
    path = tmp_path / name
    if name == "w.bin":
        write_colmap(path, WALL)
        found = read_range(path, photograph(), scale=1.0, intrinsics=90.0)
    else:
        np.savez(path, WALL)
        found = read_range(path, photograph(), kind="z", intrinsics=90.0)
    corner = 5.0 * np.sqrt(1.0 + (79 / 80) ** 2 + (59 / 80) ** 2)
    assert corner == pytest.approx(7.936, abs=1e-3)
    for row, column in ((0, 0), (0, 79), (59, 0), (59, 79)):
        assert found[row, column] == pytest.approx(corner, rel=1e-12)
    np.testing.assert_allclose(found, true_range(WALL, (40, 40), (40, 30)), rtol=1e-12)
    # exp(-c r) of a beam attenuation of 0.3 1/m, read as range, would be wrong by this factor.
    assert np.exp(0.3 * (corner - 5.0)) == pytest.approx(2.41, abs=0.01)


def test_the_camera_of_a_model_and_a_map_of_another_size(tmp_path):
    """The parameters of a camera of 160 x 120 pixels, scaled to a photograph of 80 x 60."""
    camera = ("PINHOLE", 160, 120, (110.0, 104.0, 83.0, 57.0))
    write_cameras(tmp_path / "cameras.bin", {3: camera})
    path = write_colmap(tmp_path / "IMG_7.JPG.geometric.bin", np.full((30, 40), 2.5))
    with pytest.warns(UserWarning, match="40 x 30, the photograph 80 x 60"):
        found = read_range(path, photograph(), scale=2.0, intrinsics=tmp_path)
    np.testing.assert_allclose(found, true_range(WALL, (55, 52), (41.5, 28.5)), rtol=1e-12)


def test_a_known_length_gives_the_scale(tmp_path):
    """Two points of a sloping floor, whose distance in space is worked out from their places."""
    focal, unit = 70.0, 0.37
    y, x = np.meshgrid(
        (np.arange(60) - 29.5) / focal, (np.arange(80) - 39.5) / focal, indexing="ij"
    )
    depth = 4.0 / (1.0 - 0.5 * x + 0.8 * y)  # of the plane z = 4 + 0.5 X - 0.8 Y
    path = write_colmap(tmp_path / "r.bin", depth / unit)
    (c1, r1), (c2, r2) = (12, 50), (70, 8)
    ends = [depth[r, c] * np.array([x[r, c], y[r, c], 1.0]) for r, c in ((r1, c1), (r2, c2))]
    length = np.linalg.norm(ends[0] - ends[1])
    camera = Intrinsics("SIMPLE_PINHOLE", 80, 60, {"f": focal, "cx": 40.0, "cy": 30.0})
    options = {"known_length": (c1, r1, c2, r2, length), "intrinsics": camera}
    found, said = read_range_and_say(path, photograph(), **options)
    np.testing.assert_allclose(found, depth * np.sqrt(1 + x**2 + y**2), rtol=3e-7)
    assert said.startswith(f"{path}: depths along the optical axis, 0.37")
    # Pixels that stand out, and missing ones beside the ends, do not matter.
    spotted = depth / unit
    spotted[r1, c1], spotted[r2, c2 + 1] = 3.0 * spotted[r1, c1], 0.0
    write_colmap(path, spotted)
    again = read_range(path, photograph(), **options)
    np.testing.assert_allclose(again[20:40, 30:50], found[20:40, 30:50], rtol=0.01)
    # The same length in a map of distances along the lines of sight.
    np.savez(tmp_path / "r.npz", depth * np.sqrt(1 + x**2 + y**2) / unit)
    again = read_range(tmp_path / "r.npz", photograph(), **options)
    np.testing.assert_allclose(again, found, rtol=3e-7)


def test_a_scale_is_metres_per_unit_of_the_file(tmp_path):
    path = write(tmp_path / "r.png", np.round(RANGE * 100) / 65535, "uint16")
    np.testing.assert_allclose(read_range(path, (12, 16), scale=0.01), RANGE, atol=0.0051)
    np.savez(tmp_path / "r.npz", RANGE)
    doubled = read_range(tmp_path / "r.npz", (12, 16), scale=2.0)
    np.testing.assert_allclose(doubled, 2.0 * RANGE, rtol=1e-12)


LENGTH = (10.0, 10.0, 70.0, 10.0, 1.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "whose unit is arbitrary: give the scale"),
        ({"scale": 1.0}, "only be turned into ranges with the camera's intrinsics"),
        ({"known_length": LENGTH}, "intrinsics"),
        ({"known_length": LENGTH, "kind": "line"}, "a known length can only be turned"),
        ({"scale": 1.0, "known_length": LENGTH}, "contradict each other"),
        ({"scale": 0.0, "intrinsics": 90.0}, "the scale is 0 m per unit"),
        ({"scale": -1.0, "intrinsics": 90.0}, "the scale is -1 m per unit"),
        ({"scale": np.nan, "intrinsics": 90.0}, "the scale is nan m per unit"),
        ({"scale": np.inf, "intrinsics": 90.0}, "the scale is inf m per unit"),
        ({"scale": 1e308, "intrinsics": 90.0}, "no ranges that can be used"),
        ({"scale": 5e-324, "kind": "line", "intrinsics": None}, None),
        ({"scale": 1.0, "kind": "depth"}, "the kind of range is 'depth'"),
        ({"scale": 1.0, "intrinsics": 0.0}, "the field of view is 0 degrees"),
        ({"scale": 1.0, "intrinsics": 180.0}, "the field of view is 180 degrees"),
        ({"scale": 1.0, "intrinsics": np.nan}, "the field of view is nan degrees"),
        ({"known_length": (*LENGTH[:4], 0.0), "intrinsics": 90.0}, "the known length is 0 m"),
        ({"known_length": (*LENGTH[:4], -2.0), "intrinsics": 90.0}, "the known length is -2 m"),
        ({"known_length": (*LENGTH[:4], np.nan), "intrinsics": 90.0}, "is five numbers"),
        ({"known_length": (10, 10, 80, 10, 1.0), "intrinsics": 90.0}, "ends at 80,10, outside"),
        ({"known_length": (10, 10, 10, 10, 1.0), "intrinsics": 90.0}, "ends at the same point"),
        ({"known_length": (2, 2, 10, 10, 1.0), "intrinsics": 90.0}, "no range at 2,2"),
        ({"scale": 1.0, "intrinsics": "none.bin"}, "none.bin does not exist"),
    ],
)  # fmt: skip
def test_what_is_missing_or_out_of_range_is_a_sentence(tmp_path, options, words):
    depth = WALL.copy()
    depth[:5, :5] = 0.0
    path = write_colmap(tmp_path / "r.bin", depth)
    if words is None:
        assert np.nanmin(read_range(path, photograph(), **options)) > 0
        return
    with pytest.raises(ValueError, match=words):
        read_range(path, photograph(), **options)


def test_the_stated_focal_length_is_told_where_a_camera_is_needed(tmp_path):
    """24 mm on film of 36 x 24 mm: 2 asin 0.6 = 73.74 degrees in air, 2 asin(0.6 / 1.34) =
    53.20 behind a flat port."""
    path = write_colmap(tmp_path / "r.bin", np.full((40, 60), 5.0))
    words = (
        r"states a focal length that gives 73\.7 degrees in air .* some 53\.2 behind a flat port"
    )
    with pytest.raises(ValueError, match=words):
        read_range(path, photograph((40, 60), FocalLengthIn35mmFilm=24), scale=1.0)


def test_a_map_of_another_photograph_is_refused(tmp_path):
    other = write_colmap(tmp_path / "IMG_8.JPG.photometric.bin", WALL)
    with pytest.raises(ValueError, match=r"is the map of IMG_8\.JPG, not of IMG_7\.NEF"):
        read_range(other, photograph(), scale=1.0, intrinsics=90.0)
    turned = write_colmap(tmp_path / "r.bin", WALL.T)
    with pytest.raises(ValueError, match="another shape"):
        read_range(turned, photograph(), scale=1.0, intrinsics=90.0)
    camera = Intrinsics("SIMPLE_PINHOLE", 60, 80, {"f": 40.0, "cx": 30.0, "cy": 40.0})
    own = write_colmap(tmp_path / "img_7.jpg.geometric.bin", WALL)
    with pytest.raises(ValueError, match="the camera's pictures are 60 x 80, the photograph 80 x"):
        read_range(own, photograph(), scale=1.0, intrinsics=camera)
    assert np.isfinite(read_range(own, photograph(), scale=1.0, intrinsics=90.0)).all()


def test_of_several_cameras_that_which_took_the_photograph(tmp_path):
    cameras = {1: ("SIMPLE_PINHOLE", 80, 60, (40.0, 40.0, 30.0)),
               4: ("SIMPLE_PINHOLE", 80, 60, (90.0, 40.0, 30.0))}  # fmt: skip
    write_cameras(tmp_path / "cameras.bin", cameras)
    path = write_colmap(tmp_path / "IMG_7.JPG.geometric.bin", WALL)
    options = {"scale": 1.0, "intrinsics": tmp_path / "cameras.bin"}
    with pytest.raises(ValueError, match=r"holds 2 cameras: put the images\.bin"):
        read_range(path, photograph(), **options)
    write_images(tmp_path / "images.bin", {"a/IMG_6.JPG": 1, "b/IMG_7.JPG": 4})
    found = read_range(path, photograph(), **options)
    np.testing.assert_allclose(found, true_range(WALL, (90, 90), (40, 30)), rtol=1e-12)
    write_images(tmp_path / "images.bin", {"a/IMG_6.JPG": 1})
    with pytest.raises(ValueError, match=r"holds no image of the name IMG_7\.JPG"):
        read_range(path, photograph(), **options)
    write_images(tmp_path / "images.bin", {"a/IMG_7.JPG": 1, "b/IMG_7.JPG": 4})
    with pytest.raises(ValueError, match="images of several cameras"):
        read_range(path, photograph(), **options)
    write_images(tmp_path / "images.bin", {"IMG_7.JPG": 9})
    with pytest.raises(ValueError, match="holds no camera 9"):
        read_range(path, photograph(), **options)


def test_distortion_belongs_to_maps_of_original_photographs(tmp_path):
    camera = Intrinsics("SIMPLE_RADIAL", 80, 60, {"f": 40.0, "cx": 40.0, "cy": 30.0, "k1": -0.08})
    dense = write_colmap(tmp_path / "r.bin", WALL)
    with pytest.raises(ValueError, match="is of an undistorted picture, but the camera"):
        read_range(dense, photograph(), scale=1.0, intrinsics=camera)
    np.savez(tmp_path / "r.npz", WALL)
    found = read_range(tmp_path / "r.npz", photograph(), kind="z", intrinsics=camera)
    u, v = 0.8, 0.45  # a direction; where it appears, by the model's own formula
    bent = 1.0 - 0.08 * (u * u + v * v)
    column, row = 40.0 * u * bent + 39.5, 40.0 * v * bent + 29.5
    left, above = int(column), int(row)
    s, t = column - left, row - above
    seen = (1 - t) * ((1 - s) * found[above, left] + s * found[above, left + 1]) + t * (
        (1 - s) * found[above + 1, left] + s * found[above + 1, left + 1]
    )
    assert seen == pytest.approx(5.0 * np.sqrt(1 + u * u + v * v), rel=3e-4)
    strong = dataclasses.replace(camera, parameters={**camera.parameters, "k1": -0.25})
    with pytest.warns(UserWarning, match="pixels lie beyond what the camera's distortion can show"):
        cut = read_range(tmp_path / "r.npz", photograph(), kind="z", intrinsics=strong)
    assert np.isnan(cut[0, 0])
    assert np.isfinite(cut[30]).any()


def test_intrinsics_that_are_not_used_are_told(tmp_path):
    np.savez(tmp_path / "r.npz", WALL)
    with pytest.warns(UserWarning, match="is taken as distances along the line of sight"):
        found = read_range(tmp_path / "r.npz", photograph(), intrinsics=90.0)
    np.testing.assert_array_equal(found, WALL)


def test_commands_take_colmap_maps(tmp_path, capsys):
    folder = tmp_path / "dive"
    folder.mkdir()
    picture = write(folder / "a.png", np.tile(IMAGE, (2, 2, 1)), "uint16")
    depth = np.tile(RANGE, (2, 2))
    ranges = write_colmap(folder / "a.jpg.geometric.bin", depth)
    write_cameras(folder / "cameras.bin", {1: ("PINHOLE", 32, 24, (30.0, 30.0, 16.0, 12.0))})
    command = ["check", str(picture), "--range-map", str(ranges)]
    model = ["--intrinsics", str(folder)]
    assert cli.run([*command, *model, "--range-scale", "0.5"]) in (0, 1)
    said = capsys.readouterr()
    assert "depths along the optical axis, 0.5 m a unit" in said.out
    assert said.err == ""
    charts = ["read-charts", str(picture), "-o", str(folder / "out"), "--chart",
              "A DGK18 map 4,4 28,4 28,20 4,20", "--range-map", str(ranges)]  # fmt: skip
    for given, words in (
        ([*command], "whose unit is arbitrary"),
        ([*command, *model, "--range-scale", "nan"], "the scale is nan"),
        ([*command, *model, "--known-length", "1,1,2,2"], 'write "x1,y1,x2,y2,METRES"'),
        ([*command, *model, "--fov", "90", "--range-scale", "1"], "contradict each other"),
        ([*command, "--range-scale", "1", "--range-kind", "far"], "'far'"),
        (["check", str(picture), "--fov", "90"], "belong to a --range-map"),
        ([*charts, "--range-scale", "1"], "intrinsics"),
        ([*charts, "--range-scale", "1", "--intrinsics", str(tmp_path)], "does not exist"),
    ):
        assert cli.run(given) == 3
        assert words in capsys.readouterr().err
    assert sorted(path.name for path in folder.iterdir()) == [
        "a.jpg.geometric.bin", "a.png", "cameras.bin"]  # fmt: skip


def test_a_header_of_terabytes_allocates_nothing(tmp_path):
    """Maps that claim 10^12 numbers are refused before memory is asked for them."""
    sizes = b"1000000&1000000&1&"
    colmap, numpy_map = tmp_path / "r.bin", tmp_path / "r.npz"
    colmap.write_bytes(sizes + bytes(1000))
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }"
    with zipfile.ZipFile(numpy_map, "w") as archive:
        archive.writestr(
            "a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(1000)
        )
    tracemalloc.start()
    try:
        for path, words in ((colmap, "cut short"), (numpy_map, "claims an array of shape")):
            with pytest.raises(ValueError, match=words):
                read_range(path, photograph(), scale=1.0, intrinsics=90.0)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_reading_takes_bounded_memory(tmp_path):
    """At most 30 bytes a pixel at once, the result of 8 included."""
    path = write_colmap(tmp_path / "r.bin", np.full((600, 800), 5.0))
    shot = photograph((600, 800))
    camera = {"f": 700.0, "cx": 400.0, "cy": 300.0, "k1": -0.05}
    np.savez(tmp_path / "r.npz", np.full((600, 800), 5.0, dtype=np.float32))
    distorted = Intrinsics("SIMPLE_RADIAL", 800, 600, camera)
    for options in (
        {"path": path, "scale": 1.0, "intrinsics": 60.0},
        {"path": tmp_path / "r.npz", "kind": "z", "intrinsics": distorted},
    ):
        tracemalloc.start()
        try:
            read_range(options.pop("path"), shot, **options)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < 30 * 600 * 800


@pytest.mark.parametrize("kind", ["r.bin", "r.npz", "r.exr", "r.tif"])
def test_mutated_maps_are_read_or_a_sentence(tmp_path, kind):
    """200 files with bytes changed at random: positive or missing ranges, or ValueError."""
    rng = np.random.default_rng(3)
    path = save_range(tmp_path, kind)
    whole = path.read_bytes()
    for _ in range(200):
        changed = bytearray(whole)
        for place in rng.integers(0, min(len(whole), 400), rng.integers(1, 6)):
            changed[place] = rng.integers(0, 256)
        path.write_bytes(bytes(changed[: rng.integers(len(whole) // 2, len(whole) + 100)]))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                found = read_range(path, (12, 16), kind="z", scale=1.0, intrinsics=60.0)
        except ValueError as error:
            assert str(path) in str(error)  # noqa: PT017
        else:
            assert found.shape == (12, 16)
            assert np.all(np.isnan(found) | ((found > 0) & np.isfinite(found)))
