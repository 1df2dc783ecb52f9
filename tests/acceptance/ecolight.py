"""PlaneParallel and TwoStream against 18 EcoLight runs, and what a fit through each recovers.

    python -m tests.acceptance.ecolight [folder with ecolight6_runs.csv and the specific IOPs]

writes tests/acceptance/ecolight.md (a minute or two).  The runs: homogeneous endless water, sun at
30 degrees, wind 5 m/s, clear sky, no inelastic processes, 405-625 nm.  Here the surface is flat,
the sky uniform with a share of the irradiance, and particles and water together scatter as the
Fournier-Forand function of the printed bb/b (between five fixed ratios, shapes are mixed).

The fit takes ln Ed at 0, 1 and 2 m and ln R at 0 m, takes both for good to 2 %, and looks for the
logarithms of chlorophyll, minerals and CDOM with the runs' own specific IOPs.
"""

import csv
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi

ROOT = Path(__file__).parents[2]
FOLDER = ROOT.parent / "shared/data/synthetic"
TABLE = ROOT / "tests/acceptance/ecolight.md"
RATIOS = (0.004, 0.01, 0.02, 0.035, 0.06)
SHARE = 0.3
LIGHT_DEPTHS = np.array([0.0, 1.0, 2.0])
SIGMA = 0.02


def read(path):
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    return {k: np.array([float(r[k] or "nan") for r in rows]) for k in rows[0]}


def scene(wavelength, a, b, bb, above, share, phases):
    """A run's water and light; bb/b between the fixed ratios by mixing the two next to it."""
    ratio = jnp.clip(bb / b, RATIOS[0], RATIOS[-1])
    hats = jnp.stack([jnp.interp(ratio, np.array(RATIOS), row) for row in np.eye(len(RATIOS))])
    water = oi.IOPs(wavelength, a, hats * b[None, :], phases)
    light = oi.Light(30.0, (1 - share) * above / np.cos(np.radians(30.0)), share * above / np.pi)
    return oi.Scene(water, light, oi.FlatSurface(1.34))


def fluxes(given, transport):
    """(Ed, Eu) at the three depths."""
    found = oi.irradiance(given, LIGHT_DEPTHS, transport)
    return found.Ed.value, found.Eu.value


def main(folder=FOLDER):
    jax.config.update("jax_enable_x64", True)
    runs, specific = (
        read(folder / "ecolight6_runs.csv"),
        read(folder / "siops_neil2011_hydrolight_lab.csv"),
    )
    phases = tuple(oi.phase.FournierForand(r) for r in RATIOS)
    numbers = np.unique(runs["run"])
    pick = {n: {k: v[runs["run"] == n] for k, v in runs.items()} for n in numbers}
    wavelength = pick[numbers[0]]["wavelength_nm"]
    lines = [
        "Written by `python -m tests.acceptance.ecolight`: median of |relative error|, 18 runs x "
        f"{len(wavelength)} bands.",
        "",
        "| model | sky share | Kd 0.005 m | Kd 1 m | Kd 2 m | R | Ed 0-2 m | Rrs |",
        "|---|---|---|---|---|---|---|---|",
    ]
    exact = oi.PlaneParallel(16, 1)

    @jax.jit
    def predict(a, b, bb, above, share):
        s = scene(wavelength, a, b, bb, above, share, phases)
        kd = oi.apparent.apparent(s, np.array([0.005, 1.005, 2.005]), exact).Kd
        ed, eu = fluxes(s, exact)
        return kd, eu[0] / ed[0], ed, oi.apparent.remote_sensing_reflectance(s, exact)

    signed = {}
    for share in (0.0, 0.2, 0.3, 0.4):
        errors = []
        for run in pick.values():
            kd, r, ed, rrs = predict(
                *(jnp.asarray(run[k]) for k in ("a", "b", "bb", "Ed_air")), jnp.asarray(share)
            )
            truth = np.stack([run[f"Kd_{z}m"] for z in ("0.005", "1.005", "2.005")])
            light = np.stack([run[f"Ed_{z}m"] for z in (0, 1, 2)])
            errors.append(
                np.concatenate(
                    [
                        kd / truth - 1,
                        (r / (run["Eu_0m"] / run["Ed_0m"]) - 1)[None],
                        ed / light - 1,
                        (rrs / run["Rrs"] - 1)[None],
                    ]
                )
            )
        errors = np.array(errors)
        signed[share] = np.median(errors, axis=(0, 2))
        middle = np.median(np.abs(errors), axis=(0, 2))
        row = [*middle[:4], np.median(np.abs(errors[:, 4:7])), middle[7]]
        lines.append(
            f"| PlaneParallel | {share} | " + " | ".join(f"{100 * v:.2f} %" for v in row) + " |"
        )
        print(lines[-1], flush=True)
    row = signed[SHARE]
    lines += [
        "",
        f"Signed medians at a share of {SHARE}: Kd {100 * row[0]:+.2f}, {100 * row[1]:+.2f}, "
        f"{100 * row[2]:+.2f} %, R {100 * row[3]:+.2f} %, Ed {100 * row[4]:+.2f} % at 0 m, Rrs "
        f"{100 * row[7]:+.2f} %.",
        "",
    ]
    lines += recover(pick, specific, wavelength, phases)
    TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")


def recover(pick, specific, wavelength, phases):
    """Fits of every run through both models; lines of the table."""
    at = lambda name: np.interp(  # noqa: E731
        wavelength,
        specific["wavelength_nm"][np.isfinite(specific[name])],
        specific[name][np.isfinite(specific[name])],
    )
    first = next(iter(pick.values()))
    contents = np.array([first["chl_mg_m3"][0], first["mss_g_m3"][0], first["a_cdom_440_per_m"][0]])
    # What the constituents leave of the printed totals of one run is pure water.
    pure_a = first["a"] - contents @ np.stack([at(f"a*{k}") for k in ("chl", "mss", "cdom")])
    pure_b = first["b"] - contents[:2] @ np.stack([at(f"b*{k}") for k in ("chl", "mss")])
    pure_bb = first["bb"] - contents[:2] @ np.stack([at(f"bb*{k}") for k in ("chl", "mss")])
    lines = [
        "| fit through | quantity | median error | 68 % covers | 95 % covers |",
        "|---|---|---|---|---|",
    ]
    for name, transport in (("PlaneParallel", oi.PlaneParallel(12)), ("TwoStream", oi.TwoStream())):

        def predict(p, above, transport=transport):
            amount = jnp.exp(p)
            a = pure_a + amount @ np.stack([at(f"a*{k}") for k in ("chl", "mss", "cdom")])
            b = pure_b + amount[:2] @ np.stack([at(f"b*{k}") for k in ("chl", "mss")])
            bb = pure_bb + amount[:2] @ np.stack([at(f"bb*{k}") for k in ("chl", "mss")])
            ed, eu = fluxes(scene(wavelength, a, b, bb, above, SHARE, phases), transport)
            return jnp.log(jnp.concatenate([ed.ravel(), eu[0] / ed[0]]))

        both = jax.jit(lambda p, above: (predict(p, above), jax.jacfwd(predict)(p, above)))
        misses, deviations = [], []
        for run in pick.values():
            truth = np.log([run["chl_mg_m3"][0], run["mss_g_m3"][0], run["a_cdom_440_per_m"][0]])
            light = np.concatenate([run[f"Ed_{z}m"] for z in (0, 1, 2)])
            seen = np.log(np.concatenate([light, run["Eu_0m"] / run["Ed_0m"]]))
            p, above = np.log([1.5, 0.5, 0.1]), jnp.asarray(run["Ed_air"])
            for _ in range(25):
                value, slope = (np.asarray(v) for v in both(jnp.asarray(p), above))
                step = np.linalg.lstsq(slope, seen - value, rcond=None)[0]
                p = p + np.clip(step, -0.7, 0.7)
                if np.abs(step).max() < 1e-6:
                    break
            covariance = np.linalg.inv(slope.T @ slope) * SIGMA**2
            misses.append(p - truth)
            deviations.append(np.sqrt(np.diag(covariance)))
        misses, deviations = np.array(misses), np.array(deviations)
        for i, quantity in enumerate(("chlorophyll", "minerals", "CDOM")):
            z = np.abs(misses[:, i]) / deviations[:, i]
            error = 100 * np.median(np.expm1(np.abs(misses[:, i])))
            lines.append(
                f"| {name} | {quantity} | {error:.1f} % | "
                f"{np.mean(z < 1):.2f} | {np.mean(z < 1.96):.2f} |"
            )
            print(lines[-1], flush=True)
    return lines


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
