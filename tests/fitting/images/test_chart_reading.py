"""Charts in photographs: patches by four corners, orientation, clipping, the csv they become."""

import dataclasses

import numpy as np
import pytest
from matplotlib.path import Path as Outline

import fitting.commands.main as cli
import oceaninv as oi
from fitting import Photograph, read_photograph
from fitting.images.chart_detection import find_charts
from fitting.images.chart_reading import overlay, perspective, read_chart
from fitting.images.chart_targets import target
from fitting.images.photo_csv import read_photo
from fitting.observations.photo import WAVELENGTH
from tests.fitting.images.test_photograph_file import write

CORNERS = np.array([[31.0, 22.0], [151.0, 35.0], [143.0, 118.0], [22.0, 97.0]])


def painted(name="ColorChecker24", clip=1.0):
    """A picture of a chart in perspective, 0.1 + 0.7 x reflectance, and its patches' values."""
    chart = target(name)
    weights = np.asarray(oi.spectrum.generic_camera().weights(WAVELENGTH))
    values = np.minimum(
        0.1 + 0.7 * chart.reflectance @ (weights / weights.sum(axis=1)[:, None]).T, clip
    )
    picture = np.full((140, 180, 3), 0.02)
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    y, x = np.mgrid[0:140, 0:180]
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    for value, centre, size in zip(values, chart.centre, chart.size, strict=True):
        polygon = perspective(CORNERS)(centre + square * size)
        picture[Outline(polygon).contains_points(points).reshape(140, 180)] = value
    rng = np.random.default_rng(0)
    picture = picture * (1 + 0.002 * rng.standard_normal(picture.shape))
    return Photograph(picture, picture < 1, 0.0, 0.0, {}, "painted"), values


@pytest.mark.parametrize("name", ["ColorChecker24", "DGK18"])
def test_patches_are_read_where_the_perspective_puts_them(name):
    photo, values = painted(name)
    found = read_chart(photo, CORNERS, name)
    np.testing.assert_allclose(found.values, values, rtol=2e-3)
    assert not found.clipped.any()
    assert np.all(found.pixels >= 30)
    # Standard error of the mean of pixels of 0.2 %.
    np.testing.assert_allclose(found.sd * np.sqrt(found.pixels)[:, None], 0.002 * values, rtol=0.45)
    chart = found.chart(2.0, noise=0.03)
    assert len(chart.values) == (24 if name == "ColorChecker24" else 16)
    np.testing.assert_allclose(
        chart.sigma, np.hypot(found.sd, 0.03 * values)[found.kept], rtol=5e-3
    )


def test_the_perspective_takes_the_unit_square_to_its_corners():
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    np.testing.assert_allclose(perspective(CORNERS)(unit), CORNERS, rtol=1e-12)
    # Diagonals meet where the centre goes, in any perspective.
    a, b = CORNERS[2] - CORNERS[0], CORNERS[3] - CORNERS[1]
    along = np.linalg.solve(np.stack([a, -b], axis=1), CORNERS[1] - CORNERS[0])[0]
    middle = perspective(CORNERS)(np.array([[0.5, 0.5]]))[0]
    np.testing.assert_allclose(middle, CORNERS[0] + along * a, rtol=1e-12)


@pytest.mark.parametrize("name", ["ColorChecker24", "DGK18"])
@pytest.mark.parametrize(
    ("order", "words"),
    [((2, 3, 0, 1), "turned by 180"), ((1, 0, 3, 2), "left-right"), ((3, 2, 1, 0), "top-bottom")],
)
def test_a_chart_that_is_turned_or_mirrored_is_refused(name, order, words):
    photo, _ = painted(name)
    with pytest.raises(ValueError, match=words):
        read_chart(photo, CORNERS[list(order)], name)


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        (CORNERS[:3], "four points"),
        (CORNERS + 100.0, "outside the picture of 180 x 140"),
        (CORNERS[[0, 2, 1, 3]], "must go around the chart"),
    ],
)
def test_bad_corners_are_a_sentence(corners, words):
    with pytest.raises(ValueError, match=words):
        read_chart(painted()[0], corners, "ColorChecker24")
    with pytest.raises(ValueError, match=r"ColorCheker.*ColorChecker24"):
        target("ColorCheker")


def test_clipped_patches_are_dropped_and_counted():
    photo, _ = painted(clip=0.5)
    hidden = read_chart(photo, CORNERS, "ColorChecker24")
    # Two greys, and the colours that reach as high, stop at 0.5, which no full scale gives away.
    assert hidden.clipped[[18, 19]].all()
    assert not hidden.clipped[[20, 21, 22, 23]].any()
    assert f"{hidden.clipped.sum()} clipped" in hidden.message()
    full = dataclasses.replace(photo, mask=photo.values < 0.49)
    assert read_chart(full, CORNERS, "ColorChecker24").clipped[18]


def test_a_chart_of_ones_own_is_a_csv(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("# rows: 1\n# columns: 2\nwavelength,a,b\n390,0.1,0.9\n710,0.1,0.5\n")
    mine = target(path)
    assert mine.neutral.tolist() == [True, False]
    np.testing.assert_allclose(mine.reflectance[1], 0.9 - 0.4 * (WAVELENGTH - 390) / 320)
    np.testing.assert_allclose(mine.centre, [[0.25, 0.5], [0.75, 0.5]])
    for text, words in (
        ("wavelength,a\n390,0.1\n710,0.1\n", "how the 1 patches are laid out"),
        ("# rows: 1\n# columns: 1\nwavelength,a\n450,0.1\n710,0.1\n", "cover 409-691 nm"),
        ("# rows: 1\n# columns: 1\nwavelength,a\n390,1.7\n710,0.1\n", "between 0 and 1.5"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=words):
            target(path)


def test_the_command_writes_what_the_fit_reads(tmp_path, capsys):
    photo, values = painted()
    file = write(tmp_path / "a b.png", photo.values, "uint16")
    corners = " ".join(f"{x:g},{y:g}" for x, y in CORNERS)
    arguments = ["read-charts", str(file), "-o", str(tmp_path / "out")]
    chart = ["--chart", f"near ColorChecker24 2.5 {corners}"]
    water = ["--background", "2,125 170,138 95"]
    assert cli.run([*arguments, *chart, *water]) == 0
    said = capsys.readouterr().out
    assert "near at 2.50 m: ColorChecker24: 24 of 24 patches kept" in said
    assert "camera: generic, for the file names no camera" in said
    assert (tmp_path / "out_patches.png").stat().st_size > 10_000
    read, clipped = read_photo(tmp_path / "out.csv", 5.0)
    assert clipped == 0
    np.testing.assert_allclose(read.charts[0].values, values, rtol=3e-3)
    np.testing.assert_allclose(read.charts[0].reflectance, target("ColorChecker24").reflectance)
    assert read.charts[0].distance == 2.5
    assert read.backgrounds[0].zenith.tolist() == [95.0]
    np.testing.assert_allclose(read.backgrounds[0].values, 0.02, rtol=3e-3)
    again = ["--chart", f"far ColorChecker24 4 {corners}", "--zenith", "92", "--zenith", "97"]
    assert cli.run([*arguments, *chart, *again, "--camera", "Nikon D200"]) == 0
    assert "camera: Nikon D200\n" in capsys.readouterr().out
    read, _ = read_photo(tmp_path / "out.csv", 5.0)
    assert [one.zenith for one in read.charts] == [92.0, 97.0]
    for bad in (
        [*chart, "--zenith", "80", "--zenith", "90"],
        [*chart, "--background", "100,0 20,10"],
        ["--chart", "near ColorChecker24 2.5 1,2 3,4"],
        ["--chart", f"near ColorChecker24 map {corners}"],
    ):
        again = ["read-charts", str(file), "-o", str(tmp_path / "bad"), *bad]
        assert cli.run(again) == 3
        assert not (tmp_path / "bad.csv").exists()


def on_the_ground(
    turned, size=(334, 500), light=(0.20, 0.55, 0.45), ground=0.3, seed=0,
    name="ColorChecker24", filled=0.86,
):  # fmt: skip
    """A linear picture without white balance: a chart with borders lies on rough ground in uneven
    light, beside glaring things.

    `filled`: share of its place that a patch fills; the rest is board.

    Returns the photograph and the corners of the patches.
    """
    chart = target(name)
    weights = np.asarray(oi.spectrum.generic_camera().weights(WAVELENGTH))
    values = chart.reflectance @ (weights / weights.sum(axis=1)[:, None]).T
    rng = np.random.default_rng(seed)
    rows, columns = size
    y, x = np.mgrid[:rows, :columns]
    rough = 0.06 * np.repeat(np.repeat(rng.standard_normal((rows // 2, columns // 2)), 2, 0), 2, 1)
    picture = np.repeat((ground + rough)[:, :, None], 3, axis=2)
    angle = np.deg2rad(turned)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    across = 0.5 * columns * np.array([[-0.5, -0.34], [0.5, -0.36], [0.54, 0.34], [-0.52, 0.36]])
    corners = across @ turn + [0.5 * columns, 0.47 * rows]
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    placed = perspective(corners)
    board = Outline(placed(0.5 + 1.12 * square)).contains_points(points).reshape(rows, columns)
    picture[board] = 0.035
    for value, centre, extent in zip(values, chart.centre, chart.size, strict=True):
        outline = placed(centre + filled * square * extent)
        picture[Outline(outline).contains_points(points).reshape(rows, columns)] = value
    for column, row in ((30, 40), (columns - 30, rows - 50), (45, rows - 40)):
        picture[(x - column) ** 2 + (y - row) ** 2 < 200] = 2.0
    picture = np.clip(picture, 0.003, None) * np.array(light)
    picture = picture * (1.0 + 0.2 * (x / columns - 0.5))[:, :, None]
    picture += 0.002 * rng.standard_normal(picture.shape)
    return Photograph(picture, picture > 0, 0.0, 0.0, {}, "made"), corners


@pytest.mark.parametrize(
    ("turned", "light"),
    [(0.0, (0.20, 0.55, 0.45)), (12.0, (0.1, 0.4, 0.5)), (187.0, (0.20, 0.55, 0.45))],
)
def test_a_chart_is_found_in_a_linear_picture_without_white_balance(turned, light):
    photo, corners = on_the_ground(turned, light=light)
    (found,) = find_charts(photo)
    assert np.abs(found - corners).max() < 5.0  # a patch is 40 pixels wide
    reading = read_chart(photo, found, "ColorChecker24")
    truth = read_chart(photo, corners, "ColorChecker24")
    assert reading.kept.all()
    np.testing.assert_allclose(reading.values, truth.values, rtol=0.05)


@pytest.mark.parametrize(
    ("turned", "filled"),
    [(187.0, 1.0), pytest.param(95.0, 0.86, marks=pytest.mark.slow),
     pytest.param(0.0, 0.86, marks=pytest.mark.slow)],
)  # fmt: skip
def test_a_chart_with_high_greys_is_found(turned, filled):
    """The greys of a DGK18 fill two rows of the grid of its squares; its patches touch."""
    side = 500 if turned == 95.0 else 334
    photo, corners = on_the_ground(turned, (side, 500), name="DGK18", filled=filled)
    (found,) = find_charts(photo, "DGK18")
    assert np.abs(found - corners).max() < 6.0  # a patch is 40 pixels wide
    reading = read_chart(photo, found, "DGK18")
    truth = read_chart(photo, corners, "DGK18")
    np.testing.assert_allclose(reading.values, truth.values, rtol=0.05, atol=2e-4)
    if turned == 187.0:
        with pytest.raises(ValueError, match="cannot be found, only ColorChecker24 and DGK18"):
            find_charts(photo, "own.csv")


def test_two_charts_are_found_the_larger_first():
    photos = [on_the_ground(0.0, seed=1)[0], on_the_ground(5.0, (250, 376), seed=2)[0]]
    picture = np.full((334, 876, 3), 0.02)
    picture[:, :500], picture[:250, 500:] = photos[0].values, photos[1].values
    found = find_charts(Photograph(picture, picture > 0, 0.0, 0.0, {}, "made"))
    assert len(found) == 2
    assert found[0].mean(axis=0)[0] < 500 < found[1].mean(axis=0)[0]


@pytest.mark.slow
@pytest.mark.parametrize("turn", [0, 1, 2])
def test_a_chart_is_found_in_any_orientation(turn, tmp_path, capsys):
    chart = target("ColorChecker24")
    weights = np.asarray(oi.spectrum.generic_camera().weights(WAVELENGTH))
    values = chart.reflectance @ (weights / weights.sum(axis=1)[:, None]).T
    picture = np.full((480, 640, 3), 0.15)
    picture[80:380, 100:540] = 0.03  # the board, with gaps of 10 pixels between patches
    for k, value in enumerate(values):
        row, column = 90 + 72 * (k // 6), 110 + 71 * (k % 6)
        picture[row : row + 62, column : column + 61] = value
    picture = picture * np.array([0.3, 1.0, 0.9])  # water
    picture *= 1 + 0.005 * np.random.default_rng(0).standard_normal(picture.shape)
    picture = np.ascontiguousarray(np.rot90(picture, turn))
    photo = Photograph(picture, picture < 1, 0.0, 0.0, {}, "painted")
    (corners,) = find_charts(photo)
    found = read_chart(photo, corners, "ColorChecker24")
    np.testing.assert_allclose(found.values, values * np.array([0.3, 1.0, 0.9]), rtol=0.03)
    with pytest.raises(ValueError, match=r"(mirrored|turned)"):
        read_chart(photo, corners[::-1], "ColorChecker24")
    empty = dataclasses.replace(photo, values=np.full_like(picture, 0.2))
    with pytest.raises(ValueError, match="no ColorChecker24 was found"):
        find_charts(empty)
    file = write(tmp_path / "a.png", picture, "uint16")
    command = ["read-charts", str(file), "-o", str(tmp_path / "out"), "--chart"]
    assert cli.run([*command, "a ColorChecker24 2 find"]) == 0
    assert "24 of 24 patches kept" in capsys.readouterr().out
    assert cli.run([*command, "a DGK18 2 find"]) == 3
    assert "no DGK18 was found" in capsys.readouterr().err


# Four small charts as a diver's frame shows them: range (m), light on the chart, corners.
PLACES = {
    "A": (4.7, 9.0, [[87.5, 98.0], [124.0, 100.0], [122.5, 121.0], [85.5, 119.5]]),
    "B": (6.2, 1.9, [[171.5, 90.5], [198.5, 94.0], [197.5, 109.5], [170.5, 106.5]]),
    "C": (7.4, 2.0, [[56.5, 63.5], [79.5, 64.5], [78.5, 78.5], [55.5, 77.0]]),
    "D": (9.8, 2.4, [[118.5, 56.5], [135.5, 57.0], [135.5, 68.5], [119.0, 67.5]]),
}


def frame(folder):
    """A frame of four charts in haze, clipped before white balance, and the truth for each chart.

    The raw channels stop at 1; the white balance then brings that to 0.5-0.9, and noise of 0.5 %
    and rounding to 8 bits follow.  The truth: developed values without clipping (patch, channel),
    and at which patches a raw channel was clipped.
    """
    chart = target("DGK18")
    weights = np.asarray(oi.spectrum.generic_camera().weights(WAVELENGTH))
    reflectance = chart.reflectance @ (weights / weights.sum(axis=1)[:, None]).T
    balance = np.array([0.50, 0.90, 0.79])
    attenuation = np.array([0.25, 0.10, 0.08])
    haze = np.array([0.05, 0.20, 0.24])
    y, x = np.mgrid[0:160, 0:240]
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    raw, truth = np.broadcast_to(haze, (160, 240, 3)).copy(), {}
    for name, (distance, light, corners) in PLACES.items():
        through = np.exp(-attenuation * distance)
        values = haze * (1 - through) + light * reflectance * through
        placed = perspective(np.array(corners))
        for value, centre, size in zip(values, chart.centre, chart.size, strict=True):
            inside = Outline(placed(centre + square * size)).contains_points(points)
            raw[inside.reshape(160, 240)] = value
        truth[name] = values * balance, np.any(values > 1, axis=1)
    developed = np.minimum(raw, 1) * balance
    developed *= 1 + 0.005 * np.random.default_rng(0).standard_normal(developed.shape)
    return write(folder / "frame.png", developed, "uint8"), truth


def test_small_charts_in_a_frame_that_hides_its_clipping(tmp_path):
    file, truth = frame(tmp_path)
    photo = read_photograph(file, "linear")
    assert photo.values.max() < 0.97
    assert photo.mask.all()
    found = {name: read_chart(photo, place[2], "DGK18") for name, place in PLACES.items()}
    lost = truth["A"][1]
    assert lost[:6].tolist() == [True, True, True, False, False, False]
    # Every patch that lost light is left out, and of the greys no other one.
    assert found["A"].clipped[lost].all()
    assert found["A"].clipped[:6].tolist() == lost[:6].tolist()
    for name in "BCD":
        assert not truth[name][1].any()
        assert not found[name].clipped.any()
    for name, reading in found.items():
        values = truth[name][0]
        kept = ~reading.clipped
        # Half a step of 8 bits, and noise of few pixels.
        allowed = 0.5 / 255 + 0.012 * values[kept]
        assert np.all(np.abs(reading.values[kept] - values[kept]) < allowed), name
    overlay(photo, list(found.values()), tmp_path / "where.png")
    assert (tmp_path / "where.png").stat().st_size > 20_000
    with pytest.raises(ValueError, match="turned by 180"):
        read_chart(photo, np.roll(PLACES["B"][2], 2, axis=0), "DGK18")
