"""Kd of a band against dense matrices: outliers, candidates for the waves, and their weights."""

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.profile.kd.band_fit import BandBatch, fit_band_batch

SIZE = 256
# Waves correlated over so many median spacings, and how their relative noise rises upwards.
SPACINGS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
RISES = ((0.0, 1.0), (2.0, 0.1), (4.0, 0.05))


def batch(casts, sigma=None):
    """`casts`: (depth, Ed, floor, dark_sd); padded side by side."""
    rows = [[np.pad(v, (0, SIZE - len(v)), constant_values=1.0) for v in one[:2]] for one in casts]
    depth, Ed = (jnp.asarray(np.stack(column)) for column in zip(*rows, strict=True))
    mask = np.stack([np.arange(SIZE) < len(one[0]) for one in casts])
    floor, dark_sd = (jnp.asarray([one[k] for one in casts]) for k in (2, 3))
    return BandBatch(
        depth,
        Ed,
        jnp.ones_like(Ed),
        None if sigma is None else jnp.full_like(Ed, sigma),
        floor,
        jnp.zeros_like(floor),
        dark_sd,
        jnp.asarray(mask),
        jnp.zeros((len(casts), 0)),
    )


def linearised(depth, Ed, state, dark_sd):
    signal = np.exp(state[0] - np.exp(state[1]) * depth)
    columns = [signal, -np.exp(state[1]) * depth * signal, np.full_like(depth, dark_sd)]
    return signal, np.stack(columns, axis=1), Ed - signal - state[2] * dark_sd


def even_fit(depth, Ed, floor, dark_sd):
    """State (ln Ed0, ln Kd, dark) and relative noise of independent, even noise."""
    slope, intercept = np.polyfit(depth, np.log(np.maximum(Ed, 1e-6)), 1)
    state, noise = np.array([intercept, np.log(-slope), 0.0]), 0.05
    known = np.diag([0.0, 0.0, 1.0])
    for _ in range(60):
        signal, jacobian, misfit = linearised(depth, Ed, state, dark_sd)
        variance = (noise * signal) ** 2 + floor**2
        information = jacobian.T / variance @ jacobian + known
        state = state + np.linalg.solve(
            information, jacobian.T @ (misfit / variance) - known @ state
        )
        noise *= np.sqrt(np.sum(misfit**2 / variance) / (len(depth) - 2))
    return state, noise


def averaged(depth, Ed, floor, dark_sd, state, noise):
    """One step: the mean over candidates by their restricted likelihood, with dense matrices."""
    signal, jacobian, misfit = linearised(depth, Ed, state, dark_sd)
    known, n = np.diag([0.0, 0.0, 1.0]), len(depth)
    spacing, reach = np.median(np.diff(depth)), depth[-1] - depth[0]
    found = []
    for count in SPACINGS:
        length = count * spacing
        # A wave longer than a fifth of the range cannot be told from the water.
        if length > reach / 5:
            continue
        correlation = np.eye(n)
        middle = 0.0
        if length > 0:
            neighbours = np.minimum(np.exp(-np.diff(depth) / length), 0.98)
            middle = min(np.exp(-spacing / length), 0.98)
            logs = np.concatenate([[0.0], np.cumsum(np.log(neighbours))])
            correlation = np.exp(-np.abs(logs[:, None] - logs[None, :]))
        for gain, share in RISES:
            rise = 1.0 + gain * np.exp(-(depth - depth[0]) / (share * reach))
            rise /= np.sqrt(np.mean(rise**2))
            sd = np.hypot(noise * rise * signal, floor)
            covariance = correlation * np.outer(sd, sd)
            solved = np.linalg.solve(covariance, np.column_stack([jacobian, misfit]))
            information = jacobian.T @ solved[:, :3] + known
            inverse = np.linalg.inv(information)
            step = inverse @ (jacobian.T @ solved[:, 3] - known @ state)
            left = misfit - jacobian @ step
            square = left @ np.linalg.solve(covariance, left)
            likelihood = -0.5 * (
                (n - 2) * np.log(square)
                + np.linalg.slogdet(information)[1]
                + np.linalg.slogdet(covariance)[1]
            )
            # Even odds for correlated noise, shared by seven lengths; one in five for rising noise,
            # shared by two shapes.
            likelihood += np.log(1.0 / 7) if count else 0.0
            likelihood += np.log(0.2 / 2) if gain else 0.0
            scale = square / (n - 2)
            independent = (1 - middle) / (1 + middle)
            found.append((likelihood, step, scale * inverse, scale, independent, length))
    likelihood, steps, inverses, scales, independent, lengths = map(
        np.array, zip(*found, strict=True)
    )
    weight = np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    mean = weight @ steps
    apart = steps - mean
    return {
        "state": state + mean,
        "covariance": np.einsum("k,kij->ij", weight, inverses)
        + np.einsum("k,ki,kj->ij", weight, apart, apart),
        "noise": noise * np.sqrt(weight @ scales),
        "dof": max((weight @ independent) * (n - 2), 1.0),
        "length": weight @ lengths,
    }


def simulated(count, length, rise, seed, floor=1e-4):
    """Waves of relative noise 0.05, correlated over `length` spacings, stronger near the top."""
    rng = np.random.default_rng(seed)
    depth = 0.2 + 10.0 * np.arange(count) / count
    apart = np.abs(np.arange(count)[:, None] - np.arange(count)[None, :])
    root = np.linalg.cholesky(np.exp(-apart / max(length, 1e-3)))
    waves = 0.03 * (1.0 + rise * np.exp(-depth / 0.7)) * (root @ rng.standard_normal(count))
    Ed = np.exp(-0.2 * depth) * (1.0 + waves) + floor * rng.standard_normal(count)
    return depth, Ed, floor, 2e-3


# 153 and 85 samples: 32 and 16 spacings are just above, and just below, a fifth of the range.
CASES = [(40, 0.0, 0.0), (40, 1.0, 1.0), (60, 0.5, 0.4), (85, 12.0, 0.0), (85, 3.0, 2.0),
         (153, 25.0, 0.0), (200, 40.0, 0.5), (30, 0.3, 3.0)]  # fmt: skip


def test_the_mean_over_candidates_is_that_of_dense_matrices():
    casts = [simulated(*case, seed) for seed, case in enumerate(CASES)]
    fit = fit_band_batch(batch(casts))
    spread = []
    for i, cast in enumerate(casts):
        assert np.asarray(fit.used)[i].sum() == len(cast[0]), "an outlier: take another seed"
        state, noise = even_fit(*cast)
        first = averaged(*cast, state, noise)
        last = averaged(*cast, first["state"], noise)
        for name, found in (
            ("state", np.asarray(fit.x)[i]),
            ("covariance", np.asarray(fit.covariance)[i]),
            ("noise", np.asarray(fit.noise)[i]),
            ("dof", np.asarray(fit.dof)[i]),
            ("length", np.asarray(fit.length)[i]),
        ):
            expected = last[name]
            expected = expected[:2] if name == "state" else expected
            expected = expected[:2, :2] if name == "covariance" else expected
            np.testing.assert_allclose(
                found, expected, rtol=2e-4, atol=1e-9, err_msg=f"{name} of {CASES[i]}"
            )
        spread.append(last["length"])
    assert min(spread) < 0.1
    assert max(spread) > 1.0


def test_readings_beyond_four_standard_deviations_are_left_out():
    """One in 16,000 good ones.  Errors given: 0.01, and hardly any noise but in one sample."""
    depth = 0.2 + 0.05 * np.arange(200)
    light = np.exp(-0.2 * depth) * (1.0 + 1e-5 * np.cos(np.arange(200.0)))
    casts = []
    for size in (3.9, 4.1, -3.9, -4.1):
        Ed = light.copy()
        Ed[100] += size * 0.01
        casts.append((depth, Ed, 0.0, 0.0))
    used = np.asarray(fit_band_batch(batch(casts, sigma=0.01)).used)
    assert used[:, 100].tolist() == [True, False, True, False]
    assert np.all(np.delete(used[:, :200], 100, axis=1))


@pytest.mark.parametrize(("size", "seen"), [(11.3, True), (12.7, False)])
def test_given_errors_that_are_too_small_make_no_outliers(size, seen):
    """Noise of three times what was given, by its median: the cut is at twelve."""
    depth = 0.2 + 0.05 * np.arange(SIZE)
    z = np.random.default_rng(4).standard_normal(SIZE)
    z *= 0.6745 / np.median(np.abs(z))
    z[120] = size / 3.0
    Ed = np.exp(-0.2 * depth) + 0.01 * 3.0 * z
    used = np.asarray(fit_band_batch(batch([(depth, Ed, 0.0, 0.0)] * 4, sigma=0.01)).used)
    assert used[0, 120] == seen
