"""Shade, long stays at one depth, down- and upcasts: casts as they come, with a known Kd."""

import numpy as np
import pytest

from fitting import Profile, fit_profile, fit_profiles
from fitting.observations.profile_sensor import segments
from fitting.profile.kd.band_fit import BandFit
from fitting.profile.kd.ways import combined

BANDS, KD = np.array([412.0, 490.0, 555.0]), np.array([0.30, 0.20, 0.25])


def waves(rng, depth, relative, length):
    """(depth, 1) factors of light whose waves are correlated along the way and shared by bands."""
    gap = np.abs(np.diff(depth, prepend=depth[0]))
    rho, value = np.exp(-gap / length), np.empty(len(depth))
    state = rng.standard_normal()
    for i, r in enumerate(rho):
        state = r * state + np.sqrt(1 - r**2) * rng.standard_normal()
        value[i] = state
    return np.exp(relative * value)[:, None]


def cast(rng, there_and_back=True, between=0.0, relative=0.1):
    """Down and up through one water; each way has a Kd and a sun of its own."""
    down, rows, seen = np.linspace(0.3, 12.0, 300), [], []
    for depth in (down, down[::-1]) if there_and_back else (down,):
        kd = KD * np.exp(between * rng.standard_normal())
        sun = np.exp(0.1 * rng.standard_normal())
        rows.append(depth)
        seen.append(sun * np.exp(-depth[:, None] * kd) * waves(rng, depth, relative, 0.5))
    return Profile(np.concatenate(rows), BANDS, np.concatenate(seen))


def test_ways_are_told_apart_where_the_sensor_turns():
    down, rng = np.linspace(0.0, 10.0, 50), np.random.default_rng(0)
    assert np.all(segments(down) == 0)
    assert np.all(segments(down[::-1]) == 0)
    np.testing.assert_array_equal(
        segments(np.concatenate([down, down[::-1]])), np.repeat([0, 1], 50)
    )
    # Two casts one after the other, and heave of a tenth of the range.
    np.testing.assert_array_equal(segments(np.tile(down, 2)), np.repeat([0, 1], 50))
    assert np.all(segments(down + 0.5 * np.sin(np.arange(50))) == 0)
    # No order of measurement at all.
    assert np.all(segments(rng.permutation(down)) == 0)
    assert np.all(segments(np.full(20, 3.0)) == 0)


@pytest.mark.slow
@pytest.mark.parametrize("between", [0.0, 0.05])
def test_stated_deviations_are_the_scatter_of_repeats(between):
    """Casts through one water minutes apart: stated sd within 0.7-1.5 of how far repeats differ,
    and 95 % intervals that hold."""
    rng = np.random.default_rng(3)
    fits = fit_profiles([cast(rng, between=between) for _ in range(200)])
    found = [fit.quantities["Kd"] for fit in fits]
    value = np.stack([q.value for q in found])
    stated = np.sqrt(np.mean(np.stack([q.sd for q in found]) ** 2, axis=0))
    scatter = np.std(np.log(value), axis=0)
    assert np.all((stated / scatter > 0.7) & (stated / scatter < 1.5))
    ends = np.stack([q.interval() for q in found])
    inside = np.mean((ends[:, 0] < KD) & (ends[:, 1] > KD), axis=0)
    assert np.all(inside > 0.88)


def test_the_mean_of_ways_is_that_of_random_effects():
    """Three ways, one band: DerSimonian and Laird's formulas written out."""
    x, variance = np.array([-1.6, -1.5, -1.2]), np.array([0.01, 0.02, 0.015])
    fits = [
        BandFit(
            np.array([[0.0, one]]), np.diag([1e-4, v])[None], np.array([0.05]), np.array([20.0]),
            np.array([0.5]), np.ones((1, 30), bool), np.zeros(1, np.int32),
        )
        for one, v in zip(x, variance, strict=True)
    ]  # fmt: skip
    weight = 1 / variance
    mean = np.sum(weight * x) / weight.sum()
    q = np.sum(weight * (x - mean) ** 2)
    between = max(q - 2, 0) / (weight.sum() - np.sum(weight**2) / weight.sum())
    assert between > 0
    weight = 1 / (variance + between)
    found = combined(fits)
    np.testing.assert_allclose(found.x[0, 1], np.sum(weight * x) / weight.sum(), rtol=1e-12)
    np.testing.assert_allclose(found.covariance[0, 1, 1], 1 / weight.sum(), rtol=1e-12)
    noise, ways = np.sum(weight**2 * variance), np.sum(weight**2) * between
    dof = (noise + ways) ** 2 / (noise**2 / 60 + ways**2 / 4)
    np.testing.assert_allclose(found.dof[0], dof, rtol=1e-12)
    # A way whose search failed says nothing.
    fits[2] = BandFit(*[getattr(fits[2], f) for f in
                        ("x", "covariance", "noise", "dof", "length", "used")],
                      np.ones(1, np.int32))  # fmt: skip
    two = combined(fits)
    assert two.dof[0] != found.dof[0]
    assert -1.6 < two.x[0, 1] < -1.5


def test_a_shaded_upcast_and_a_covered_sensor_are_left_out():
    rng = np.random.default_rng(1)
    down = np.linspace(0.5, 12.0, 300)
    depth = np.concatenate([np.full(20, 0.4), down, down[::-1]])
    seen = np.exp(-depth[:, None] * KD) * (1 + 0.03 * rng.standard_normal((620, 3)))
    seen[:20] *= 1e-3  # the cap is still on
    shade = np.where(depth[320:] < 2.2, np.exp(2.5 * (depth[320:] - 2.2)), 1.0)
    seen[320:] *= shade[:, None]
    profile = Profile(depth, BANDS, seen)
    (reason,) = [text for text in profile.counts if "shade" in text]
    assert 40 <= profile.counts[reason] <= 120
    fit = fit_profile(profile)
    low, high = fit.quantities["Kd"].interval(0.95, fit.dof)
    assert np.all((low < KD) & (high > KD))
    np.testing.assert_allclose(fit.quantities["Kd"].value, KD, rtol=0.02)


def test_upward_light_over_a_floor_is_fitted_where_it_is_one_exponential():
    """A floor at 5.5 m of which light comes back: the slope changes with depth, and Rrs of the
    whole window errs by many stated deviations; of the straight part it holds the truth."""
    rng, inside = np.random.default_rng(6), []
    depth, kd = np.linspace(0.2, 5.3, 250), np.array([0.25, 0.2, 0.22])
    for _ in range(20):
        down = np.exp(-depth[:, None] * kd)
        up = 0.004 * down + 0.02 * np.exp(-kd * (2 * 5.5 - depth[:, None]))
        noise = np.exp(0.03 * rng.standard_normal((2, 250, 3)))
        cast = Profile(depth, BANDS, down * noise[0], Lu=up * noise[1])
        fit = fit_profile(cast)
        truth = 0.004 + 0.02 * np.exp(-2 * 5.5 * kd)
        low, high = fit.quantities["Lu_0"].interval()
        inside.append((low < truth) & (truth < high))
    assert np.mean(inside) > 0.8
    # One exponential all the way is used all the way.
    cast = Profile(depth, BANDS, down * noise[0], Lu=0.004 * down * noise[1])
    deepest = fit_profile(cast).metadata["Lu_deepest_used_m"]
    assert np.mean(np.array(deepest) > 5.0) > 0.6


def test_light_that_never_falls_is_refused():
    depth = np.linspace(0.5, 12.0, 60)
    rng = np.random.default_rng(2)
    flat = np.exp(0.3 * depth)[:, None] * (1 + 0.1 * rng.standard_normal((60, 3)))
    with pytest.raises(ValueError, match=r"falls with depth|which lie in shade"):
        fit_profile(Profile(depth, BANDS, flat))
    parked = Profile(
        np.full(60, 4.0) + 1e-3 * depth, BANDS, np.exp(0.1 * rng.standard_normal((60, 3)))
    )
    with pytest.raises(ValueError, match="falls with depth"):
        fit_profile(parked)
    assert "falls with depth" in fit_profiles([parked]).failures[0]


def test_a_long_stay_at_the_surface_is_one_measurement():
    """A float that drifts at the surface for 400 samples, whose sun then goes behind a cloud."""
    rng = np.random.default_rng(4)
    drift, way = np.abs(0.2 * rng.standard_normal(400)), np.linspace(0.5, 60.0, 150)
    kd = 0.2 * KD
    above = np.exp(-drift[:, None] * kd) * np.exp(0.5 * rng.standard_normal((400, 1)))
    below = np.exp(-way[:, None] * kd) * (1 + 0.05 * rng.standard_normal((150, 3)))
    profile = Profile(np.concatenate([drift, way]), BANDS, np.concatenate([above, below]))
    assert profile.counts["samples in medians over depth, as the sensor stayed there"] > 350
    assert len(profile.depth) < 200
    fit = fit_profile(profile)
    low, high = fit.quantities["Kd"].interval(0.95, fit.dof)
    assert np.all((low < kd) & (kd < high))


@pytest.mark.parametrize("deepest", [10.0, 20.0, 50.0])
def test_the_noise_printed_is_the_noise_put_in(deepest):
    """Casts that end in light have no floor that could pass for their noise."""
    rng, depth = np.random.default_rng(5), np.linspace(0.5, deepest, 60)
    casts = [
        Profile(
            depth, [555.0], (np.exp(-0.1 * depth) * (1 + 0.02 * rng.standard_normal(60)))[:, None]
        )
        for _ in range(60)
    ]
    fits = fit_profiles(casts)
    noise = [fit.metadata["relative_noise"][0] for fit in fits]
    assert abs(np.median(noise) / 0.02 - 1) < 0.1
    assert np.min(noise) > 0.011
    assert np.max(noise) < 0.03
