"""Kd of 1,000 casts of 7 bands and 100 depths: one call against a loop of scipy's curve_fit.

    python -m tests.benchmarks.bench_profiles

Processor time of both, in the same run, errors given; the first call, which compiles, apart.
"""

import time

import jax
import numpy as np
from scipy.optimize import curve_fit

from fitting import Profile, fit_profiles

CASTS, BANDS, DEPTHS = 1000, 7, 100
LOOP = 100


def casts(seed: int = 0) -> list[Profile]:
    """Casts down to 12 % light in the clearest band, 5 % noise."""
    rng = np.random.default_rng(seed)
    made = []
    for kd in np.exp(rng.uniform(np.log(0.04), np.log(0.4), (CASTS, BANDS))):
        depth = np.linspace(0.2, 1.0, DEPTHS) * 2.1 / kd.min()
        clean = np.exp(-kd * depth[:, None])
        seen = clean * (1 + 0.05 * rng.standard_normal(clean.shape))
        made.append(Profile(depth, 400.0 + 10.0 * np.arange(BANDS), seen, sigma=0.05 * clean))
    return made


def _model(depth, surface, kd):
    return surface * np.exp(-kd * depth)


def main():
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    many = casts()
    times = []
    for _ in range(4):
        start = time.process_time()
        fits = fit_profiles(many, depth_range=(0.0, 1e4))
        times.append(time.process_time() - start)
    start, worst = time.process_time(), 0.0
    for i, cast in enumerate(many[:LOOP]):
        ours = fits[i].quantities["Kd"].value
        for band in range(BANDS):
            (_, kd), _ = curve_fit(
                _model,
                cast.depth,
                cast.Ed[:, band],
                p0=(cast.Ed[0, band], 0.1),
                sigma=cast.sigma[:, band],
                absolute_sigma=True,
            )
            worst = max(worst, abs(kd / ours[band] - 1))
    loop = (time.process_time() - start) * CASTS / LOOP
    best = min(times[1:])
    print(f"fit_profiles: {best:.2f} s (first call {times[0]:.2f} s); curve_fit: {loop:.2f} s")
    print(f"ratio {loop / best:.1f}; Kd differs by {worst:.1e} at most")


if __name__ == "__main__":
    main()
