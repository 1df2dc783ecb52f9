"""Statistics of the photo fit where the shapes of all spectra are known: bounds, coverage, ranks.

    python -m tests.acceptance.photo_known

Protocol of `photo_statistics` (24 patches at 1, 2 and 4 m and open water; exposure, white balance
and the light on each chart unknown, 1 % noise), tie, slopes, camera and closed form known to 0.1 %.
Constituents are drawn from the fit's prior, a factor of 1.65 about a coastal water, so that the
ranks of the truth in the fitted distributions must be uniform (simulation-based calibration, Talts
et al. 2018).  Prints the table and writes photo_known.md beside this file.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np
from scipy.stats import kstest, norm

from fitting.parameters import Parameter
from fitting.posterior import half_width
from tests.acceptance import photo_statistics as one

DRAWS = 100
FREE = ("depth_0", *(f"chart_0_{k}" for k in range(3)))


def changes() -> dict[str, Parameter]:
    """Priors of this protocol by name."""
    found = {}
    for p in one.problem()[0]:
        if p.name in one.COAST:
            found[p.name] = dataclasses.replace(p, centre=one.COAST[p.name], spread=0.5)
        elif p.spread is not None and p.name not in FREE:
            found[p.name] = dataclasses.replace(p, spread=1e-3)
    return found


def truths(count: int, seed: int) -> np.ndarray:
    """(draw, unknown) coordinates from the priors; gains, which have none, arbitrary."""
    parameters = one.problem()[0].replace(changes())
    rng = np.random.default_rng(seed)
    x = np.tile(np.asarray(parameters.prior().centre), (count, 1))
    for i, p in enumerate(parameters):
        x[:, i] += (0.5 if p.spread is None else p.spread) * rng.standard_normal(count)
    return x


def table(count: int = DRAWS, seed: int = 21) -> str:
    x = truths(count, seed)
    exact, logs = one.by_chunks(one.programs()[0], x)
    noise = np.random.default_rng(seed + 1).standard_normal(exact.shape)
    best = one.bayesian_bound(x, changes=changes())[0]
    found, code, cov, _, bias, spread, log_found, of_logs, derived = one.fit_all(
        exact * (1 + one.NOISE * noise), np.full(count, one.SUN), changes()
    )
    lines = [
        "# Photo fit, matched model, shapes known\n",
        f"`python -m tests.acceptance.photo_known`: {count} draws, converged "
        f"{np.mean(code == 0):.3f}.  Errors are of logarithms.\n",
        "| | bound | sd / bound | bias / bound | 95th percentile of error / bound | 68 % covers | "
        "95 % covers | ranks uniform, p |",
        "|---|---|---|---|---|---|---|---|",
    ]
    rows = {}
    for name in one.COAST:
        i = one.problem()[0].names.index(name)
        off = found[:, i] - x[:, i]
        rows[name] = (off - bias[:, i], off, best[0][:, i], np.sqrt(cov[:, i, i]), spread[:, i])
    for q, name in enumerate(one.QUANTITIES):
        off = log_found[:, q] - logs[:, q]
        rows[name] = (off, off, best[1][:, q], of_logs[:, q], derived[:, q])
    for name, (error, of_mode, bound, sd, extra) in rows.items():
        share = error / bound
        cover = [np.mean(np.abs(of_mode) <= half_width(p, sd, extra)) for p in one.LEVELS]
        lines.append(
            f"| {name} | {np.median(bound):.4f} | {share.std(ddof=1):.3f} | {share.mean():+.3f} | "
            f"{np.quantile(np.abs(share), 0.95):.2f} | {cover[0]:.3f} | {cover[1]:.3f} | "
            f"{kstest(norm.cdf(-of_mode / sd), 'uniform').pvalue:.3f} |"
        )
    return "\n".join(lines)


def main():
    jax.config.update("jax_enable_x64", True)
    report = table()
    print(report)
    Path(__file__).with_suffix(".md").write_text(report + "\n")


if __name__ == "__main__":
    main()
