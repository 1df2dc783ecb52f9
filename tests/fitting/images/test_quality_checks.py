"""Verdicts: hidden clipping found on the real frame, not invented on straight charts; pictures and
range maps."""

import numpy as np
import pytest

from fitting import Photograph
from fitting.files.csv_sheet import read_sheet
from fitting.images.quality_checks import linearity, of_picture, of_range
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
    assert found.sentence().startswith("3 of 6 patches are clipped")


def test_the_straight_chart_of_the_real_frame_is_left_alone():
    values, reflectance, _ = chart("C")
    assert not linearity(values, reflectance).clipped.any()
    assert "R2 0.99" in linearity(values, reflectance).sentence()


def test_noise_is_no_clipping():
    rng = np.random.default_rng(0)
    reflectance = np.array([0.9, 0.5, 0.2, 0.1, 0.05])
    for _ in range(50):
        values = (0.1 + reflectance[:, None]) * (1 + 0.005 * rng.standard_normal((5, 3)))
        assert not linearity(values, reflectance).clipped.any()


def test_too_few_patches_are_a_sentence():
    with pytest.raises(ValueError, match="at least 4 patches"):
        linearity(np.ones((3, 3)), np.ones(3))


def picture(values, **exif):
    return Photograph(values, values > 0, 0.0, 0.0, exif, "made")


def objections(verdicts):
    return [text for passed, text in verdicts if not passed]


def test_pictures_are_judged_channel_by_channel():
    values = np.random.default_rng(2).uniform(0.02, 0.7, (80, 90, 3))
    assert objections(of_picture(picture(values, Flash=16))) == []
    dark = values.copy()
    dark[:8, :, 0] = 0.0
    (text,) = objections(of_picture(picture(dark)))
    assert text.startswith("R: 10.00 % at or below zero")
    assert "lower its black level" in text
    full = values.copy()
    full[:2, :, 1] = 1.0
    assert "expose less" in objections(of_picture(picture(full)))[0]
    # Clipped, then darkened by half: the values heap up at the brightest.
    hidden = np.minimum(values, 0.6)
    assert all("heap up at 0.600" in text for text in objections(of_picture(picture(hidden))))
    assert len(objections(of_picture(picture(hidden)))) == 3
    assert "flash fired" in objections(of_picture(picture(values, Flash=9)))[0]


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
def test_ranges_in_other_units_and_missing_ones_are_objected_to(change, words):
    distance = np.random.default_rng(3).uniform(2.0, 9.0, (20, 30))
    assert of_range(distance)[0][0]
    (text,) = objections(of_range(change(distance)))
    assert words in text
