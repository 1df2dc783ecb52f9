"""Quality checks: clipping below full scale found on the real frame and not on straight charts;
colours; pictures and range maps."""

import numpy as np
import pytest

import fitting.commands.main as cli
import oceaninv as oi
from fitting import Photograph
from fitting.files.csv_sheet import read_sheet
from fitting.images.chart_targets import target
from fitting.images.quality_checks import linearity, of_chart, of_picture, of_range
from fitting.observations.photo import WAVELENGTH
from tests.paths import SCENES

CHARTS = SCENES / "red_sea_charts.csv"


def chart(name):
    sheet = read_sheet(CHARTS)
    rows = np.array([found == name for found in sheet.texts("chart")])
    values = np.stack([sheet.numbers(c) for c in "RGB"], axis=1)[rows]
    return values, sheet.numbers("reflectance")[rows], sheet.numbers("clipped")[rows] == 1


@pytest.mark.parametrize("name", "ABCD")
def test_the_clipped_patches_of_the_real_frame_are_found_and_no_others(name):
    values, reflectance, clipped = chart(name)
    assert np.array_equal(linearity(values, reflectance).clipped, clipped)


def test_the_near_chart_of_the_real_frame_is_clipped_below_full_scale():
    values, reflectance, _ = chart("A")
    assert values.max() < 1
    found = linearity(values, reflectance)
    assert found.r2.max() < 0.66
    assert found.r2_kept.min() > 0.99
    assert found.message().startswith("3 of 6 patches are clipped")


def test_the_straight_chart_of_the_real_frame_is_left_alone():
    values, reflectance, _ = chart("C")
    assert not linearity(values, reflectance).clipped.any()
    assert "R2 0.99" in linearity(values, reflectance).message()


def test_noise_is_no_clipping():
    rng = np.random.default_rng(0)
    reflectance = np.array([0.9, 0.5, 0.2, 0.1, 0.05])
    for _ in range(50):
        values = (0.1 + reflectance[:, None]) * (1 + 0.005 * rng.standard_normal((5, 3)))
        assert not linearity(values, reflectance).clipped.any()


def test_too_few_patches_are_a_sentence():
    with pytest.raises(ValueError, match="at least 4 patches"):
        linearity(np.ones((3, 3)), np.ones(3))


def colour_chart(camera="Nikon D810", light=(0.5, 1.0, 0.8), veil=0.05):
    """Linear values of a ColorChecker: veil + light x what the camera sees of each patch."""
    chart = target("ColorChecker24")
    weights = np.asarray(oi.spectrum.camera_response(camera).weights(WAVELENGTH))
    seen = chart.reflectance @ (weights / weights.sum(axis=1)[:, None]).T
    rng = np.random.default_rng(3)
    return (veil + 0.8 * seen * np.array(light)) * (1 + 0.005 * rng.standard_normal(seen.shape))


def checks_of(values, camera="Nikon D810"):
    chart = target("ColorChecker24")
    expected = colour_chart(camera, (1, 1, 1), 0.0)
    return of_chart(values, chart.brightness, chart.neutral, expected, np.zeros(24, bool), "A")


@pytest.mark.parametrize("camera", ["Nikon D810", "Canon EOS 5D Mark II"])
def test_a_linear_colour_chart_has_no_problem(camera):
    """Values are straight in mean reflectance for greys alone (R2 of all 24: 0.6-0.8)."""
    values = colour_chart(camera)
    assert linearity(values, target("ColorChecker24").brightness).clipped.sum() > 10
    checks = checks_of(values)
    assert [passed for passed, _ in checks] == [True, True]
    assert checks[0].message == "chart A: straight in reflectance, R2 1.000"
    assert checks[1].message.startswith("chart A: 18 colours scatter by")


def test_clipping_of_greys_and_of_colours_is_told_apart():
    values = colour_chart()
    clipped = np.minimum(values, 0.25)
    first, *_ = checks_of(clipped)
    assert not first.passed
    # The two brightest greys reach 0.25 in green, and these colours with them.
    assert "of 6 patches are clipped below full scale" in first.message
    assert "colours are as bright as these" in first.message
    shaded = values.copy()
    shaded[11] *= 0.6
    grey, colour = checks_of(shaded)
    assert grey.passed
    assert "patch 12 falls short of it" in colour.message
    assert not colour.passed
    turned = values.copy()
    turned[:18] = values[17::-1]
    assert "wrong order" in checks_of(turned)[1].message


def test_check_judges_readings_of_colours_by_their_target(tmp_path, capsys):
    chart, values = target("ColorChecker24"), colour_chart()
    head = "# units: range=m\n# camera: Nikon D810\n"
    head += "kind,chart,target,patch,reflectance,range,R,G,B,clipped\n"
    rows = [
        f"chart,A,ColorChecker24,{i + 1},{grey:.4f},1.5,{r:.5f},{g:.5f},{b:.5f},0\n"
        for i, (grey, (r, g, b)) in enumerate(zip(chart.brightness, values, strict=True))
    ]
    path = tmp_path / "colours.csv"
    path.write_text(head + "".join(rows))
    assert cli.run(["check", str(path)]) == 0
    said = capsys.readouterr().out
    assert "straight in reflectance, R2 1.000" in said
    assert "18 colours scatter by" in said
    path.write_text(head + "".join(rows[:12]))
    assert cli.run(["check", str(path)]) == 0
    assert "0 grey patches, too few to judge linearity" in capsys.readouterr().out


def picture(values, **exif):
    return Photograph(values, values > 0, 0.0, 0.0, exif, "made")


def problems(checks):
    return [text for passed, text in checks if not passed]


def test_pictures_are_judged_channel_by_channel():
    values = np.random.default_rng(2).uniform(0.02, 0.7, (80, 90, 3))
    assert problems(of_picture(picture(values, Flash=16))) == []
    dark = values.copy()
    dark[:8, :, 0] = 0.0
    (text,) = problems(of_picture(picture(dark)))
    assert text.startswith("R: 10.00 % at or below zero")
    assert "lower its black level" in text
    # Outside of an EXR's data window nothing is known, and nothing is dark.
    windowed = values.copy()
    windowed[:40] = np.nan
    assert problems(of_picture(picture(windowed))) == []
    assert "50.00 % without a value" in of_picture(picture(windowed))[0].message
    full = values.copy()
    full[:2, :, 1] = 1.0
    assert "expose less" in problems(of_picture(picture(full)))[0]
    # 2 x 90 pixels at the top and 3 x 4 below them, which touch nothing.
    full[10:13, 20:24, 1] = 1.0
    where = "2 regions, the largest of 180 pixels around column 44, row 0"
    assert where in problems(of_picture(picture(full)))[0]
    # Clipped, then darkened by half: the brightest values are a spike.
    hidden = np.minimum(values, 0.6)
    assert all("all alike at 0.600" in text for text in problems(of_picture(picture(hidden))))
    assert len(problems(of_picture(picture(hidden)))) == 3
    assert "flash fired" in problems(of_picture(picture(values, Flash=9)))[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: 1000.0 * r, "these look like millimetres"),
        (lambda r: 100.0 * r, "these look like centimetres"),
        (lambda r: r / 1000.0, "these look like kilometres"),
        (lambda r: np.where(np.arange(r.size).reshape(r.shape) % 3, np.nan, r), "most is missing"),
        (lambda r: np.nan * r, "give the ranges"),
        (lambda r: -r, "give the ranges"),
    ],
)
def test_ranges_in_other_units_and_missing_ones_are_problems(change, words):
    distance = np.random.default_rng(3).uniform(2.0, 9.0, (20, 30))
    assert of_range(distance)[0][0]
    (text,) = problems(of_range(change(distance)))
    assert words in text
