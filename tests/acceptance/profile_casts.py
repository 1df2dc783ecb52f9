"""Casts as they are taken, from their readings to Kd: error against a bound, coverage.

    python -m tests.acceptance.profile_casts

Prints the table and writes it beside this file.  Seeded; two minutes.

Unlike profile_statistics, which feeds the fit of bands itself, whole casts go through `Profile`
and `fit_profiles`: ways down and up are told apart, stays at one depth merged, the floor of the
noise estimated.  The light is made here, by the exponential that the fit assumes: the table proves
the code and its statistics, not that real water is such.

Casts: three bands, Kd 0.03-0.5 /m, down to 20-1 % of the light in the first band; waves of 5 %,
correlated over 1-3 % of the range along the way and common to the bands; electronics of 0.02 % of
Ed(0-).  The bound is that of generalised least squares with the waves' correlation known, over
the samples down to 10 % of the light, each way with an Ed(0-) of its own.
"""

from pathlib import Path

import jax
import numpy as np
from scipy.stats import binom

from fitting import Profile, fit_profiles

CASTS, WAVES, FLOOR = 500, 0.05, 2e-4
BANDS, RATIO = np.array([412.0, 490.0, 555.0]), np.array([1.0, 0.7, 1.3])
KINDS = ("down", "down and up", "a stay at the surface, then down", "yo-yo of four ways")


def path_of(kind: str, deepest: float, rng) -> np.ndarray:
    """Depths in the order of measurement."""
    down = np.linspace(0.01, 1.0, 120) * deepest
    down = np.abs(down + 0.003 * deepest * rng.standard_normal(120))
    if kind == "down":
        return down
    if kind == "down and up":
        return np.concatenate([down, down[::-1]])
    if kind == KINDS[2]:
        return np.concatenate([np.abs(0.004 * deepest * rng.standard_normal(300)), down])
    return np.concatenate([down, down[::-1], down, down[::-1]])


def waves_along(depth: np.ndarray, length: float, rng) -> np.ndarray:
    """Waves of unit variance, correlated over a `length` of the way."""
    rho = np.exp(-np.abs(np.diff(depth, prepend=depth[0])) / length)
    white, value = rng.standard_normal(len(depth)), np.empty(len(depth))
    value[0] = white[0]
    for i in range(1, len(depth)):
        value[i] = rho[i] * value[i - 1] + np.sqrt(1 - rho[i] ** 2) * white[i]
    return value


def information(depth: np.ndarray, length: float, kd: float, floor: float, sun: float) -> float:
    """Of ln Kd in one way: slopes after the surface light has been eliminated."""
    inside = np.sort(depth[kd * depth < np.log(10.0)])
    gap = np.abs(inside[:, None] - inside[None, :])
    noise = WAVES**2 * np.exp(-gap / length)
    noise += np.diag((floor / (sun * np.exp(-kd * inside))) ** 2 + 1e-10)
    design = np.stack([np.ones_like(inside), -kd * inside], axis=1)
    fisher = design.T @ np.linalg.solve(noise, design)
    return float(fisher[1, 1] - fisher[0, 1] ** 2 / fisher[0, 0])


def study(kind: str, seed: int) -> str:
    rng, profiles, truth, bound = np.random.default_rng(seed), [], [], []
    for _ in range(CASTS):
        kd = np.exp(rng.uniform(np.log(0.03), np.log(0.5)))
        deepest = rng.uniform(np.log(5.0), np.log(100.0)) / kd
        depth = path_of(kind, deepest, rng)
        length = rng.uniform(0.01, 0.03) * deepest
        sun = np.exp(rng.uniform(-1.0, 1.0))
        light = sun * np.exp(-depth[:, None] * kd * RATIO)
        light = light * (1 + WAVES * waves_along(depth, length, rng))[:, None]
        profiles.append(
            Profile(depth, BANDS, light + FLOOR * sun * rng.standard_normal(light.shape))
        )
        truth.append(kd * RATIO)
        ways = {"down and up": 2, KINDS[3]: 4}.get(kind, 1)
        way = depth[-120:]
        told = [ways * information(way, length, k, FLOOR * sun, sun) for k in kd * RATIO]
        bound.append(np.array(told) ** -0.5)
    fits = fit_profiles(profiles)
    error, inside = [], {0.68: [], 0.95: []}
    for i, kd in enumerate(truth):
        if i in fits.failures:
            continue
        found = fits[i].quantities["Kd"]
        error.append(np.log(found.value / kd) / bound[i])
        for level, hits in inside.items():
            low, high = found.interval(level)
            hits.append((low < kd) & (kd < high))
    error = np.array(error)
    cells = [f"{np.sqrt(np.mean(error[:, 1] ** 2)):.3f}", f"{np.mean(error[:, 1]):+.3f}"]
    for level, hits in inside.items():
        band = binom.interval(0.99, len(error), level)
        ends = "-".join(f"{end / len(error):.3f}" for end in band)
        cells.append(f"{np.mean(np.array(hits)[:, 1]):.3f} ({ends})")
    return f"| {kind} | {' | '.join(cells)} | {len(fits.failures)} |"


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    rows = [study(kind, 70 + i) for i, kind in enumerate(KINDS)]
    text = "\n".join(
        [
            "# Casts as they are taken",
            "",
            f"`python -m tests.acceptance.profile_casts`: {CASTS} casts of each kind, their middle "
            "band; bound: waves' correlation known, samples down to 10 % light.  The light is the "
            "fit's own exponential: this proves the code and its statistics.",
            "",
            "| casts | RMS error of ln Kd / bound | mean / bound "
            "| 68 % intervals cover (99 % band) | 95 % intervals cover (99 % band) | refused |",
            "|---|---|---|---|---|---|",
            *rows,
        ]
    )
    print(text)
    Path(__file__).with_suffix(".md").write_text(text + "\n")


if __name__ == "__main__":
    main()
