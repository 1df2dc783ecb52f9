"""Limits of the quality checks of pictures, charts and range maps, and the noise files imply."""

import numpy as np
import OpenImageIO as oiio
import pytest

from fitting.images import quality_checks
from fitting.images.chart_reading import ChartReading, read_chart
from fitting.images.chart_targets import target
from fitting.images.photograph_file import Photograph, read_photograph


def picture(plane, flash=False):
    """The same channel three times, spread so that no value stands out."""
    values = np.repeat(plane[:, :, None], 3, axis=2)
    exif = {"Flash": 1} if flash else {}
    return Photograph(values, values < 1.0, 0.0, 0.0, exif, "memory")


def passes(plane):
    return [ok for ok, _ in quality_checks.of_picture(picture(plane))]


def spread(count=10_000):
    return np.linspace(0.01, 0.8, count).reshape(100, -1)


@pytest.mark.parametrize(("share", "good"), [(0.049, True), (0.051, False)])
def test_a_twentieth_of_a_channel_may_be_zero(share, good):
    plane = spread()
    plane.flat[: int(share * plane.size)] = 0.0
    assert passes(plane) == [good] * 3


@pytest.mark.parametrize(("share", "good"), [(0.0099, True), (0.0101, False)])
def test_a_hundredth_of_a_channel_may_be_at_full_scale(share, good):
    plane = spread()
    plane.flat[: round(share * plane.size)] = 1.0
    assert passes(plane) == [good] * 3


@pytest.mark.parametrize(
    ("below", "top", "good"),
    # Of a million pixels (10^-4: 100), of few (50 at least), and with many just below (20 times
    # the mean of a thousandth of the range).
    [(0, 99, True), (0, 101, False), (9900, 1999, True), (9900, 2001, False)],
)
def test_a_saturation_spike_holds_far_more_pixels_than_lie_just_below(below, top, good):
    plane = np.full(1_000_000, 0.1)
    plane[:below] = np.linspace(0.55, 0.59, below) if below else 0.1
    plane[below : below + top] = 0.6
    assert passes(plane.reshape(1000, 1000)) == [good] * 3


@pytest.mark.parametrize(("top", "good"), [(50, True), (51, False)])
def test_fifty_alike_are_no_spike(top, good):
    plane = np.full(10_000, 0.1)
    plane[:top] = 0.6
    assert passes(plane.reshape(100, 100)) == [good] * 3


@pytest.mark.parametrize(("value", "alike"), [(0.5993, False), (0.5995, True)])
def test_alike_is_within_a_thousandth(value, alike):
    plane = np.full(10_000, 0.1)
    plane[:60] = value
    plane[60] = 0.6
    assert passes(plane.reshape(100, 100)) == [not alike] * 3


@pytest.mark.parametrize(("short", "clipped"), [(0.079, False), (0.081, True)])
def test_a_patch_eight_percent_short_of_the_line_is_clipped(short, clipped):
    reflectance = np.array([0.05, 0.1, 0.2, 0.4])
    values = np.repeat(2.0 * reflectance[:, None], 3, axis=1)
    values[3, 1] *= 1.0 - short
    found = quality_checks.linearity(values, reflectance)
    assert found.clipped.tolist() == [False, False, False, clipped]


@pytest.mark.parametrize(
    ("middle", "missing", "good"),
    [(0.049, 0, False), (0.051, 0, True), (99.0, 0, True), (101.0, 0, False),
     (2.0, 49, True), (2.0, 51, False)],
)  # fmt: skip
def test_ranges_lie_between_five_centimetres_and_a_hundred_metres(middle, missing, good):
    """By their median, half of them missing at most."""
    distance = np.full(100, middle)
    distance[:missing] = np.nan
    assert [ok for ok, _ in quality_checks.of_range(distance)] == [good]


def test_ranges_of_more_than_a_kilometre_are_millimetres():
    for middle, unit in ((990.0, "centimetres or millimetres"), (1010.0, "like millimetres")):
        ((_, text),) = quality_checks.of_range(np.full(9, middle))
        assert unit in text


@pytest.mark.parametrize(("share", "clipped"), [(0.09, False), (0.11, True)])
def test_a_patch_may_lose_a_tenth_of_its_pixels(share, clipped):
    chart = target("ColorChecker24")
    spectra = chart.reflectance.mean(axis=1).reshape(4, 6)
    plane = np.repeat(np.repeat(0.3 * spectra, 40, axis=0), 40, axis=1)
    values = np.repeat(plane[:, :, None], 3, axis=2)
    mask = np.ones(values.shape, bool)
    # The middle 20 x 20 pixels of the third patch of the second row are averaged.
    spoiled = np.argwhere(np.ones((20, 20), bool))[: round(share * 400)]
    mask[50 + spoiled[:, 0], 90 + spoiled[:, 1]] = False
    photograph = Photograph(values, mask, 0.0, 0.0, {}, "memory")
    corners = np.array([[-0.5, -0.5], [239.5, -0.5], [239.5, 159.5], [-0.5, 159.5]])
    reading = read_chart(photograph, corners, chart)
    assert reading.clipped.nonzero()[0].tolist() == ([8] if clipped else [])


def test_patches_scatter_by_three_percent_in_the_field():
    """Caustics and unevenness, beside what was read."""
    chart = target("ColorChecker24")
    values = np.full((24, 3), 0.5)
    reading = ChartReading(
        chart, np.zeros((4, 2)), values, np.full_like(values, 0.02), np.zeros(24, bool),
        np.full(24, 100), np.zeros((24, 4, 2)), 1.0,
    )  # fmt: skip
    np.testing.assert_allclose(reading.chart(1.0).sigma, np.hypot(0.02, 0.015), rtol=1e-12)


def written(path, values):
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], 3, oiio.UINT16)
    out = oiio.ImageOutput.create(str(path))
    assert out is not None
    assert out.open(str(path), spec)
    out.write_image(values.astype(np.float32))
    out.close()
    return path


def test_the_curve_of_a_display_costs_five_percent_and_its_slope_at_white(tmp_path):
    """A step is uniform noise, of variance step^2/12; IEC 61966-2-1 is steepest at white, where
    its slope is 2.275, taken as 2.2."""
    values = np.linspace(0.02, 0.9, 16 * 16 * 3).reshape(16, 16, 3)
    photograph = read_photograph(written(tmp_path / "one.png", values), "sRGB")
    uniform = (np.arange(100_000) + 0.5) / 100_000 - 0.5
    assert photograph.step == pytest.approx(2.2 * np.std(uniform) / 65535, rel=1e-5)
    assert photograph.relative == 0.05
    counts = np.round(values * 65535) / 65535
    expected = np.where(counts <= 0.04045, counts / 12.92, ((counts + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(photograph.values, expected, rtol=1e-4)
