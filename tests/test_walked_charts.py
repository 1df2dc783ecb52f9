"""The readings of walked charts: what the file holds, and that they are those of its scenes."""

import numpy as np
import pytest

import oceaninv as oi
from fitting.observations.photo import WAVELENGTH
from tests.acceptance import _walked_charts as walked


@pytest.fixture(scope="module")
def scenes():
    return walked.load()


def test_there_are_the_scenes_of_the_settings(scenes):
    assert len(scenes) == len(walked.SETTINGS) == 15
    for scene, setting in zip(scenes, walked.SETTINGS, strict=True):
        assert (scene.water, scene.peak, scene.around) == (
            setting.water,
            setting.peak,
            setting.around,
        )
        assert len(scene.charts) == 3
        assert tuple(chart.distance for chart in scene.charts) == setting.ranges
        assert scene.zenith == (90.0,)
        np.testing.assert_array_equal(scene.wavelength, WAVELENGTH)
    assert walked.PATH.stat().st_size < 300_000


def test_numbers_are_finite_and_positive_with_small_errors(scenes):
    for scene in scenes:
        for name in ("b", "c", "bb"):
            assert getattr(scene, name).shape == (16,)
        for name in ("background", "background_beside"):
            value, error = getattr(scene, name), getattr(scene, f"{name}_stderr")
            assert value.shape == error.shape == (1, 16)
            assert np.all(np.isfinite(value) & (value > 0) & (error >= 0) & (error < 0.004 * value))
        for chart in scene.charts:
            assert chart.radiance.shape == chart.stderr.shape == chart.reflectance.shape == (24, 16)
            assert np.all(np.isfinite(chart.radiance) & (chart.radiance > 0))
            assert np.all((chart.stderr > 0) & (chart.stderr < 0.004 * chart.radiance))


def test_boards_have_the_sizes_of_a_colour_checker(scenes):
    chart = scenes[0].charts[0]
    assert chart.half_height == pytest.approx(0.102)
    assert chart.half_width == pytest.approx(0.1445)
    assert chart.patch_half == pytest.approx(0.42 * 0.289 / 6)
    board = walked.Board.of(walked.SETTINGS[0], 1.0)
    np.testing.assert_allclose(board.centres()[0], [-2.5 * 0.289 / 6, 1.0, 5 - 1.5 * 0.051])
    np.testing.assert_allclose(board.centres()[23], [2.5 * 0.289 / 6, 1.0, 5 + 1.5 * 0.051])
    assert {scene.charts[0].half_width for scene in scenes} == {0.05, 0.1445, 0.3}


def test_stated_waters_are_those_of_the_settings(scenes):
    for scene, setting in zip(scenes[:3], walked.SETTINGS, strict=False):
        water = walked.water(setting)
        for name in ("b", "c", "bb"):
            np.testing.assert_allclose(getattr(scene, name), getattr(water, name), rtol=1e-6)
        assert scene.a_cdm_440 == pytest.approx(scene.cdom + 0.611 * scene.detritus, rel=2e-3)
        kd = oi.attenuation.kd_lee2005(water.a, water.bb, walked.SUN)
        assert scene.Kd_490 == pytest.approx(np.interp(490.0, WAVELENGTH, kd), rel=0.1)


def test_another_peak_leaves_the_coefficients(scenes):
    other = [scene for scene in scenes if scene.peak == "petzold"]
    assert len(other) == 3
    for scene, model in zip(other, scenes[:3], strict=True):
        np.testing.assert_array_equal(scene.b, model.b)
        np.testing.assert_allclose(scene.bb, model.bb, rtol=1e-5)
    for ratio in (0.004, 0.05):
        assert float(walked.petzold_like(ratio).backscatter_ratio) == pytest.approx(ratio, rel=1e-5)


def test_far_boards_show_the_water_behind_them(scenes):
    chart, scene = scenes[4].charts[2], scenes[4]
    assert (scene.water, chart.distance) == ("coastal", 8)
    # A black board hides some of the light that is scattered forward from behind it.
    ratio = chart.radiance[23] / scene.background[0]
    assert np.all((ratio > 0.965) & (ratio < 1.0))


def test_near_boards_show_their_reflectance(scenes):
    for scene in scenes:
        chart = scene.charts[0]
        grey = chart.radiance[18:24]
        assert np.all(np.diff(grey, axis=0) < 0)
