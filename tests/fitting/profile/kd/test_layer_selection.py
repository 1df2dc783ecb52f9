"""How many layers are chosen, against criteria computed by themselves."""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import norm

from fitting.profile.kd.layer_selection import choose_interfaces, piecewise_linear_fit
from fitting.profile.kd.noise_statistics import running_median


def lines(depth, log_light, floor=0.0):
    light = np.exp(np.asarray(log_light, float).reshape(len(depth), -1))
    mask = np.ones_like(light, bool)
    return piecewise_linear_fit(depth, light, np.full(light.shape[1], floor), mask)


def chosen(depth, log_light, layers=None):
    light = np.exp(log_light)[:, None]
    return choose_interfaces(depth, light, np.zeros(1), np.ones_like(light, bool), layers)


def square(depth, y, interfaces):
    """Least sum of squares of continuous straight lines."""
    design = np.stack(
        [np.ones_like(depth), depth, *(np.maximum(depth - z, 0.0) for z in interfaces)], axis=1
    )
    return float(np.linalg.lstsq(design, y, rcond=None)[1][0])


def test_more_layers_need_strong_evidence():
    """Kass & Raftery 1995: 6 of the Bayes information criterion.  The bend at which a second layer
    appears, found by bisection, is where the two criteria differ by that."""
    depth = np.linspace(0.5, 20.0, 80)
    noise = 0.02 * np.random.default_rng(5).standard_normal(80)

    def curve(bend):
        return -0.1 * depth - bend * np.maximum(depth - 10.0, 0.0) + noise

    low, high = 0.0, 0.05
    assert len(chosen(depth, curve(low))) == 0
    assert len(chosen(depth, curve(high))) == 1
    for _ in range(13):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if len(chosen(depth, curve(middle))) == 0 else (low, middle)
    y = curve(high)
    assert lines(depth, y).used.all()
    # A layer adds its Kd and its interface.  Interfaces lie on 60 of the samples.
    inner = depth[5:-5]
    places = inner[np.linspace(0, len(inner) - 1, 60).round().astype(int)]
    two = min(square(depth, y, [z]) for z in places if z - 0.5 >= 1.95 and 20.0 - z >= 1.95)
    gain = len(depth) * np.log(square(depth, y, []) / two) - 2.0 * np.log(len(depth))
    assert gain == pytest.approx(6.0, abs=0.1)


def test_residuals_look_random_down_to_one_percent():
    """Patterns of signs whose probability lies just above, and just below, a hundredth."""
    tried = {True: 0, False: 0}
    for plus, minus in itertools.product(range(12, 60, 3), range(12, 60, 3)):
        total, product = plus + minus, 2.0 * plus * minus
        mean = product / total + 1.0
        sd = np.sqrt(product * (product - total) / total**2 / (total - 1))
        # The number of runs whose probability, of both tails, is nearest to a hundredth.
        runs = round(mean - 2.5758 * sd)
        p = math.erfc((mean - runs) / sd / 2**0.5)
        if 0.0092 < p < 0.0108 and abs(p - 0.01) > 1e-4 and tried[p > 0.01] < 3:
            found = _looks_random(plus, minus, runs)
            if found is not None:
                assert found == (p > 0.01), (plus, minus, runs, p)
                tried[p > 0.01] += 1
    assert min(tried.values()) >= 2


def _looks_random(plus, minus, runs):
    """None where the line that is fitted changes a sign."""
    rng = np.random.default_rng(runs)
    first = (runs + 1) // 2
    found = []
    for count, parts in ((plus, first), (minus, runs - first)):
        if parts > count or parts < 1:
            return None
        cuts = np.sort(rng.choice(np.arange(1, count), parts - 1, replace=False))
        found.append(np.diff([0, *cuts, count]))
    signs = np.repeat(
        [(-1.0) ** i for i in range(runs)], [found[i % 2][i // 2] for i in range(runs)]
    )
    depth = np.linspace(1.0, 10.0, len(signs))
    y = np.where(signs > 0, 1.0 / plus, -1.0 / minus) * 0.1
    left = y - np.polyval(np.polyfit(depth, y, 1), depth)
    if np.any(np.sign(left) != signs):
        return None
    cast = lines(depth, -0.2 * depth + y)
    return cast.looks_random([]) if cast.used.all() else None


SPACINGS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)


def correlated(steps, count, seed):
    """Depths 0.1 m apart, ln light whose noise is correlated over `steps` of them."""
    apart = np.abs(np.arange(count)[:, None] - np.arange(count)[None, :])
    root = np.linalg.cholesky(np.exp(-apart / max(steps, 1e-3)))
    depth = 0.1 * np.arange(1.0, count + 1)
    return depth, -0.1 * depth + 0.03 * root @ np.random.default_rng(seed).standard_normal(count)


@pytest.mark.parametrize(
    ("steps", "seed"), list(zip(SPACINGS, (1, 0, 0, 2, 3, 4, 0, 26), strict=True))
)
def test_the_correlation_length_is_that_of_the_restricted_likelihood(steps, seed):
    """Of 0, 1/2, 1 ... 32 spacings, by dense matrices."""
    count = 129 if steps <= 8.0 else 258
    depth, y = correlated(steps, count, seed)
    cast = lines(depth, y)
    assert cast.used.all(), "an outlier: take another seed"
    cast.estimate_correlation_length([])
    design = np.stack([np.ones_like(depth), depth], axis=1)
    apart = np.abs(np.arange(count)[:, None] - np.arange(count)[None, :])

    def score(length):
        covariance = np.minimum(np.exp(-1.0 / max(length, 1e-3)), 0.98) ** apart
        solved = np.linalg.solve(covariance, np.column_stack([design, y]))
        information = design.T @ solved[:, :2]
        beta = np.linalg.solve(information, design.T @ solved[:, 2])
        left = y - design @ beta
        square = left @ (solved[:, 2] - solved[:, :2] @ beta)
        volume = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
        return (count - 2) * np.log(square) + volume

    best = min((s for s in SPACINGS if 8.0 * s < count), key=score)
    assert cast.length == pytest.approx(0.1 * best, rel=1e-9)
    assert best == steps


@pytest.mark.parametrize(("count", "longest"), [(244, 16.0), (270, 32.0)])
def test_waves_are_an_eighth_of_the_range_at_most(count, longest):
    """243 and 269 spacings, on either side of 8 times 32; a random walk asks for the longest."""
    depth = 0.1 * np.arange(1.0, count + 1)
    walk = 0.02 * np.cumsum(np.random.default_rng(0).standard_normal(count))
    cast = lines(depth, -0.1 * depth + walk)
    cast.estimate_correlation_length([])
    assert cast.length == pytest.approx(0.1 * longest)


def test_bands_that_share_their_waves_count_once():
    rng, depth = np.random.default_rng(2), np.linspace(1.0, 20.0, 400)
    own = 0.03 * rng.standard_normal((400, 4))
    for noise, bands in ((own, 4.0), (np.repeat(own[:, :1], 4, axis=1), 1.0)):
        cast = lines(depth, -0.1 * depth[:, None] + noise)
        cast.estimate_correlation_length([])
        assert cast.bands == pytest.approx(bands, rel=0.02)


@pytest.mark.parametrize(("size", "kept"), [(4.9, True), (5.1, False)])
def test_outliers_are_five_deviations_from_their_neighbours_median(size, kept):
    rng, depth = np.random.default_rng(1), np.linspace(1.0, 20.0, 200)
    y = 0.02 * rng.standard_normal(200)
    for _ in range(50):
        middle = running_median(y[:, None])[:, 0]
        apart = np.abs(y - middle)
        scale = np.median(apart[apart > 0]) / norm.ppf(0.75)
        y[100] = middle[100] + size * scale
    assert (lines(depth, y).weight[100, 0] > 0) == kept


def test_samples_weigh_by_waves_of_five_percent_and_the_electronics():
    """Half where the noise of the electronics is as large as that of the waves."""
    depth = np.arange(1.0, 8.0)
    weight = lines(depth, np.log(np.full(7, 0.02)), floor=0.001).weight
    np.testing.assert_allclose(weight, 0.5, rtol=1e-9)


def test_layers_take_a_tenth_of_the_range_at_least():
    """Of 59 m: a layer of 6 m is found, one of 5.5 m ends up at the next sample above 5.9 m."""
    depth = np.arange(60.0)
    for thickness in (6.0, 5.5):
        y = -0.05 * depth - 0.4 * np.maximum(depth - 59.0 + thickness, 0.0)
        (place,) = chosen(depth, y, 2)
        assert 59.0 - place == pytest.approx(6.0, abs=0.05)


def test_the_data_choose_four_layers_at_most():
    depth = np.linspace(0.0, 20.0, 201)
    y = -0.1 * depth + 1e-4 * np.random.default_rng(0).standard_normal(201)
    for i, place in enumerate((4.0, 8.0, 12.0, 16.0)):
        y -= (-1.0) ** i * 0.3 * np.maximum(depth - place, 0.0)
    assert len(chosen(depth, y)) == 3
    assert len(chosen(depth, y, 5)) == 4
