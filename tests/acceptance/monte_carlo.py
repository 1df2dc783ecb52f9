"""MonteCarlo against reference irradiances and radiances: z-tests with Sidak's correction.

    python -m tests.acceptance.monte_carlo [log2 of paths, 17 [every n-th case, 1 | noisy]]

Every case of the reference file: fluxes without a surface (albedo 0.2-1, g 0-0.95, optical
thickness 0.1 to endless, black to white floors), Ed, Eu and E0 at every depth.  The limit is what
99 % of right results stay within, all numbers together.  Fluxes below 1e-4 of the light
are counted, not tested: few walks reach them; truncated ones must
lie within their stated bound.  `noisy`: the cases of which a number above 1e-3 of the light, after
2^15 paths and scaled by the root of their number, has more than 0.15 % at 1e6 paths.
"""

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

import oceaninv as oi
from oceaninv.water.phase import HenyeyGreenstein
from tests.paths import REFERENCE

REFERENCE_FILE = REFERENCE / "radiative_transfer.json"


def scene_of(case):
    """Optical depth as metres: c = 1."""
    one = jnp.ones(1)
    albedo, thickness = case["omega"], case["T"]
    water = oi.IOPs([500.0], (1 - albedo) * one, albedo * one, HenyeyGreenstein(float(case["g"])))
    floor = None if thickness == "inf" else oi.Floor(float(thickness), case["rho"] * one)
    return oi.Scene(water, oi.Light(float(np.degrees(np.arccos(case["mu0"]))), one), floor=floor)


def fluxes(paths: int, cases: list[int]):
    """Rows (case, name, z, stderr over value, value, bias over stderr)."""
    rows, known = [], json.loads(REFERENCE_FILE.read_text())["flux"]["cases"]
    for i in cases:
        case = known[i]
        transport = oi.MonteCarlo(paths, 64, roulette=False)
        found = oi.irradiance(
            scene_of(case), jnp.asarray(case["tau"], float), transport, key=jax.random.key(i)
        )
        for name in ("Ed", "Eu", "E0"):
            estimate, exact = getattr(found, name), np.asarray(case[name], float)
            value, stderr = np.asarray(estimate.value[:, 0]), np.asarray(estimate.stderr[:, 0])
            bias = np.nan_to_num(np.asarray(estimate.bias[:, 0]), nan=np.inf)
            for v, s, x, b in zip(value, stderr, exact, bias, strict=True):
                # The reference itself is known to about 1e-6.
                error = np.hypot(s, 1e-6 * abs(x))
                if error > 0:
                    rows.append((i, name, (v - x) / error, s / max(x, 1e-300), x, b / error))
    return rows


def noisy(rows, paths: int) -> list[int]:
    """Cases that may have more than 0.2 % somewhere at 1e6 paths, by rows of fewer."""
    scale = np.sqrt(paths / 1e6)
    return sorted({r[0] for r in rows if r[4] > 1e-3 and r[3] * scale > 1.5e-3})


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    exponent = int(sys.argv[1]) if len(sys.argv) > 1 else 17
    which = sys.argv[2] if len(sys.argv) > 2 else "1"
    start = time.process_time()
    every = list(range(len(json.loads(REFERENCE_FILE.read_text())["flux"]["cases"])))
    few = which == "noisy"
    cases = noisy(fluxes(2**15, every), 2**15) if few else every[:: int(which)]
    report(fluxes(2**exponent, cases), exponent)
    print(f"{len(cases)} cases, {time.process_time() - start:.0f} s of CPU")


def report(rows, exponent: int) -> None:
    """What the table says."""
    scale = np.sqrt(2**exponent / 1e6)
    starved = [r for r in rows if r[4] < 1e-4]
    rows = [r for r in rows if r[4] >= 1e-4]
    exact = [r for r in rows if r[5] < 0.3]
    z = np.array([r[2] for r in exact])
    limit = stats.norm.isf((1 - 0.99 ** (1 / len(z))) / 2)
    print(
        f"{len(z)} numbers, truncation below 0.3 stderr: greatest |z| {np.abs(z).max():.2f} (limit "
        f"{limit:.2f}), mean {z.mean():+.3f}, standard deviation {z.std():.3f}"
    )
    truncated = [r for r in rows if r[5] >= 0.3]
    beyond = sum(abs(r[2]) > r[5] + 4 for r in truncated)
    print(f"{len(truncated)} truncated more: {beyond} beyond bound + 4 stderr")
    print(f"{len(starved)} below 1e-4 of the light: not tested")
    for name in ("Ed", "Eu", "E0"):
        share = np.array([r[3] for r in rows if r[1] == name and r[4] > 1e-3]) * scale
        print(
            f"stderr of {name} at 1e6 paths where above 1e-3: median {np.median(share):.2%}, "
            f"greatest {share.max():.2%}, within 0.2 %: {np.mean(share <= 2e-3):.0%}"
        )
    for name in ("Ed", "Eu", "E0"):
        print(f"{name} by brightness, share within 0.2 %:", end=" ")
        for low, high in ((1e-3, 1e-2), (1e-2, 1e-1), (1e-1, np.inf)):
            own = [r[3] * scale for r in rows if r[1] == name and low < r[4] <= high]
            print(f"{low:g}-{high:g}: {np.mean(np.array(own) <= 2e-3):.0%} of {len(own)}", end="; ")
        print()
    # A walk that is counted when it crosses a depth has the relative variance 1/flux - 1.
    for name in ("Ed", "Eu", "E0"):
        print(f"{name}, counted walks that one of ours is worth, median:", end=" ")
        for low, high in ((1e-3, 1e-2), (1e-2, 1e-1), (1e-1, 0.9)):
            own = [
                (1 / r[4] - 1) / (r[3] ** 2 * 2**exponent)
                for r in rows
                if r[1] == name and low < r[4] <= high and r[3] > 0
            ]
            print(f"{low:g}-{high:g}: {np.median(own):.0f}", end="; ")
        print()
    bright = [r for r in rows if r[4] > 1e-3]
    noisiest = {r[0]: r for r in sorted(bright, key=lambda r: r[3])}
    for r in sorted(noisiest.values(), key=lambda r: -r[3])[:12]:
        print(f"noisiest: case {r[0]}, {r[1]} {r[4]:.2g}: {r[3] * scale:.3%} at 1e6 paths")
    worst = sorted(exact, key=lambda r: -abs(r[2]))[:5]
    print("worst:", [(r[0], r[1], round(float(r[2]), 2)) for r in worst])
    print(f"2^{exponent} paths, 64 events")


if __name__ == "__main__":
    main()
