"""Hidden clipping: found on the real frame, not invented on straight charts."""

from pathlib import Path

import numpy as np
import pytest

from fitting.readers import read_sheet
from fitting.verdicts import linearity

CHARTS = Path(__file__).parents[1] / "scenes" / "red_sea_charts.csv"


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
