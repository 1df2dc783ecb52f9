"""Constituents of 18 EcoLight runs through PlaneParallel, with noise on the runs' light.

    python -m tests.acceptance.ecolight_noise [folder with ecolight6_runs.csv and specific IOPs]

writes tests/acceptance/ecolight_noise.md (some minutes; `--draws N` for fewer).  As
`tests.acceptance.ecolight`, but the runs' Ed at 0, 1 and 2 m and R at 0 m carry independent noise
of 1 %, and what nobody knows of the runs is unknown: the share of sky light (0.3 within 0.1), the
level of R (within 2 %: the particles' exact phase function, the rough surface) and that of the
slopes of ln Ed (within 1 %).  The bound is Cramer and Rao's with these priors.  Errors of the
model itself repeat in every draw of a run: they, not chance, are what this table is to find.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import binom

import oceaninv as oi
from tests.acceptance.ecolight import FOLDER, LIGHT_DEPTHS, RATIOS, read, scene

NOISE = 0.01
SHARE, SHARE_SD, LEVEL_SD, SLOPE_SD = 0.3, 0.1, 0.02, 0.01
NAMES = ("chlorophyll", "minerals", "CDOM")


def problem(folder: Path):
    """Runs by number and the compiled model: (values, slopes) of ln Ed and ln R by unknowns."""
    runs = read(folder / "ecolight6_runs.csv")
    specific = read(folder / "siops_neil2011_hydrolight_lab.csv")
    phases = tuple(oi.phase.FournierForand(r) for r in RATIOS)
    pick = {n: {k: v[runs["run"] == n] for k, v in runs.items()} for n in np.unique(runs["run"])}
    first = next(iter(pick.values()))
    wavelength = first["wavelength_nm"]

    def at(name):
        known = np.isfinite(specific[name])
        return np.interp(wavelength, specific["wavelength_nm"][known], specific[name][known])

    rows = {k: np.stack([at(f"{k}*{n}") for n in ("chl", "mss")]) for k in ("b", "bb")}
    rows["a"] = np.stack([at(f"a*{n}") for n in ("chl", "mss", "cdom")])
    amount = truth_of(first)
    pure = {k: first[k] - np.exp(amount[: len(row)]) @ row for k, row in rows.items()}
    transport = oi.PlaneParallel(12)

    def model(p, above):
        amount, share, level, slope = jnp.exp(p[:3]), p[3], p[4], p[5]
        a, b, bb = (pure[k] + amount[: len(rows[k])] @ rows[k] for k in ("a", "b", "bb"))
        found = oi.irradiance(
            scene(wavelength, a, b, bb, above, share, phases), LIGHT_DEPTHS, transport
        )
        down, up = found.Ed.value, found.Eu.value
        light = jnp.log(down[0]) + (1.0 + slope) * (jnp.log(down) - jnp.log(down[0]))
        return jnp.concatenate([light.ravel(), jnp.log(up[0] / down[0]) + level])

    both = jax.jit(lambda p, above: (model(p, above), jax.jacfwd(model)(p, above)))
    return pick, both


def truth_of(run) -> np.ndarray:
    """Logarithms of chlorophyll, minerals and CDOM."""
    return np.log([run["chl_mg_m3"][0], run["mss_g_m3"][0], run["a_cdom_440_per_m"][0]])


def search(both, above, seen, p, rounds):
    """The optimum by Gauss-Newton and the deviations of the three amounts."""
    centre = np.array([0.0, 0.0, 0.0, SHARE, 0.0, 0.0])
    weight = np.array([0.0, 0.0, 0.0, 1 / SHARE_SD, 1 / LEVEL_SD, 1 / SLOPE_SD])
    matrix = np.diag(weight)
    for _ in range(rounds):
        value, slope = (np.asarray(v) for v in both(jnp.asarray(p), above))
        matrix = np.concatenate([slope / NOISE, np.diag(weight)])
        left = np.concatenate([(seen - value) / NOISE, (centre - p) * weight])
        step = np.linalg.lstsq(matrix, left, rcond=None)[0]
        p = p + np.clip(step, -0.7, 0.7)
        p[3] = np.clip(p[3], 0.0, 0.9)
        if np.abs(step).max() < 1e-5:
            break
    return p, np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)))[:3]


def main():
    """Fit, print and write the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("--draws", type=int, default=8)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    pick, both = problem(asked.folder)
    rng, errors, deviations, starts = np.random.default_rng(8), [], [], []
    for run in pick.values():
        light = np.concatenate([run[f"Ed_{z}m"] for z in (0, 1, 2)])
        clean = np.log(np.concatenate([light, run["Eu_0m"] / run["Ed_0m"]]))
        above = jnp.asarray(run["Ed_air"])
        p = np.concatenate([np.log([1.5, 0.5, 0.1]), [SHARE, 0.0, 0.0]])
        p, _ = search(both, above, clean, p, 25)
        starts.append(p[:3] - truth_of(run))
        for _ in range(asked.draws):
            seen = clean + np.log1p(NOISE * rng.standard_normal(len(clean)))
            found, sd = search(both, above, seen, p, 4)
            errors.append(found[:3] - truth_of(run))
            deviations.append(sd)
    errors, deviations, starts = (np.array(v) for v in (errors, deviations, starts))
    low, high = binom.interval(0.99, len(errors), 0.95)
    lines = [
        "# EcoLight runs with noise",
        "",
        f"Written by `python -m tests.acceptance.ecolight_noise`: {len(pick)} runs, {asked.draws} "
        f"draws each of {NOISE:.0%} noise on Ed at three depths and R.",
        "",
        "| quantity | median error | median error without noise | RMS error / Cramer-Rao | 68 % "
        f"covers | 95 % covers (band {low / len(errors):.2f}-{high / len(errors):.2f}) |",
        "|---|---|---|---|---|---|",
    ]
    for i, name in enumerate(NAMES):
        z = np.abs(errors[:, i]) / deviations[:, i]
        median, plain = (100 * np.median(np.expm1(np.abs(e[:, i]))) for e in (errors, starts))
        lines.append(
            f"| {name} | {median:.1f} % | {plain:.1f} % | {np.sqrt(np.mean(z**2)):.2f} | "
            f"{np.mean(z < 1):.2f} | {np.mean(z < 1.96):.2f} |"
        )
        print(lines[-1], flush=True)
    Path(__file__).with_suffix(".md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
