"""Statistics of the photo fit: against the Cramer-Rao bound, and against waters of another model.

    python -m tests.acceptance.photo_statistics [matched | mismatched | mismatched_known]

Prints the tables and writes them beside this file as photo_statistics_<part>.md.  Seeded;
a few minutes each.

Protocol: one frame at 5 m by a Nikon D850; 24 patches (colour-science's ColorChecker 2005) at 1, 2
and 4 m and open water, horizontally; exposure and white balance unknown; 1 % noise.  The charts are
too small to hide water or to shine past themselves; for boards of any size see `photo_boards.py`.

- Matched: coastal water (chlorophyll 1.5 mg/m3, CDOM 0.15 /m, detritus 0.08 /m) by the fit's own
  model, every nuisance drawn from its prior.  The bound is Bayesian: information of the readings
  (central finite differences of `fitting.photo.forward_model.predict`) and of the priors, at each
  draw's truth.
- Mismatched: the exact photographs of `_mismatched.py`, fitted with the default model.
- Mismatched, known: the same photographs by a user who knows that the light on the charts is within
  30 % of Ed, which is what was drawn.  By default it is known within a factor of e, for a chart may
  face any way.  Backscattering is told from how bright the water is beside a chart, so it is known
  no better than that light.  Two frames a water.

The algae of these waters absorb 2 to 3.7 times the mean of Bricaud et al. 1998, one to two standard
deviations of what nature has (`algae_coastlooc.md`).
"""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import binom

import oceaninv as oi
from fitting import Background, Board, Chart, Photo
from fitting.commands.main import quick_compilation
from fitting.core.least_squares import covariance, curvature, value_and_jacobian
from fitting.core.parameters import Prior
from fitting.core.result import amount_bias, half_width
from fitting.observations.photo import WAVELENGTH
from fitting.photo.forward_model import predict
from fitting.photo.problem import PhotoProblem, prepare, search
from fitting.water_model.quantities import water_quantities
from tests.acceptance import _mismatched

DRAWS, CHUNK, NOISE = 200, 25, 0.01
RANGES, DEPTH, SUN = (1.0, 2.0, 4.0), 5.0, 40.0
COAST = {"chlorophyll": 1.5, "cdom": 0.15, "detritus": 0.08}
# A chart that shows as a point.
POINT = Board(1e-4, 1e-4, size_sd=0.0)
QUANTITIES = ("Kd_490", "c_550", "a_cdm_440", "bb_550")
LEVELS = (0.68, 0.95)


@functools.cache
def patches() -> np.ndarray:
    """(24, 16) reflectances of the ColorChecker."""
    spectra = oi.spectrum._colour().SDS_COLOURCHECKERS["ISO 17321-1"]
    return np.stack([np.interp(WAVELENGTH, s.wavelengths, s.values) for s in spectra.values()])


@functools.cache
def problem(sun: float = SUN):
    """Parameters, readings (values to be replaced) and sunlight of the protocol's photograph."""
    ones = np.ones((24, 3))
    charts = [Chart(ones, patches(), r, name=f"{r:g} m", board=POINT) for r in RANGES]
    photo = Photo(
        charts,
        [Background(np.ones((1, 3)))],
        response=oi.spectrum.camera_response("Nikon D850"),
        depth=DEPTH,
        solar_zenith=sun,
    )
    return prepare([photo], oi.TwoStream())


def scalars(values):
    """The scalar quantities, (quantity,)."""
    found = water_quantities(values, WAVELENGTH, oi.TwoStream())
    return jnp.stack([found[name] for name in QUANTITIES])


@functools.cache
def programs():
    """Batched (predict and quantities, fit), compiled once each."""
    parameters, (readings,), sunlight = problem()
    layout = parameters.layout()
    transport = oi.TwoStream()

    def quantities(x):
        return jnp.log(scalars(layout.values(x)))

    def forward(x):
        return predict(layout.values(x), readings, transport, sunlight), quantities(x)

    def fit(seen, start, centre, weight, scale):
        """Optimum, code, covariance and reduced chi2, with the default 1 % of each reading; then
        bias and second-order spread of the coordinates, ln quantities, their slopes and spread."""
        mask = seen > 0
        here = eqx.tree_at(
            lambda r: (r.values, r.sigma, r.mask),
            readings,
            (jnp.where(mask, seen, 1.0), jnp.where(mask, NOISE * seen, 1.0), mask),
        )
        prior = Prior(centre, weight, scale)
        problem = PhotoProblem(layout, prior, (here,), transport, sunlight)
        optimum = search(problem, start)
        chi2 = jnp.sum(optimum.residual**2) / seen.size
        cov = covariance(optimum.jacobian)
        logs, slope = value_and_jacobian(quantities, optimum.x)

        def curved(x):
            return problem.residual(x), quantities(x)

        second_order = curvature(curved, optimum.x, cov, optimum.jacobian, slope)
        sd = jnp.sqrt(jnp.diagonal(cov))
        bias, spread = amount_bias(sd), jnp.minimum(second_order.sd, sd)
        of_logs = jnp.sqrt(jnp.einsum("qi,ij,qj->q", slope, cov, slope))
        derived = jnp.minimum(second_order.derived, of_logs)
        return optimum.x, optimum.code, cov, chi2, bias, spread, logs, of_logs, derived

    # Fits one after the other: side by side, all would take as many steps as the longest.
    fits = jax.jit(lambda *all_: jax.lax.map(lambda one: fit(*one), all_))
    return jax.jit(jax.vmap(forward)), fits


def by_chunks(program, *arrays):
    """A batched program over draws in chunks of one size, so that it compiles once."""
    count, chunks = len(arrays[0]), []
    for first in range(0, count, CHUNK):
        index = np.arange(first, first + CHUNK) % count
        out = jax.tree.map(np.asarray, program(*(jnp.asarray(a[index]) for a in arrays)))
        chunks.append(tuple(part[: count - first] for part in out))
    return tuple(np.concatenate(parts) for parts in zip(*chunks, strict=True))


def fit_all(seen, suns, changes=None):
    """Fits of (draw, reading, channel): what `fit` of `programs` returns.

    `changes`: priors to exchange by name, as in `fit_photo`.
    """
    parameters = problem()[0].replace(changes or {})
    prior = parameters.prior()
    forward, fit = programs()
    centre, weight, scale = (
        np.tile(np.asarray(v), (len(seen), 1)) for v in (prior.centre, prior.weight, prior.scale)
    )
    # The prior of the sun is the frame's.
    centre[:, parameters.names.index("solar_zenith")] = np.log(suns)
    at_centre = by_chunks(forward, centre)[0]
    gains = [parameters.names.index(f"gain_0_{c}") for c in "RGB"]
    start = centre.copy()
    start[:, gains] += np.log(np.median(seen / at_centre, axis=1))
    return by_chunks(fit, seen, start, centre, weight, scale)


def truths(count: int, seed: int) -> np.ndarray:
    """(draw, unknown) coordinates: the coast, nuisances from their priors, arbitrary gains."""
    parameters = problem()[0]
    rng = np.random.default_rng(seed)
    x = np.tile(np.asarray(parameters.prior().centre), (count, 1))
    for i, p in enumerate(parameters):
        if p.name in COAST:
            x[:, i] = np.log(COAST[p.name])
        elif p.spread is None:
            x[:, i] = rng.normal(0.0, 0.5, count)
        else:
            x[:, i] += p.spread * rng.standard_normal(count)
    return x


@functools.cache
def curvatures():
    """Batched: readings and quantities differentiated twice along each axis, summed over axes."""
    parameters, (readings,), sunlight = problem()
    layout = parameters.layout()

    def forward(x):
        seen = predict(layout.values(x), readings, oi.TwoStream(), sunlight)
        return seen, jnp.log(scalars(layout.values(x)))

    def summed(x, axes):
        def along(axis):
            def slope(x):
                return jax.jvp(forward, (x,), (axis,))[1]

            return jax.jvp(slope, (x,), (axis,))[1]

        return jax.tree.map(lambda bend: bend.sum(axis=0), jax.vmap(along)(axes))

    return jax.jit(jax.vmap(summed))


def bayesian_bound(x: np.ndarray, step: float = 1e-5, changes=None):
    """(draw, unknown) and (draw, quantity) of each: bounds on sd; how far the priors pull from x;
    and the bias of a mode by the curvature of the model.

    Bounds by central finite differences.  The pull is what the best linear estimate errs by on
    average: the constituents are those of one coast, not draws from priors decades wide.  The
    bias of least squares by curvature, to second order, is that of Box (1971, Journal of the Royal
    Statistical Society B 33:171): -1/2 C J^T m, with m the model's second derivatives against
    their covariance C.
    """
    parameters = problem()[0].replace(changes or {})
    forward = programs()[0]
    seen = by_chunks(forward, x)[0]
    slopes, of_quantities = [], []
    for i in range(x.shape[1]):
        move = step * (np.arange(x.shape[1]) == i)
        up, down = by_chunks(forward, x + move), by_chunks(forward, x - move)
        slopes.append((up[0] - down[0]) / (2 * step))
        of_quantities.append((up[1] - down[1]) / (2 * step))
    weighted = np.stack(slopes, axis=-1) / (NOISE * seen)[..., None]
    information = np.einsum("drci,drcj->dij", weighted, weighted)
    prior = np.asarray(parameters.prior().weight) ** 2
    best = np.linalg.inv(information + np.diag(prior))
    slope = np.stack(of_quantities, axis=-1)
    pull = np.einsum("dij,dj->di", best, prior * (np.asarray(parameters.prior().centre) - x))
    axes = np.swapaxes(np.linalg.cholesky(best), 1, 2)
    bent, bent_quantities = by_chunks(curvatures(), x, axes)
    bend = -0.5 * np.einsum("dij,drcj,drc->di", best, weighted, bent / (NOISE * seen))
    return (
        (
            np.sqrt(np.einsum("dii->di", best)),
            np.sqrt(np.einsum("dqi,dij,dqj->dq", slope, best, slope)),
        ),
        (pull, np.einsum("dqi,di->dq", slope, pull)),
        (bend, np.einsum("dqi,di->dq", slope, bend) + 0.5 * bent_quantities),
    )


class Row(NamedTuple):
    """One number over all draws, each (draw,): errors (ln) of the value and of the mode, bound,
    reported sd and second-order spread, the priors' pull and the curvature's bias of the mode."""

    error: np.ndarray
    of_mode: np.ndarray
    best: np.ndarray
    sd: np.ndarray
    spread: np.ndarray
    pull: np.ndarray
    bend: np.ndarray


def matched(count: int = DRAWS, seed: int = 11):
    """`Row` by name; and the share that converged."""
    x = truths(count, seed)
    exact, logs = by_chunks(programs()[0], x)
    noise = np.random.default_rng(seed + 1).standard_normal(exact.shape)
    best, pull, bend = bayesian_bound(x)
    found, code, cov, _, bias, spread, log_found, of_logs, derived = fit_all(
        exact * (1 + NOISE * noise), np.full(count, SUN)
    )
    names, rows, off = problem()[0].names, {}, found - x
    for name in COAST:
        i = names.index(name)
        sd = np.sqrt(cov[:, i, i])
        parts = (best[0], pull[0], bend[0])
        known, pulled, curved = (part[:, i] for part in parts)
        rows[name] = Row(off[:, i] - bias[:, i], off[:, i], known, sd, spread[:, i], pulled, curved)
    for q, name in enumerate(QUANTITIES):
        error = log_found[:, q] - logs[:, q]
        known, pulled, curved = (part[1][:, q] for part in (best, pull, bend))
        rows[name] = Row(error, error, known, of_logs[:, q], derived[:, q], pulled, curved)
    return rows, float(np.mean(code == 0))


def covers(of_mode, sd, spread, level: float) -> float:
    """Share of intervals, as `fitting.Fit` makes them, that hold the truth."""
    return float(np.mean(np.abs(of_mode) <= half_width(level, sd, spread)))


def summary(row: Row) -> dict[str, float]:
    """The numbers of one row."""
    out = {
        "sd": float(np.std(row.error / row.best, ddof=1)),
        "bias": float(np.mean(row.error / row.best)),
        "mode": float(np.mean(row.of_mode / row.best)),
        "median": float(np.median(row.error / row.best)),
        "pull": float(np.mean(row.pull / row.best)),
        "bend": float(np.mean(row.bend / row.best)),
        "reported": float(np.median(row.sd / row.best)),
        "relative": float(np.median(row.best)),
    }
    for level in LEVELS:
        out[f"coverage {level}"] = covers(row.of_mode, row.sd, row.spread, level)
    return out


def matched_table(count: int = DRAWS) -> str:
    rows, converged = matched(count)
    bands = {p: np.array(binom.interval(0.99, count, p)) / count for p in LEVELS}
    heads = [f"{p:.0%} covers ({bands[p][0]:.3f}-{bands[p][1]:.3f})" for p in LEVELS]
    lines = [
        "# Photo fit, matched model\n",
        f"`python -m tests.acceptance.photo_statistics matched`: {count} draws, converged "
        f"{converged:.3f}.  Errors are of logarithms, in units of the bound.  Values of "
        "constituents are corrected for the curvature; quantities are those of the mode.\n",
        "| | bound (relative) | sd / bound | bias / bound | of the mode | expected of it: priors' "
        "pull | expected of it: curvature | median error / bound | reported sd / bound | "
        f"{heads[0]} | {heads[1]} |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        s = summary(row)
        lines.append(
            f"| {name} | {s['relative']:.3f} | {s['sd']:.3f} | {s['bias']:+.3f} | "
            f"{s['mode']:+.3f} | {s['pull']:+.3f} | {s['bend']:+.3f} | {s['median']:+.3f} | "
            f"{s['reported']:.3f} | {s['coverage 0.68']:.3f} | {s['coverage 0.95']:.3f} |"
        )
    return "\n".join(lines)


def photographs(repeats: int, seed: int = 5):
    """Noisy readings (water x repeat, reading, channel), suns and true ln quantities."""
    weights = np.asarray(oi.spectrum.camera_response("Nikon D850").weights(WAVELENGTH))
    sunlight = oi.spectrum.daylight(WAVELENGTH)
    rng = np.random.default_rng(seed)
    frames, suns, true = [], [], []
    waters = _mismatched.load()
    for water in waters:
        for _ in range(repeats):
            rows = []
            for k, r in enumerate(RANGES):
                light = np.exp(0.3 * rng.standard_normal()) * water.Ed * np.exp(-water.c * r)
                rows.append(patches() / np.pi * light + water.path[k])
            spectra = np.concatenate([*rows, water.background[None]]) * sunlight
            values = spectra @ weights.T * np.exp(0.5 * rng.standard_normal(3))
            frames.append(values * (1 + NOISE * rng.standard_normal(values.shape)))
            suns.append(water.sun)
            known = (water.kd_490, water.c_550, water.a_cdm_440, water.bb_550, water.chlorophyll)
            true.append(known)
    return np.stack(frames), np.array(suns), np.log(true), waters


TRUE = (*QUANTITIES, "chlorophyll")
# How near values of another model's water should come.
NEAR = {"Kd_490": 0.20, "c_550": 0.15, "bb_550": 0.25}


def mismatched(repeats: int = 5, changes=None):
    """Errors (ln) of values and modes, sd, second-order spread, each (draw, TRUE); codes, reduced
    chi2, waters, optima."""
    seen, suns, true, waters = photographs(repeats)
    x, code, cov, chi2, bias, spread, logs, of_logs, derived = fit_all(seen, suns, changes)
    i = problem()[0].names.index("chlorophyll")
    of_mode = np.column_stack([logs, x[:, i]]) - true
    error = of_mode - np.column_stack([np.zeros_like(logs), bias[:, i]])
    sd = np.column_stack([of_logs, np.sqrt(cov[:, i, i])])
    extra = np.column_stack([derived, spread[:, i]])
    return error, of_mode, sd, extra, code, chi2, waters, x


def mismatched_table(repeats: int = 5, changes=None, part: str = "mismatched") -> str:
    error, of_mode, sd, extra, code, chi2, waters, _ = mismatched(repeats, changes)
    lines = [
        "# Photo fit, truth of another model\n",
        f"`python -m tests.acceptance.photo_statistics {part}`: {len(waters)} waters x "
        f"{repeats} frames, converged {np.mean(code == 0):.3f}, median reduced chi2 "
        f"{np.median(chi2):.2f}.\n",
        "| | median error | median absolute error | share nearer than | median reported sd | "
        "68 % covers | 95 % covers |",
        "|---|---|---|---|---|---|---|",
    ]
    for q, name in enumerate(TRUE):
        cover = [covers(of_mode[:, q], sd[:, q], extra[:, q], p) for p in LEVELS]
        near = "-"
        if name in NEAR:
            share = np.mean(np.abs(np.expm1(error[:, q])) <= NEAR[name])
            near = f"{NEAR[name]:.0%}: {share:.3f}"
        lines.append(
            f"| {name} | {np.expm1(np.median(error[:, q])):+.1%} | "
            f"{np.expm1(np.median(np.abs(error[:, q]))):.1%} | {near} | "
            f"{np.median(sd[:, q]):.3f} | "
            f"{cover[0]:.3f} | {cover[1]:.3f} |"
        )
    lines += [
        "\nWater by water: mean of ln(fitted / true), in brackets the mean reported sd.\n",
        "| chl | minerals | CDOM | sun | " + " | ".join(TRUE) + " | reduced chi2 |",
        "|---|---|---|---|" + "---|" * (len(TRUE) + 1),
    ]
    for k, water in enumerate(waters):
        rows = slice(k * repeats, (k + 1) * repeats)
        cells = [
            f"{np.mean(error[rows, q]):+.3f} ({np.mean(sd[rows, q]):.3f})" for q in range(len(TRUE))
        ]
        lines.append(
            f"| {water.chlorophyll:.2f} | {water.minerals:.2f} | {water.cdom:.3f} | "
            f"{water.sun:.0f} | {' | '.join(cells)} | {np.mean(chi2[rows]):.2f} |"
        )
    return "\n".join(lines)


# What the user of `mismatched_known` knows better than the default: sd of ln.
KNOWN = {"chart_0_0": 0.3, "chart_0_1": 0.3, "chart_0_2": 0.3}


def known_table(repeats: int = 2) -> str:
    """`mismatched_table` with the priors of `KNOWN`."""
    changes = {
        p.name: dataclasses.replace(p, spread=KNOWN[p.name])
        for p in problem()[0]
        if p.name in KNOWN
    }
    return mismatched_table(repeats, changes, "mismatched_known")


def main():
    quick_compilation(drawing=True)
    jax.config.update("jax_enable_x64", True)
    tables = {
        "matched": matched_table,
        "mismatched": mismatched_table,
        "mismatched_known": known_table,
    }
    for name, table in tables.items():
        if name in (sys.argv[1:] or tables):
            report = table()
            print(report)
            Path(__file__).with_name(f"photo_statistics_{name}.md").write_text(report + "\n")


if __name__ == "__main__":
    main()
