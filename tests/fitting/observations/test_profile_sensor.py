"""What a cast says about its sensors, against simulated noise and counted samples."""

import numpy as np
import pytest
from scipy.stats import norm

from fitting import Profile
from fitting.observations import profile_sensor
from fitting.observations.profile_sensor import (
    isolated_values,
    noise_floor,
    segments,
    shaded,
    thinned,
)


def test_the_noise_floor_is_the_standard_deviation_of_the_noise():
    rng = np.random.default_rng(0)
    dark = 3e-4 * rng.standard_normal((2000, 300))
    light = np.exp(-0.02 * np.arange(2000))[:, None] + dark
    floor = profile_sensor.noise_floor(light, np.ones_like(light, bool))
    assert np.mean(floor) == pytest.approx(3e-4, rel=0.02)


def test_a_digital_zero_claims_no_perfect_knowledge_of_darkness():
    """A millionth of a millionth of the brightest is left."""
    light = np.array([[5.0]] + [[0.0]] * 9)
    floor = profile_sensor.noise_floor(light, np.ones_like(light, bool))
    np.testing.assert_allclose(floor, 5e-12, rtol=1e-9)


def _cast_in_darkness(count, middle=0.001, spread=1e-4, bands=1, seed=0):
    """Bright samples, and a deepest tenth of normal noise about the reading in darkness."""
    rng = np.random.default_rng(seed)
    deep = middle + spread * rng.standard_normal((count // 10, bands))
    above = np.linspace(1.0, 0.5, count - count // 10)[:, None]
    return np.concatenate([np.broadcast_to(above, (len(above), bands)), deep])


def test_scatter_in_darkness_is_that_of_one_sample():
    level, _, scatter = profile_sensor.darkness(_cast_in_darkness(2000, bands=400))
    seen = scatter > 0
    assert np.mean(scatter[seen]) == pytest.approx(1e-4, rel=0.02)
    assert np.mean(level[seen]) == pytest.approx(0.001, rel=1e-3)


def test_the_error_of_the_reading_in_darkness_is_half_as_much_again_as_its_scatter():
    """Scatter of the level over many simulated casts, against the error that each states."""
    level, error, _ = profile_sensor.darkness(_cast_in_darkness(1000, bands=4000))
    seen = error > 0
    assert np.mean(error[seen]) / np.std(level[seen]) == pytest.approx(1.5, rel=0.03)


def test_the_error_of_a_median_is_that_of_large_samples():
    """sqrt(pi/2) of a mean's; 200 samples in the deepest tenth of 2000."""
    _, error, scatter = profile_sensor.darkness(_cast_in_darkness(2000))
    np.testing.assert_allclose(error, 1.5 * np.sqrt(np.pi / 2 / 200) * scatter, rtol=1e-4)
    assert scatter > 0


@pytest.mark.parametrize(("top", "dark"), [(0.0099, True), (0.0101, False)])
def test_darkness_is_a_hundredth_of_the_brightest(top, dark):
    """The level and its scatter together."""
    half = 1e-4
    deep = np.where(np.arange(40) % 2, half, -half) * (1 + 1e-3 * np.cos(np.arange(40.0)))
    middle = top - half / norm.ppf(0.75)
    cast = np.concatenate([np.linspace(1.0, 0.5, 360), middle + deep])
    level, _, scatter = profile_sensor.darkness(cast[:, None])
    assert (scatter[0] > 0) == dark
    assert level[0] == pytest.approx(middle if dark else 0.0, abs=half)


def test_light_that_still_falls_is_no_darkness():
    """A one-sided test at 5 % of Spearman's rank correlation, of variance 1/(n - 1)."""
    rng, count = np.random.default_rng(3), 60
    limit = norm.ppf(0.05) / np.sqrt(count - 1)
    below = above = 0
    above_it = np.linspace(1.0, 0.5, 9 * count)
    for _ in range(1500):
        deep = rng.permutation(np.linspace(-1e-4, 1e-4, count))
        rank = float(np.corrcoef(np.argsort(np.argsort(deep)), np.arange(count))[0, 1])
        if abs(rank / limit - 1.0) > 0.05:
            continue
        cast = np.concatenate([above_it, 0.001 + deep])
        found = profile_sensor.darkness(cast[:, None])[2][0] > 0
        assert found == (rank > limit), rank / limit
        below, above = below + (rank < limit), above + (rank > limit)
    assert below > 5
    assert above > 5


def test_darkness_needs_ten_samples_in_the_deepest_tenth():
    assert profile_sensor.darkness(_cast_in_darkness(100))[2] > 0
    assert profile_sensor.darkness(_cast_in_darkness(100)[1:])[2] == 0


def test_a_shadow_on_the_sensor_above_lasts_an_eighth_of_the_cast_at_most():
    for width, left in ((10, 1.0), (11, 0.5)):
        surface = np.ones((80, 1))
        surface[30 : 30 + width] = 0.5
        smooth, level = profile_sensor.smooth_reference(surface)
        assert level[0] == 1.0
        assert smooth.min() == left


def test_five_samples_of_the_light_above_make_a_reference():
    surface = np.full((8, 1), np.nan)
    surface[:4] = 2.0
    assert np.isnan(profile_sensor.smooth_reference(surface)[1][0])
    surface[4] = 2.0
    assert profile_sensor.smooth_reference(surface)[1][0] == 2.0


def test_at_most_2048_samples_are_kept():
    for count in (2048, 2049):
        depth = np.linspace(0.1, 20.0, count)
        profile = Profile(depth, np.array([490.0]), np.exp(-0.1 * depth)[:, None])
        assert (len(profile.depth) == count) == (count == 2048)
        assert len(profile.depth) <= 2048


@pytest.mark.parametrize(("factor", "found"), [(1100.0, True), (900.0, False)])
def test_a_value_above_a_thousand_times_its_neighbours_is_no_light(factor, found):
    seen = np.exp(-0.1 * np.arange(30.0))[:, None] * np.ones(2)
    seen[12, 1] = factor * seen[8, 1]
    isolated = isolated_values(seen)
    assert isolated[12, 1] == found
    assert isolated.sum() == found
    # Two fill values beside each other have each other for neighbours.
    seen[13, 1] = seen[12, 1]
    assert not isolated_values(seen).any()


@pytest.mark.parametrize(("back", "ways"), [(0.22, 2), (0.18, 1)])
def test_a_sensor_turns_where_it_comes_back_by_a_fifth_of_the_range(back, ways):
    down = np.linspace(0.0, 10.0, 101)
    up = 10.0 - np.linspace(0.0, 10.0 * back, 23)
    assert len(np.unique(segments(np.concatenate([down, up])))) == ways


@pytest.mark.parametrize(("share", "found"), [(0.45, True), (0.55, False)])
def test_less_than_half_of_the_light_further_down_is_shade(share, found):
    depth = np.linspace(0.2, 20.0, 100)
    light = np.exp(-0.01 * depth)[:, None] * np.ones(3)
    light[:15] = share * light[15]
    mask, way = np.ones(light.shape, bool), np.zeros(100, int)
    dark = shaded(depth, light, mask, way)
    assert dark[:15].all() == found
    assert dark.any() == found
    # All that lies above the brightest depth, and as far below it as light took to halve above.
    if found:
        assert 15 <= dark.sum() <= 22
    # One band alone may fluoresce or fail: most bands must say so.
    light[:15, :2] = light[15, :2]
    assert not shaded(depth, light, mask, way).any()


@pytest.mark.parametrize(("extra", "merged"), [(12, True), (7, False)])
def test_a_stay_is_ten_times_the_usual_number_at_one_depth(extra, merged):
    """Samples one to a bin of 512, and some more in one of them."""
    depth = np.sort(np.concatenate([np.linspace(0.0, 51.1, 512), np.full(extra, 20.04)]))
    data = {"depth": depth, "Ed": np.ones((len(depth), 1)), "segment": np.zeros(len(depth))}
    found, notes = thinned(data)
    assert bool(notes) == merged
    assert (len(found["depth"]) <= 512) == merged


@pytest.mark.parametrize(("level", "found"), [(0.045, True), (0.055, False)])
def test_a_floor_is_looked_for_where_light_fades_to_a_twentieth(level, found):
    rng, depth = np.random.default_rng(0), np.linspace(0.0, 1.0, 400)
    light = np.exp(np.log(level / 0.975) * np.clip(depth / 0.9, 0.0, 1.0))
    light = light + 0.01 * level * rng.standard_normal(400)
    floor = noise_floor(light[:, None], np.ones((400, 1), bool))[0]
    assert (floor > 1e-6) == found


def test_the_floor_is_the_electronics_noise_and_not_the_waves():
    """Waves alone leave no floor up to twice their scatter; electronics' own scatter is found."""
    rng, found = np.random.default_rng(1), {}
    light = np.exp(-np.linspace(0.0, 5.0, 1000))
    for ratio in (1.7, 2.3, 10.0):
        floors = []
        for _ in range(40):
            noise = np.where(np.arange(1000) < 900, 0.02, 0.02 * ratio)
            seen = light * (1 + noise * rng.standard_normal(1000))
            floors.append(noise_floor(seen[:, None], np.ones((1000, 1), bool))[0])
        found[ratio] = np.array(floors) / np.median(light[-100:])
    assert np.mean(found[1.7] > 1e-6) < 0.25
    assert np.mean(found[2.3] > 1e-6) > 0.75
    # sqrt(10^2 - 2^2) of 2 %, to the scatter of a median of 100.
    np.testing.assert_allclose(np.median(found[10.0]), 0.02 * np.sqrt(96.0), rtol=0.06)
