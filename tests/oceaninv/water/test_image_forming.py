"""Light of targets of finite size: against a direct integral, limits, random walks, derivatives."""

import csv
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.special import j0, j1

import oceaninv as oi
from oceaninv.water.bio_optics import particle_phase
from oceaninv.water.image_forming import discs_of_rectangle
from tests.paths import REFERENCE

PHASES = {
    "HG": oi.phase.HenyeyGreenstein(0.9),
    "Petzold": oi.phase.petzold(),
    "FF": oi.phase.FournierForand(0.010),
    "seawater": oi.phase.Seawater(),
}


def water_of(a, b, phase):
    return oi.IOPs([550.0], jnp.asarray([float(a)]), jnp.asarray([float(b)]), phase)


def gain(a, b, phase, sizes, width=1.0):
    """M of discs of these sizes over range, at 1 m."""
    seen = oi.disc_transmission(
        water_of(a, b, phase), jnp.ones(1), jnp.asarray(sizes, float)[None], width
    )
    return np.asarray(seen)[0, :, 0] * np.exp(a + b)


def direct_phi(phase, q):
    """Phi by panels of the angle, with K by integration of J0."""
    edges = np.concatenate([[0.0], np.geomspace(np.radians(0.1), np.pi / 2, 81)])
    x, w = np.polynomial.legendre.leggauss(24)
    z, zw = np.polynomial.legendre.leggauss(200)
    total = 0.0
    for low, high in itertools.pairwise(edges):
        t = low + (high - low) * (x + 1) / 2
        kernel = j0(np.outer(q * np.tan(t), (z + 1) / 2)) @ zw / 2
        density = np.asarray(phase(jnp.asarray(np.cos(t))))
        total += np.sum(w * (high - low) / 2 * 2 * np.pi * np.sin(t) * density * kernel)
    return total


@functools.cache
def direct_spline():
    grid = np.geomspace(1e-3, 700.0, 100)
    return CubicSpline(np.log(grid), [direct_phi(PHASES["HG"], q) for q in grid])


@pytest.mark.parametrize("b", [0.3, 3.0])
def test_a_disc_is_the_hankel_integral(b):
    """HG: Phi is smooth and falls off fast, so that plain quadrature between zeros of J1 serves."""
    phase, size = PHASES["HG"], 0.1
    values = direct_spline()
    x, w = np.polynomial.legendre.leggauss(40)

    def part(low, high):
        q = low + (high - low) * (x + 1) / 2
        bracket = np.expm1(b * values(np.log(np.maximum(q, 1e-3))))
        return np.sum(w * (high - low) / 2 * j1(q * size) * size * bracket)

    edges = np.concatenate([[0.0, 0.1, 1.0, 3.0, 10.0], np.arange(1, 20) * np.pi / size])
    sums = np.cumsum([part(*pair) for pair in itertools.pairwise(edges)])
    # Alternating: the mean of the last sums, repeated, is the limit.
    while len(sums) > 1:
        sums = (sums[1:] + sums[:-1])[-12:] / 2
    found = gain(0.2, b, phase, [size])[0] - 1
    np.testing.assert_allclose(found, sums[0], rtol=1e-3)


@pytest.mark.parametrize("phase", PHASES.values(), ids=PHASES.keys())
@pytest.mark.parametrize("b", [0.1, 1.0, 10.0])
def test_limits_of_small_and_large_discs(phase, b):
    water = water_of(0.3, b, phase)
    small, none, large = gain(0.3, b, phase, [1e-9, 0.0, 1e9])
    assert abs(small - 1) < 1e-7 * np.exp(b)
    assert none == pytest.approx(1.0, abs=1e-14)
    forward = float(water.b[0] - water.bb[0])
    assert large == pytest.approx(np.exp(forward), rel=1e-4 * max(b, 0.3))


def test_gain_grows_with_size_and_falls_with_the_width_of_the_peak():
    sizes = np.geomspace(1e-4, 10.0, 60)
    for phase in PHASES.values():
        found = gain(0.1, 2.0, phase, sizes)
        assert np.all(np.diff(found) > 0)
        assert np.all(gain(0.1, 2.0, phase, sizes, 2.0) < found + 1e-12)
        # The same function of the angle, stretched: that of half the size, at small angles.
    narrow = gain(0.1, 1.0, PHASES["FF"], [0.02])
    wide = gain(0.1, 1.0, PHASES["FF"], [0.06], 3.0)
    np.testing.assert_allclose(wide, narrow, rtol=1e-4)


def test_phase_shapes_mix_linearly_in_the_exponent():
    """Light that two scatterers send through angles: the product of their gains of an endless disc,
    and the same water whether a mixture or two rows of b describe it."""
    one, two = PHASES["HG"], PHASES["FF"]
    rows = oi.IOPs([550.0], jnp.asarray([0.1]), jnp.asarray([[0.4], [0.8]]), (one, two))
    mixture = water_of(0.1, 1.2, oi.phase.Mixture(jnp.asarray([0.4, 0.8]), (one, two)))
    at = (jnp.asarray([1.5]), jnp.asarray([[0.05, 0.2]]))
    np.testing.assert_allclose(
        oi.disc_transmission(rows, *at), oi.disc_transmission(mixture, *at), rtol=1e-12
    )


def test_a_rectangle_is_the_mean_over_its_edge():
    water = water_of(0.1, 1.0, PHASES["Petzold"])
    at = jnp.asarray([2.0])
    wide, high = jnp.asarray([0.3]), jnp.asarray([0.1])
    found = float(oi.target_transmission(water, at, wide, high)[0, 0])
    azimuth = (np.arange(4000) + 0.5) / 4000 * np.pi / 2
    edge = np.minimum(0.3 / np.cos(azimuth), 0.1 / np.sin(azimuth))
    discs = oi.disc_transmission(water, at, jnp.asarray(edge)[None])[0, :, 0]
    assert found == pytest.approx(float(discs.mean()), rel=2e-6)
    # Turned by a right angle it is the same; a square lies between its inner and outer circle.
    assert found == pytest.approx(float(oi.target_transmission(water, at, high, wide)[0, 0]))
    square = float(oi.target_transmission(water, at, high)[0, 0])
    inner, outer = oi.disc_transmission(water, at, jnp.asarray([[0.1, 0.1 * 2**0.5]]))[0, :, 0]
    assert inner < square < outer
    assert np.isfinite(discs_of_rectangle(jnp.zeros(1), jnp.ones(1))[0]).all()


def test_nothing_lost_without_water_and_no_gain_without_scattering():
    empty = water_of(0.0, 0.0, PHASES["HG"])
    assert float(oi.target_transmission(empty, jnp.ones(1), jnp.ones(1))[0, 0]) == 1.0
    dark = water_of(0.7, 0.0, PHASES["HG"])
    found = float(oi.target_transmission(dark, jnp.ones(1), jnp.ones(1))[0, 0])
    assert found == pytest.approx(np.exp(-0.7), rel=1e-12)


def test_derivatives_agree_with_differences_in_both_modes():
    def seen(x):
        phase = oi.phase.HenyeyGreenstein(x[5])
        b = jnp.stack([x[1:2], x[6:7]])
        water = oi.IOPs([550.0], x[0:1], b, (PHASES["FF"], phase))
        return oi.target_transmission(water, x[2:3], x[3:4], x[4:5], x[7])[0, 0]

    x = jnp.asarray([0.2, 1.5, 2.0, 0.1, 0.15, 0.85, 0.3, 1.3])
    forward = jax.jit(jax.jacfwd(seen))(x)
    reverse = jax.jit(jax.grad(seen))(x)
    step = 1e-6 * np.abs(x)
    value = jax.jit(jax.vmap(seen))
    up, down = (value(jnp.asarray(np.asarray(x) + sign * np.diag(step))) for sign in (1, -1))
    difference = np.asarray(up - down) / (2 * step)
    np.testing.assert_allclose(forward, difference, rtol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)
    assert np.all(np.abs(forward) > 1e-4)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_value_and_gradient_are_finite_at_the_extremes(dtype):
    phase = jax.tree.map(lambda v: v.astype(dtype), PHASES["HG"])

    @jax.jit
    def with_slope(x):
        def seen(x):
            water = oi.IOPs([550.0], x[0:1], x[1:2], phase)
            return oi.target_transmission(water, x[2:3], x[3:4])[0, 0]

        return seen(x), jax.grad(seen)(x)

    for a, b, r, h in itertools.product(
        (0.0, 1e-20, 50.0), (0.0, 1e-20, 100.0), (1e-6, 1.0, 1e4), (0.0, 1e-12, 1e6)
    ):
        value, slope = with_slope(jnp.asarray([a, b, r, h], dtype))
        assert value.dtype == dtype
        assert np.isfinite(value)
        assert 0 <= value <= 1 + 1e-5
        assert np.all(np.isfinite(slope))


def test_float32_agrees_with_float64():
    sizes = jnp.asarray([[0.003, 0.03, 0.3]])
    for b in (0.3, 3.0):
        water = water_of(0.1, b, PHASES["FF"])
        whole = oi.disc_transmission(water, jnp.ones(1), sizes)
        short = jax.tree.map(lambda v: v.astype(jnp.float32), (water, jnp.ones(1), sizes))
        np.testing.assert_allclose(oi.disc_transmission(*short), whole, rtol=2e-5)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((0.0, 0.1, 0.1), "distance must be"),
        ((1.0, -0.1, 0.1), "half_width must be"),
        ((1.0, 0.1, np.nan), "half_height must be"),
        ((1.0, 0.1, 0.1, 0.0), "peak_width must be"),
    ],
)
def test_what_lies_outside_the_domain_raises(arguments, said):
    distance, wide, high = (jnp.asarray([v]) for v in arguments[:3])
    with pytest.raises(ValueError, match=said):
        oi.target_transmission(
            water_of(0.1, 1.0, PHASES["HG"]), distance, wide, high, *arguments[3:]
        )


WALKED = {
    "HG 0.9": PHASES["HG"],
    "Petzold": PHASES["Petzold"],
    "FF 0.010": PHASES["FF"],
    "FF 0.018": oi.phase.FournierForand(0.018),
    "particles 0.010": particle_phase(0.010),
    "particles 0.018": particle_phase(0.018),
}


# Where absorption is twice scattering, the longer way of scattered light is felt: M is too large by
# up to 14 % where the unabsorbed share is e^-9.
@pytest.mark.parametrize(
    ("absorption", "rms", "worst"), [(0.25, 0.0055, 0.025), (2.0, 0.033, 0.15)]
)
def test_gain_agrees_with_random_walks(absorption, rms, worst):
    """Tables by `tests/reference/regenerate_image_forming.py`."""
    with (REFERENCE / "image_forming_walks.csv").open() as file:
        rows = [*csv.DictReader(line for line in file if not line.startswith("#"))]
    rows = [row for row in rows if float(row["a_over_b"]) == absorption]
    found, true = [], []
    for name, phase in WALKED.items():
        own = [row for row in rows if row["phase"] == name]
        b, half = (np.array([float(row[key]) for row in own]) for key in ("b_r", "h_over_r"))
        lengths, place = np.unique(b, return_inverse=True)
        water = oi.IOPs([550.0], jnp.asarray([absorption]), jnp.asarray([1.0]), phase)
        sizes = np.unique(half)
        grid = np.repeat(lengths, len(sizes)), np.tile(sizes, len(lengths))
        seen = oi.target_transmission(water, jnp.asarray(grid[0]), jnp.asarray(grid[0] * grid[1]))
        table = np.asarray(seen)[:, 0].reshape(len(lengths), len(sizes))
        gains = table * np.exp((1.0 + absorption) * lengths)[:, None]
        found.append(gains[place, np.searchsorted(sizes, half)])
        true.append([float(row["M"]) for row in own])
    off = np.log(np.array(found) / np.array(true))
    assert off.shape == (6, 36)
    assert np.abs(off).max() < worst
    assert np.all(np.sqrt(np.mean(off**2, axis=1)) < rms)
