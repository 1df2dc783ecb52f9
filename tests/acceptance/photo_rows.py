"""Photographs of known protocols: errors, intervals and identifiability over 200 seeds a row.

    python -m tests.acceptance.photo_rows [design | rows | weak | regions | draws | ranks]

Prints the tables and writes photo_rows_<part>.md beside this file (of `rows`: photo_rows.md);
minutes each.

Protocols (`_photo_protocols.py`): ColorCheckers and open water by a Nikon D850, water by the fit's
own model, white balance unknown throughout.

- ideal: charts at 0.5, 1 and 2 m, 1 % noise, everything else known.
- scattering ratio unknown: the same, b_d/a_d(400) of detritus known within a factor of 2.
- scattering ratio and all else unknown: the same, and all that `fit_photo` leaves open besides.
- three depths: one chart at 1 m in frames at 2, 8 and 15 m, 3 % noise, ranges known to 5 %,
  exposures to 3 %, light on a chart to 20 %, scattering ratio of detritus within a factor of 2.
- other reading: what of the above the words leave open, chosen so that the ideal protocol's bound
  is that of an independent calculation (`EXPECTED`): charts at 0.5, 3 and 8 m at 8 m depth, another
  coast, and bb/b of algae and of other particles further apart.
- single photo: charts at 1 and 3 m in a frame at 5 m, exposure unknown, else the same.

Truth: the constituents of one water, nuisances drawn from their priors.  The bound is Bayesian, by
finite differences of the forward model at every draw.  A row is met when `asked` and `measured`
say so; nothing is left out.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from scipy.stats import chi2, chisquare, norm

from fitting.commands.main import quick_compilation
from fitting.core.parameters import Prior
from fitting.core.result import _identifiable as identifiable
from fitting.core.result import half_width
from tests.acceptance._photo_posterior import region_of
from tests.acceptance._photo_posterior import sample as posterior
from tests.acceptance._photo_protocols import (
    CONSTITUENTS,
    NAMES,
    WATERS,
    bound,
    fit_all,
    losses,
    observe,
    priors,
    setup,
    truths,
)

DRAWS, SEED = 200, 21


class Outcome(NamedTuple):
    """Numbers of every draw, each (draw, NAMES): errors (ln) of value and mode, least sd, stated
    sd, stated second-order spread; `code`: of the search."""

    error: np.ndarray
    of_mode: np.ndarray
    best: np.ndarray
    sd: np.ndarray
    spread: np.ndarray
    code: np.ndarray

    def covers(self, level: float) -> np.ndarray:
        """(NAMES,) share of intervals, as `fitting.Fit` makes them, that hold the truth."""
        return np.mean(np.abs(self.of_mode) <= half_width(level, self.sd, self.spread), axis=0)


def simulate(protocol: str, water: str, count: int = DRAWS, seed: int = SEED) -> Outcome:
    made = setup(protocol)
    x = truths(made, WATERS[water], count, seed)
    seen, logs = observe(made, x, seed + 1)
    found = fit_all(made, seen)
    own = [made.parameters.names.index(name) for name in CONSTITUENTS]
    of_mode = np.concatenate([found["x"] - x, found["logs"] - logs], axis=1)
    pick = [*own, *range(x.shape[1], x.shape[1] + logs.shape[1])]
    of_mode = of_mode[:, pick]
    bias = np.concatenate([found["bias"][:, own], np.zeros_like(logs)], axis=1)
    sd = found["sd"][:, own]
    return Outcome(
        of_mode - bias,
        of_mode,
        bound(made, x),
        np.concatenate([sd, found["of_logs"]], axis=1),
        np.concatenate([found["spread"][:, own], found["derived"]], axis=1),
        found["code"],
    )


def table(title: str, out: Outcome, asked: dict[str, str]) -> str:
    """One table; `asked`: what the 95th percentile of |error| should be, by name."""
    share = np.abs(out.error) / out.best
    lines = [
        f"\n### {title}\n",
        f"{len(out.error)} seeds, converged {np.mean(out.code == 0):.3f}.\n",
        "| | bound | sd / bound | bias / bound | 68th percentile / bound | 95th / bound | 95th | "
        "asked | stated sd / bound | 68 % covers | 95 % covers |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    cover = [out.covers(level) for level in (0.68, 0.95)]
    for q, name in enumerate(NAMES):
        middle, high = np.quantile(share[:, q], [0.68, 0.95])
        worst = float(np.quantile(np.abs(out.error[:, q]), 0.95))
        worst_words = f"{np.expm1(worst):.1%}" if worst < np.log(1.5) else f"x {np.exp(worst):.2f}"
        lines.append(
            f"| {name} | {np.median(out.best[:, q]):.3f} | "
            f"{np.std(out.error[:, q] / out.best[:, q], ddof=1):.3f} | "
            f"{np.mean(out.error[:, q] / out.best[:, q]):+.3f} | {middle:.2f} | {high:.2f} | "
            f"{worst_words} | {asked.get(name, '-')} | "
            f"{np.median(out.sd[:, q] / out.best[:, q]):.3f} | "
            f"{cover[0][q]:.3f} | {cover[1][q]:.3f} |"
        )
    return "\n".join(lines)


IDEAL: dict[str, str] = dict(
    zip(NAMES, ("4.5 %", "5 %", "2.5 %", "4 %", "2 %", "1.3 %", "-"), strict=True)
)
THREE: dict[str, str] = dict(
    zip(NAMES, ("x 2.7", "x 2.6", "x 2.1", "32 %", "4 %", "8 %", "21 %"), strict=True)
)
SINGLE = {"c_550": "12 %", "Kd_490": "9 %", "a_cdm_440": "x 1.5"}


def rows(count: int = DRAWS):
    """Every row's table, one after the other."""
    yield (
        "# Photo fit, protocol by protocol\n\n`python -m tests.acceptance.photo_rows rows`.  "
        "Errors are of logarithms."
    )
    for water in ("coastal", "clear", "turbid"):
        yield table(f"ideal, {water}", simulate("ideal", water, count),
                    IDEAL if water == "coastal" else {})  # fmt: skip
    yield _other("ideal", IDEAL, count)
    yield (
        "\nWith the scattering ratio of detritus alone unknown the shapes of everything else are "
        "known exactly, and then "
        "readings tell detritus from CDOM by their slopes: where the true ratio is low, the bound "
        "itself lies below 0.25."
    )
    for name in ("scattering ratio unknown", "scattering ratio and all else unknown"):
        for water in ("coastal", "turbid"):
            out = simulate(name, water, count)
            yield table(f"{name}, {water}", out, {}) + "\n\n" + least_detritus(out)
    yield table("three depths, coastal", simulate("three depths", "coastal", count), THREE)
    yield _other("three depths", THREE, count)
    out = simulate("single photo", "coastal", count)
    yield table("single photo, coastal", out, SINGLE) + "\n\n" + flags("single photo", out)
    yield _other("single photo", SINGLE, count)


def _other(name: str, asked: dict[str, str], count: int) -> str:
    name = f"{name}, other reading"
    return table(name, simulate(name, "other coastal", count), asked)


def least_detritus(out: Outcome) -> str:
    """What the row of the unknown scattering ratio asks for."""
    q = NAMES.index("detritus")
    stated, best = out.sd[:, q], out.best[:, q]
    low = stated < 0.25
    rest = low & (best >= 0.25)
    held = np.abs(out.of_mode[:, q]) <= half_width(0.95, stated, out.spread[:, q])
    return (
        f"Stated sd of ln detritus (below 0.25 is a failure): smallest {stated.min():.3f}, below "
        f"0.25 in {np.sum(low)} seeds, in {np.sum(low & (best < 0.25))} of which the bound is, "
        f"too (the 95 % interval holds the truth in {np.sum(held & rest)} of the other "
        f"{np.sum(rest)}); the bound itself: smallest {best.min():.3f}, below 0.25 in "
        f"{np.sum(best < 0.25)}."
    )


# Expected sigma by an independent calculation, whose protocols are known by these words only:
# C, a_y, a_d, a_cdm(440), Kd(490), c(550), bb(550).
EXPECTED = {
    "background": (2.0, 0.41, 1.1, 0.54, 0.067, 0.27, 0.26),
    "ideal": (0.018, 0.017, 0.010, 0.014, 0.006, 0.005, 0.006),
    "single photo": (0.65, 0.24, 0.79, 0.19, 0.033, 0.050, 0.15),
    "three depths": (0.37, 0.17, 0.30, 0.11, 0.011, 0.031, 0.083),
    "three depths, shapes": (0.48, 0.29, 0.71, 0.15, 0.017, 0.032, 0.11),
    "three depths, matrix": (0.42, 0.18, 0.41, 0.12, 0.013, 0.035, 0.099),
    "three depths, a_y to 10 %": (0.26, 0.086, 0.26, 0.074, 0.009, 0.031, 0.064),
}
# The same, where what the words leave open is chosen otherwise (`_photo_protocols._OTHER`).
EXPECTED |= {
    f"{name}, other reading": EXPECTED[name] for name in ("ideal", "single photo", "three depths")
}


def design():
    """Bounds at the coast, nuisances at the centres of their priors, beside those expected."""
    yield (
        "# Bounds by protocol: expected elsewhere / here\n\n`python -m tests.acceptance.photo_rows "
        "design`.  Standard deviations of logarithms, coastal water.\n\n| protocol | "
        + " | ".join(NAMES)
        + " |\n"
        + "|---" * (len(NAMES) + 1)
        + "|"
    )
    for name, expected in EXPECTED.items():
        made = setup(name)
        x = np.array(made.parameters.prior().centre)[None]
        water = WATERS["other coastal" if "other" in name else "coastal"]
        for i, p in enumerate(made.parameters):
            if p.name in CONSTITUENTS:
                x[0, i] = np.log(water[CONSTITUENTS.index(p.name)])
        here = bound(made, x)[0]
        cells = [f"{e:.3g} / {h:.2g}" for e, h in zip(expected, here, strict=True)]
        yield f"| {name} | " + " | ".join(cells) + " |"


def weak(count: int = DRAWS):
    """Photographs that cannot tell: what is flagged, and whether intervals hold the truth."""
    yield (
        "# Photographs that cannot tell\n\n`python -m tests.acceptance.photo_rows weak`.  Every "
        "nuisance of the default fit is free and drawn from its prior; coastal water."
    )
    cases = ("white balance known", "everything unknown")
    for name in (*(f"background, {case}" for case in cases), "JPEG without chart"):
        out = simulate(name, "coastal", count)
        yield table(name, out, {}) + "\n\n" + flags(name, out)


def flags(name: str, out: Outcome) -> str:
    known = {p.name: p for p in setup(name).parameters}
    words = []
    for q, constituent in enumerate(CONSTITUENTS):
        seen = [identifiable(known[constituent], sd) for sd in out.sd[:, q]]
        words.append(f"{constituent} {1 - np.mean(seen):.3f}")
    return "Flagged not identifiable (interval only): " + ", ".join(words) + " of the seeds."


PICKS = ((0, 1, 2), (3, 4, 5, 6), *((q,) for q in range(len(NAMES))))


def _coastal(name: str, count: int):
    """Setup, priors, truths, readings and ln of derived numbers of one fixed water."""
    made = setup(name)
    x = truths(made, WATERS["coastal"], count, SEED)
    seen, logs = observe(made, x, SEED + 1)
    return made, priors(made, count), x, seen, logs


def regions(count: int = 40):
    """Joint 95 % regions and intervals by the likelihood ratio."""
    yield (
        "# Joint regions of photographs\n\n`python -m tests.acceptance.photo_rows regions`.\n\n"
        "As `fitting.joint_region` gives them: what readings and priors can be explained with, all "
        "other unknowns chosen best, within chi-squared of the optimum.  Coastal water, nuisances "
        "drawn from their priors.  Ellipsoid: at the optimum, linearised."
    )
    for name in ("single photo", "three depths"):
        made, prior, x, seen, logs = _coastal(name, count)
        found = fit_all(made, seen, prior)
        own = [made.parameters.names.index(n) for n in CONSTITUENTS]
        true = np.concatenate([x[:, own], logs], axis=1)
        loss = losses(made, seen, prior, found, true, PICKS)
        best = np.concatenate([found["x"][:, own], found["logs"]], axis=1)
        lines = [
            f"\n## {name}\n",
            f"{count} seeds, converged {np.mean(found['code'] == 0):.3f}; a better optimum was met "
            f"while numbers were held in {np.sum(loss.min(axis=1) < -0.01)}.\n",
            "| region of | 68 % holds | 95 % holds | ellipsoid 68 % | 95 % | median loss at the "
            "truth (chi-squared's) |",
            "|---|---|---|---|---|---|",
        ]
        for pick, lost in zip(PICKS, loss.T, strict=True):
            off, k = (best - true)[:, pick], len(pick)
            inverse = np.linalg.inv(found["joint"][:, pick][:, :, pick])
            straight = np.einsum("di,dij,dj->d", off, inverse, off)
            cells = [
                f"{np.mean(values <= chi2.ppf(level, k)):.3f}"
                for values in (lost, straight)
                for level in (0.68, 0.95)
            ]
            names = ", ".join(NAMES[i] for i in pick)
            middle = f"{np.median(lost):.2f} ({chi2.median(k):.2f})"
            lines.append(f"| {names} | {' | '.join(cells)} | {middle} |")
        yield "\n".join(lines)


def draws(count: int = 40):
    """Joint 95 % regions and intervals of sampled posteriors."""
    yield (
        "# Sampled posteriors of photographs\n\n`python -m tests.acceptance.photo_rows draws`."
        "\n\nDraws by `_photo_posterior.py`; regions are ellipsoids that "
        "hold the share of the draws, beside the ellipsoids at the optimum."
    )
    for name in ("single photo", "three depths"):
        yield _regions(name, *_coastal(name, count))
    yield _regions("single photo, water from the prior", *_drawn("single photo", count))


def _regions(name, made, prior, x, seen, logs) -> str:
    found = fit_all(made, seen, prior)
    post = posterior(made, seen, prior, found)
    own = [made.parameters.names.index(n) for n in CONSTITUENTS]
    true = np.concatenate([x[:, own], logs], axis=1)
    draws = np.concatenate([post.x[:, :, own], post.logs], axis=2)
    lines = [
        f"\n## {name}\n",
        f"{len(x)} seeds, {post.x.shape[1]} draws each; effective draws: median "
        f"{np.median(post.effective):.0f}, least {post.effective.min():.0f}; Pareto k: median "
        f"{np.median(post.shape):.2f}, above 0.7 in {np.mean(post.shape > 0.7):.3f}; spreads (ln) "
        f"by the last rounds alone differ by {np.mean(post.settled):+.3f} on average.\n",
        "| joint 95 % region | sampled covers | ellipsoid covers |",
        "|---|---|---|",
    ]
    cov = found["cov"][:, own][:, :, own]
    off = found["x"][:, own] - x[:, own]
    inside = np.einsum("di,dij,dj->d", off, np.linalg.inv(cov), off) <= chi2.ppf(0.95, 3)
    for pick, ellipsoid in (((0, 1, 2), f"{np.mean(inside):.3f}"), ((3, 4, 5, 6), "-")):
        names = tuple(NAMES[i] for i in pick)
        held = [
            region_of(names, one[:, pick], 0.95).holds(dict(zip(names, t, strict=True)))
            for one, t in zip(draws, np.exp(true[:, pick]), strict=True)
        ]
        lines.append(f"| {', '.join(names)} | {np.mean(held):.3f} | {ellipsoid} |")
    lines += ["\n| | sd of the draws | 68 % covers | 95 % covers |", "|---|---|---|---|"]
    for q, one in enumerate(NAMES):
        below = np.mean(draws[:, :, q] < true[:, q, None], axis=1)
        cover = [np.mean(np.abs(below - 0.5) <= 0.5 * level) for level in (0.68, 0.95)]
        spread = np.median(draws[:, :, q].std(axis=1))
        lines.append(f"| {one} | {spread:.3f} | {cover[0]:.3f} | {cover[1]:.3f} |")
    return "\n".join(lines)


# Constituents about the coast, standard deviations of ln: the region that ranks are counted in.
REGION, BINS = 0.7, 10


def ranks(count: int = 100):
    """Simulation-based calibration: ranks of the truth, drawn from the prior, in the posterior."""
    yield (
        "# Calibration by simulation\n\n`python -m tests.acceptance.photo_rows ranks`.\n\nTruths "
        f"from the fit's prior, constituents within {REGION} (sd of ln) of the coast.  Share of "
        f"the posterior below the truth, {count} seeds in {BINS} bins: probability of counts as "
        "uneven if it is uniform (Talts et al. 2018, arXiv:1804.06788), and in brackets the median "
        "standard deviation.  Gaussian: at the optimum.  Draws: adaptive importance sampling "
        "(`_photo_posterior.py`) in place of NUTS, which takes minutes a photograph.\n\n"
        "| protocol | " + " | ".join(NAMES) + " |\n" + "|---" * (len(NAMES) + 1) + "|"
    )
    for name in ("ideal", "single photo", "three depths"):
        yield from _ranks(name, count)


def _drawn(name: str, count: int):
    """Protocol, prior, and truths drawn from it with their readings and ln quantities."""
    made = setup(name)
    prior, x = priors(made, count), truths(made, WATERS["coastal"], count, SEED + 7)
    own = [made.parameters.names.index(n) for n in CONSTITUENTS]
    centre, weight = prior.centre.copy(), prior.weight.copy()
    centre[:, own], weight[:, own] = np.log(WATERS["coastal"]), 1 / REGION
    x[:, own] += REGION * np.random.default_rng(SEED).standard_normal((count, len(own)))
    return made, Prior(centre, weight, prior.scale), x, *observe(made, x, SEED + 8)


def _ranks(name: str, count: int):
    made, prior, x, seen, logs = _drawn(name, count)
    own = [made.parameters.names.index(n) for n in CONSTITUENTS]
    found = fit_all(made, seen, prior)
    sd = np.concatenate(
        [np.sqrt(np.einsum("dii->di", found["cov"]))[:, own], found["of_logs"]], axis=1
    )
    off = np.concatenate([(x - found["x"])[:, own], logs - found["logs"]], axis=1) / sd
    yield _uniform(f"{name}, Gaussian", norm.cdf(off), sd)
    if name != "ideal":
        post = posterior(made, seen, prior, found)
        draws = np.concatenate([post.x[:, :, own], post.logs], axis=2)
        true = np.concatenate([x[:, own], logs], axis=1)
        yield _uniform(f"{name}, draws", np.mean(draws < true[:, None], axis=1), draws.std(axis=1))


def _uniform(name: str, below: np.ndarray, sd: np.ndarray) -> str:
    """A row: p that the shares (seed, NAMES) are uniform, in brackets the median sd."""
    cells = []
    for q in range(len(NAMES)):
        heights = np.histogram(below[:, q], BINS, (0.0, 1.0))[0]
        cells.append(f"{chisquare(heights).pvalue:.3f} ({np.median(sd[:, q]):.2g})")
    return f"| {name} | " + " | ".join(cells) + " |"


def table_of(part: str) -> Path:
    """The file of a part's table."""
    return Path(__file__).with_name(f"photo_rows{'' if part == 'rows' else f'_{part}'}.md")


def main():
    quick_compilation(drawing=True)
    jax.config.update("jax_enable_x64", True)
    parts = {
        "design": design,
        "rows": rows,
        "weak": weak,
        "regions": regions,
        "draws": draws,
        "ranks": ranks,
    }
    for name in sys.argv[1:] or list(parts):
        path, lines = table_of(name), []
        for part in parts[name]():
            lines.append(part)
            print(part, flush=True)
            path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
