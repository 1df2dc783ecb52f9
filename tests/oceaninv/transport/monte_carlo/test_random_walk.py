"""What Monte Carlo walks draw: numbers, scattering angles, directions, by chi-squared."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc

from oceaninv.transport.monte_carlo import _array_rqmc, _random_numbers, _random_walk
from oceaninv.water.phase import (
    FournierForand,
    HenyeyGreenstein,
    Isotropic,
    Seawater,
    TwoTermHenyeyGreenstein,
    petzold,
)

PHASES = {
    "isotropic": Isotropic(),
    "HG 0.8": HenyeyGreenstein(0.8),
    "HG 0.99": HenyeyGreenstein(0.99),
    "HG -0.5": HenyeyGreenstein(-0.5),
    "TTHG": TwoTermHenyeyGreenstein(0.95, -0.4, 0.9),
    "seawater": Seawater(),
    "Fournier-Forand": FournierForand(0.0183),
    "Petzold": petzold(),
}
DRAWS = 2**17
A = jnp.asarray


@pytest.mark.parametrize("name", PHASES)
def test_scattering_angles_are_drawn_with_their_density(name):
    """Chi-squared of 64 bins of sin^2(theta/2) against the stated density, and the mean of
    phase/density, which is 1: no angle is left out."""
    phase = PHASES[name]
    table = _random_numbers.half_angle_table((phase,), jnp.ones(1))[None]
    words = _random_numbers.key_words(jax.random.key(5))
    paths = jnp.arange(DRAWS, dtype=jnp.uint32)
    u = _random_numbers.uniforms(paths, jnp.uint32(3), words, jnp.float64)
    half, density = _random_numbers.sample_half_angle(table, jnp.zeros(DRAWS, jnp.int32), u[1])
    edges = np.asarray(table[0])[:: _random_numbers.BINS // 64]
    counts, _ = np.histogram(np.asarray(half), edges)
    assert stats.chisquare(counts).pvalue > 1e-4
    ratio = np.asarray(phase(1 - 2 * half) / density)
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(DRAWS) + 1e-6
    assert ratio.std() < 0.1


def test_directions_keep_angle_azimuth_and_length():
    words = _random_numbers.key_words(jax.random.key(6))
    u = _random_numbers.uniforms(
        jnp.arange(DRAWS, dtype=jnp.uint32), jnp.uint32(0), words, jnp.float64
    )
    polar = 2 * u[0] - 1
    level = jnp.sqrt(1 - polar**2)
    start = (level * jnp.cos(6.28 * u[3]), level * jnp.sin(6.28 * u[3]), polar)
    half = u[1] ** 3
    turned = _random_numbers.turn(start, half, u[2])
    cosine = sum(a * b for a, b in zip(start, turned, strict=True))
    np.testing.assert_allclose(cosine, 1 - 2 * half, atol=1e-12)
    np.testing.assert_allclose(sum(a**2 for a in turned), 1.0, rtol=1e-12)
    # About a fixed direction the azimuth is uniform, and a Lambertian cosine squared is.
    east = tuple(jnp.full(DRAWS, v) for v in (0.6, 0.0, -0.8))
    x, y, z = _random_numbers.lambertian(east, u[1], u[2])
    squared = np.asarray(0.6 * x - 0.8 * z) ** 2
    azimuth = np.arctan2(np.asarray(y), np.asarray(0.8 * x + 0.6 * z)) / (2 * np.pi) + 0.5
    for sample in (squared, azimuth, *map(np.asarray, u)):
        counts, _ = np.histogram(sample, 64, (0.0, 1.0))
        assert stats.chisquare(counts).pvalue > 1e-4


@pytest.mark.parametrize("rate", [0.3, 1.0, 1.7])
@pytest.mark.parametrize("floor", [None, 1.5])
def test_flights_drawn_at_another_rate_bring_the_same_light_everywhere(rate, floor):
    """Weights summed by bins of depth, and at the floor, against the exponential law; a flight of
    3 mean free paths to the floor, of whose light half comes back, and one without an end."""
    one, sigma, steep = jnp.ones(DRAWS), 1.6, 0.8
    end = None if floor is None else jnp.asarray(floor)
    domain = _random_walk.Domain(jnp.zeros(0), end, None)
    tables, none = jnp.zeros((1, _random_numbers.BINS + 1)), jnp.zeros(0)
    proposal = _random_walk.Proposal(A([sigma]), tables, A(0.5), none, A([sigma]))
    direction = (0.6 * one, 0.0 * one, steep * one)
    blank = (0.0 * one,)
    walks = _random_walk.WalkBatch(
        (0.0 * one,) * 3, direction, one, blank, blank, 0.0 * one, None, None
    )
    words = _random_numbers.key_words(jax.random.key(8))
    u = _random_numbers.uniforms(
        jnp.arange(DRAWS, dtype=jnp.uint32), jnp.uint32(0), words, jnp.float64
    )
    ahead = _random_walk.flight(domain, proposal, walks)
    after, vertex = _random_walk.advance(domain, proposal, walks, ahead, u, rate * one)
    edges = np.linspace(0.0, 1.5, 16)
    z, weight = np.asarray(after.position[2]), np.asarray(after.weight)
    bins = (np.digitize(z, edges) - 1)[None, :] == np.arange(15)[:, None]
    parts = np.where(bins & np.asarray(vertex.scattered), weight, 0.0)
    exact = -np.diff(np.exp(-sigma * edges / steep))
    if floor is not None:
        parts = np.vstack([parts, np.where(vertex.scattered, 0.0, weight)])
        exact = np.append(exact, 0.5 * np.exp(-sigma * floor / steep))
    errors = (parts.mean(1) - exact) / (parts.std(1) / np.sqrt(DRAWS))
    assert abs(errors).max() < 4, errors


def test_lanes_share_the_strata_of_every_number():
    """Each walk of a unit has one stratum to itself; over units, one walk's numbers are uniform,
    singly and in pairs, and so are those of two walks and two events in different strata."""
    words, units = _random_numbers.key_words(jax.random.key(8)), jnp.arange(2**14, dtype=jnp.uint32)
    path = units[:, None] * jnp.uint32(32) + jnp.arange(32, dtype=jnp.uint32)[None]

    def draw(event):
        event = jnp.uint32(event)
        u = _random_numbers.uniforms(path, event, words, jnp.float64)
        return [np.asarray(v) for v in _random_numbers.spread(u, units, event, words)]

    first, second = draw(0), draw(1)
    for number in first:
        strata = np.sort((32 * number).astype(int), axis=1)
        np.testing.assert_array_equal(strata, np.tile(np.arange(32), (len(units), 1)))
    pairs = [(first[i][:, 5], first[j][:, 5]) for i in range(4) for j in range(i)]
    pairs += [(first[i][:, 5], second[j][:, 5]) for i in range(4) for j in range(4)]
    pairs += [(first[0][:, 5], first[1][:, walk]) for walk in (0, 4, 21)]
    for x, y in pairs:
        counts, *_ = np.histogram2d(x, y, 16, ((0, 1), (0, 1)))
        assert stats.chisquare(counts.ravel()).pvalue > 1e-4


def test_the_net_is_sobols_in_the_order_of_its_first_coordinate():
    for count in (1, 32, 1024):
        points = qmc.Sobol(7, scramble=False, bits=32).random(count)
        exact = points[np.argsort(points[:, 0])][:, 1:].T
        own = _array_rqmc._reversed(_array_rqmc.net(count)) / 2.0**32
        np.testing.assert_array_equal(own, exact)


def test_scrambled_points_stay_a_net_and_are_uniform_one_by_one():
    """Neighbours in a row share the unit interval; over units, one walk's numbers are uniform,
    singly and in pairs, within an event and between two."""
    words, units = _random_numbers.key_words(jax.random.key(9)), jnp.arange(2**14, dtype=jnp.uint32)
    first, second = (
        np.asarray(_array_rqmc.points(units, jnp.uint32(t), words, 32, jnp.float64)) for t in (0, 1)
    )
    for row in (2, 4, 8, 16, 32):
        strata = np.sort((row * first[0]).astype(int).reshape(len(units), -1, row), axis=2)
        np.testing.assert_array_equal(strata, np.broadcast_to(np.arange(row), strata.shape))
    for number in first:
        strata = np.sort((32 * number).astype(int), axis=1)
        np.testing.assert_array_equal(strata, np.tile(np.arange(32), (len(units), 1)))
    pairs = [(first[i][:, 5], first[j][:, 5]) for i in range(6) for j in range(i)]
    pairs += [(first[i][:, 5], second[j][:, 5]) for i in range(6) for j in range(6)]
    for x, y in pairs:
        counts, *_ = np.histogram2d(x, y, 16, ((0, 1), (0, 1)))
        assert stats.chisquare(counts.ravel()).pvalue > 1e-4


def test_places_follow_the_curve():
    """A permutation by unit; walks of one quarter of the square stand together."""
    height, steep = np.random.default_rng(1).uniform(size=(2, 3, 64))
    place = np.asarray(_array_rqmc.places(jnp.asarray(height), jnp.asarray(steep)))
    np.testing.assert_array_equal(np.sort(place, axis=1), np.tile(np.arange(64), (3, 1)))
    quarter = (2 * steep).astype(int) * 2 + (2 * height).astype(int)
    along = np.take_along_axis(quarter, place, axis=1)
    np.testing.assert_array_equal(along, np.sort(quarter, axis=1))


def test_draws_of_neighbours_and_events_are_unrelated():
    """Correlation between the numbers of one draw, of neighbouring paths and of successive
    events, and the pairs' chi-squared on a grid."""
    words = _random_numbers.key_words(jax.random.key(7))
    paths = jnp.arange(DRAWS, dtype=jnp.uint32)
    first = np.asarray(_random_numbers.uniforms(paths, jnp.uint32(0), words, jnp.float64))
    second = np.asarray(_random_numbers.uniforms(paths, jnp.uint32(1), words, jnp.float64))
    pairs = [(first[i], first[j]) for i in range(4) for j in range(i)]
    pairs += [(first[i], second[i]) for i in range(4)]
    pairs += [(first[i][1:], first[i][:-1]) for i in range(4)]
    for x, y in pairs:
        counts, *_ = np.histogram2d(x, y, 16, ((0, 1), (0, 1)))
        assert stats.chisquare(counts.ravel()).pvalue > 1e-4
