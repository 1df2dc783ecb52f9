"""The reference for light that arrives in a board's own image, against what is known of it."""

import csv
import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import oceaninv as oi
from oceaninv.water.bio_optics import particle_phase
from tests.reference import regenerate_image_forming as walks

KNOWN = {
    "HG 0.9": lambda: oi.phase.HenyeyGreenstein(0.9),
    "Petzold": oi.phase.petzold,
    "FF 0.010": lambda: oi.phase.FournierForand(0.010),
    "FF 0.018": lambda: oi.phase.FournierForand(0.018),
    "particles 0.010": lambda: particle_phase(0.010),
    "particles 0.018": lambda: particle_phase(0.018),
}


def table():
    """{(phase, b r, a/b): (size, 3) of M, stderr, M of the back}."""
    lines = walks.PATH.read_text().splitlines()
    found = {}
    for row in csv.DictReader(line for line in lines if not line.startswith("#")):
        key = (row["phase"], float(row["b_r"]), float(row["a_over_b"]))
        numbers = [float(row[name]) for name in ("M", "stderr", "M_back")]
        found.setdefault(key, {})[float(row["h_over_r"])] = numbers
    return {
        key: np.array([rows[float(size)] for size in walks.SIZES]) for key, rows in found.items()
    }


def test_the_table_holds_every_case_to_its_stated_error():
    found = table()
    assert len(found) == len(walks.PHASES) * len(walks.LENGTHS) * len(walks.ABSORPTION)
    for (_, length, _), rows in found.items():
        value, error, back = rows.T
        assert np.all(error < 6e-4 * value)
        assert np.all(np.diff(value) > 0)
        assert np.all((value > 1) & (value < math.exp(length)))
        assert np.all((back >= 0) & (back < 0.01 * value))


@pytest.mark.parametrize("name", walks.PHASES)
def test_drawn_angles_follow_the_phase_function(name):
    phase = KNOWN[name]()
    # Within 0.1 degrees the phase function holds its mean over that cone.
    edges = np.concatenate([[0.0], np.geomspace(np.radians(0.1), math.pi, 60)])
    fine = np.geomspace(edges[1], math.pi, 59 * 500 + 1)
    ring = 2 * math.pi * np.asarray(phase(jnp.asarray(np.cos(fine)))) * np.sin(fine) * fine
    steps = np.diff(np.log(fine)) * (ring[1:] + ring[:-1]) / 2
    share = steps.reshape(59, 500).sum(axis=1)
    share = np.concatenate([[1 - share.sum()], share])
    rng = np.random.default_rng(5)
    drawn = walks.draw_angles(walks.angle_table(walks.PHASES[name]), rng.random(2**20))
    count = np.histogram(drawn, edges)[0]
    assert count.sum() == 2**20
    assert stats.chisquare(count, share * 2**20).pvalue > 1e-3


def test_a_turned_direction_makes_the_angle():
    rng = np.random.default_rng(6)
    theta = walks.draw_angles(walks.angle_table(walks.PHASES["FF 0.010"]), rng.random(1000))
    start = rng.normal(size=(3, 1000))
    start /= np.linalg.norm(start, axis=0)
    new = walks.turned(start, theta, 2 * math.pi * rng.random(1000))
    moved = np.linalg.norm(new - start, axis=0)
    np.testing.assert_allclose(moved, 2 * np.sin(theta / 2), rtol=1e-9, atol=1e-14)


def once_scattered(cumulative, length: float, ratio: float, size: float) -> float:
    """M - 1 by a single scattering, all distances in units of 1/b."""
    x, w = np.polynomial.legendre.leggauss(64)
    # Scattering at the distance d from the board, d = length u^4: dense near the board.
    u, weight = (x + 1) / 2, w / 2
    distance, weight = length * u**4, weight * 4 * length * u**3
    azimuth = math.pi / 4 * (x + 1) / 2
    edge = size * length / np.cos(azimuth)
    # Integral over the angle by the cumulative function, in 200 steps up to the board's edge.
    widest = np.arctan(edge[None, :] / distance[:, None])
    theta = widest[..., None] * np.linspace(0, 1, 201) ** 3
    longer = distance[:, None, None] * (1 / np.cos((theta[..., 1:] + theta[..., :-1]) / 2) - 1)
    shares = np.diff(cumulative(theta), axis=-1) * np.exp(-(1 + ratio) * longer)
    return float(weight @ shares.sum(axis=-1) @ (w / 2))


@pytest.mark.parametrize("name", walks.PHASES)
def test_short_ranges_are_single_scattering(name):
    for ratio in walks.ABSORPTION:
        value, error, _ = table()[name, 0.1, float(ratio)].T
        for size, found, spread in zip(walks.SIZES, value - 1, error, strict=True):
            with np.errstate(all="ignore"):
                first = once_scattered(walks.PHASES[name], 0.1, ratio, size)
            # What is scattered twice: between independent hits and every one of them.
            assert first + 0.45 * first**2 - 4 * spread < found < first + 0.1**2 / 2 + 4 * spread


def test_fresh_walks_agree_with_the_table():
    (value, error, _), _ = walks.reference("Petzold", 1.0, np.random.default_rng(8), 4e-3)
    for k, ratio in enumerate(walks.ABSORPTION):
        known, spread, _ = table()["Petzold", 1.0, float(ratio)].T
        assert np.all(np.abs(value[k] - known) < 4 * np.hypot(error[k], spread))
