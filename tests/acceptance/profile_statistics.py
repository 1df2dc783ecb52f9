"""Statistics of the exponential fit of casts: error against the Cramer-Rao bound, coverage.

    python -m tests.acceptance.profile_statistics

Prints the table and writes it beside this file (profile_statistics.md).  Seeded; a minute.

Casts: one band each, Kd 0.03-0.5 /m, 20-60 depths evenly down to 10-1 % of the light, 5 % wave
noise that multiplies, a noise floor of 0.2 % of Ed(0-).  The bound comes from finite differences of
the exponential model's mean and variance, with the true noise.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import binom

from fitting._bands import fit_bands
from fitting.posterior import quantile

CASTS = 2000
DEPTHS = 64
WAVES, FLOOR = 0.05, 0.002
LEVELS = (0.68, 0.95)


def casts(count: int = CASTS, seed: int = 20):
    """ln Ed(0-) and ln Kd (count,), depths, true Ed and readings (count, DEPTHS), mask, floor."""
    rng = np.random.default_rng(seed)
    kd = np.exp(rng.uniform(np.log(0.03), np.log(0.5), count))
    surface = np.exp(rng.uniform(-3, 3, count))
    optical = rng.uniform(np.log(10.0), np.log(100.0), count)
    number = rng.integers(20, 61, count)
    mask = np.arange(DEPTHS) < number[:, None]
    depth = np.where(mask, (np.arange(DEPTHS) + 0.5) / number[:, None], 0.0)
    depth = depth * (optical / kd)[:, None]
    floor = FLOOR * surface
    true = surface[:, None] * np.exp(-kd[:, None] * depth)
    noise = rng.standard_normal((2, count, DEPTHS))
    seen = true * (1 + WAVES * noise[0]) + floor[:, None] * noise[1]
    return np.log(surface), np.log(kd), depth, true, seen, mask, floor


def bound(log_surface, log_kd, depth, mask, floor, noise_known: bool, step: float = 1e-5):
    """(count,) Cramer-Rao standard deviation of ln Kd, by central finite differences.

    Unknowns ln Ed(0-), ln Kd and, unless the noise is known, ln of the wave noise.
    """

    def moments(x):
        mean = np.exp(x[0][:, None] - np.exp(x[1])[:, None] * depth)
        return mean, (np.exp(x[2])[:, None] * mean) ** 2 + floor[:, None] ** 2

    x = np.stack([log_surface, log_kd, np.full_like(log_kd, np.log(WAVES))])
    _, variance = moments(x)
    slopes = []
    for move in step * np.eye(3)[: 2 if noise_known else 3]:
        up, down = moments(x + move[:, None]), moments(x - move[:, None])
        slopes.append([(u - d) / (2 * step) for u, d in zip(up, down, strict=True)])
    n = len(slopes)
    information = np.empty((len(log_kd), n, n))
    for i in range(n):
        for j in range(n):
            of_mean = slopes[i][0] * slopes[j][0] / variance
            of_variance = 0.5 * slopes[i][1] * slopes[j][1] / variance**2
            information[:, i, j] = np.sum(np.where(mask, of_mean + of_variance, 0.0), axis=1)
    return np.sqrt(np.linalg.inv(information)[:, 1, 1])


def statistics(sigma_given: bool, count: int = CASTS, seed: int = 20) -> dict[str, float]:
    """RMS error over the bound, mean error over it, coverage and its band, convergence."""
    log_surface, log_kd, depth, true, seen, mask, floor = casts(count, seed)
    sigma = np.sqrt((WAVES * true) ** 2 + floor[:, None] ** 2) if sigma_given else None
    used = mask & (seen > 0)
    fit = fit_bands(
        jnp.asarray(depth),
        jnp.asarray(np.where(used, seen, 1.0)),
        None if sigma is None else jnp.asarray(sigma),
        jnp.asarray(floor),
        jnp.asarray(used),
    )
    error = np.asarray(fit.optimum.x)[:, 1] - log_kd
    sd = np.sqrt(np.asarray(fit.covariance)[:, 1, 1])
    best = bound(log_surface, log_kd, depth, mask, floor, sigma_given)
    out = {
        "rms / bound": float(np.sqrt(np.mean((error / best) ** 2))),
        "mean / bound": float(np.mean(error / best)),
        "converged": float(np.mean(np.asarray(fit.optimum.code) == 0)),
        "masked": int(np.sum(mask & ~used)),
    }
    freedom = used.sum(axis=1) - 2
    for level in LEVELS:
        reach = np.array([quantile(level, None if sigma_given else float(n)) for n in freedom])
        low, high = binom.interval(0.99, count, level)
        out[f"coverage {level}"] = float(np.mean(np.abs(error) <= reach * sd))
        out[f"band {level}"] = (float(low / count), float(high / count))
    return out


def main():
    jax.config.update("jax_enable_x64", True)
    rows = [
        "# Exponential fit of casts\n",
        f"`python -m tests.acceptance.profile_statistics`: {CASTS} casts, {WAVES:.0%} wave noise, "
        f"floor {FLOOR:.1%} of Ed(0-).\n",
        "| noise | RMS error of ln Kd / bound | mean / bound | 68 % intervals cover (99 % band) | "
        "95 % intervals cover (99 % band) | converged | readings masked |",
        "|---|---|---|---|---|---|---|",
    ]
    for given, label in ((True, "given"), (False, "estimated, Student's t")):
        s = statistics(given)
        cover = " | ".join(
            f"{s[f'coverage {p}']:.3f} ({s[f'band {p}'][0]:.3f}-{s[f'band {p}'][1]:.3f})"
            for p in LEVELS
        )
        rows.append(
            f"| {label} | {s['rms / bound']:.3f} | {s['mean / bound']:+.3f} | {cover} | "
            f"{s['converged']:.4f} | {s['masked']} |"
        )
    report = "\n".join(rows)
    print(report)
    Path(__file__).with_suffix(".md").write_text(report + "\n")


if __name__ == "__main__":
    main()
