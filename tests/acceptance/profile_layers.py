"""Constituents of two layers from one cast: do the intervals cover?

    python -m tests.acceptance.profile_layers [--casts N]

writes tests/acceptance/profile_layers.md (five to ten processor seconds a cast). Each cast: 7
bands, 60 depths of 0.2-15 m, 3 % noise that is known, the sun at 40 degrees. The upper water is
random (ln sd 0.7 about the priors' centres), the lower has 2 to 4 times as much of everything or
as little, their interface lies at 3.5-8 m, and the shapes of optical properties, the sun and the
error of depths are drawn from their priors. The light is that of 16 streams, the fit goes through
8, is told that there are two layers and finds where they meet.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import binom, norm

import oceaninv as oi
from fitting import Profile, fit_profile
from fitting.core.parameters import Parameters
from fitting.water_model.layered_water import layer_unknowns, layers_of

BANDS = np.array([412.0, 443.0, 490.0, 510.0, 555.0, 620.0, 665.0])
DEPTH = np.linspace(0.2, 15.0, 60)
NOISE, ZENITH = 0.03, 40.0
AMOUNTS = ("chlorophyll", "cdom", "detritus")
ASKED = [f"{n}_{i}" for i in (1, 2) for n in AMOUNTS] + ["thickness_1"]
DERIVED = [f"{n}_{i}" for i in (1, 2) for n in ("Kd_490", "a_cdm_440", "bb_550", "c_550")]


def drawn(rng, layout) -> np.ndarray:
    """Coordinates of a random cast's truth."""
    x = np.array([p.transform.coordinate(p.centre) for p in layout])
    x += np.array([p.spread or 0.0 for p in layout]) * rng.standard_normal(len(x))
    upper = np.log([p.centre for p in layout[:3]]) + 0.7 * rng.standard_normal(3)
    more = rng.choice([-1.0, 1.0]) * rng.uniform(np.log(2.0), np.log(4.0), 3)
    x[:3], x[3:6] = upper, upper + more
    x[layout.names.index("thickness_1")] = np.log(rng.uniform(3.5, 8.0))
    return x


def main():
    """Fit, print and write the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--casts", type=int, default=150)
    count = parser.parse_args().casts
    jax.config.update("jax_enable_x64", True)
    layout = Parameters(layer_unknowns([5.0], ZENITH))
    sun = jnp.ones(len(BANDS))
    grid = np.union1d(BANDS, [440.0, 550.0])
    at440, at550 = np.searchsorted(grid, [440.0, 550.0])

    @jax.jit
    def light(x):
        values = layout.values(x)
        scene = oi.Scene(
            layers_of(values, BANDS), oi.Light(values["solar_zenith"], sun), oi.FlatSurface()
        )
        edges = jnp.stack([jnp.zeros(()), values["thickness_1"], jnp.full((), DEPTH[-1])])
        depths = jnp.concatenate([jnp.asarray(DEPTH), edges]) * (1.0 + values["kd_model_error"])
        down = oi.irradiance(scene, depths, oi.PlaneParallel(16)).Ed.value
        kd = -jnp.diff(jnp.log(down[len(DEPTH) :, 2])) / jnp.diff(edges)
        own = []
        for i, water in enumerate(layers_of(values, grid).iops):
            row = dict(zip(water.absorbers, water.a_components, strict=True))
            cdm = (row["cdom"] + row["detritus"])[at440]
            own.append(jnp.stack([kd[i], cdm, water.bb[at550], water.c[at550]]))
        return down[: len(DEPTH)], jnp.concatenate(own)

    rng, found = np.random.default_rng(4), []
    for done in range(count):
        x = drawn(rng, layout)
        clean, derived = (np.asarray(v) for v in light(jnp.asarray(x)))
        seen = clean * (1.0 + NOISE * rng.standard_normal(clean.shape))
        cast = Profile(DEPTH, BANDS, seen, sigma=NOISE * clean, solar_zenith=ZENITH)
        fit = fit_profile(
            cast, transport=oi.PlaneParallel(8), layers=2, depth_range=(0.0, DEPTH[-1])
        )
        names = fit.parameters.names
        errors = [fit.x[names.index(n)] - x[layout.names.index(n)] for n in ASKED]
        deviations = [fit.sd[n] for n in ASKED]
        quantities = [fit.quantities[n] for n in DERIVED]
        errors += [float(np.log(q.value / t)) for q, t in zip(quantities, derived, strict=True)]
        deviations += [float(q.sd) for q in quantities]
        found.append([errors, deviations, [fit.converged] * len(errors)])
        if done % 10 == 9:
            write(np.array(found))


def write(found: np.ndarray):
    """The table so far."""
    count = len(found)
    errors, deviations, converged = (found[:, i] for i in range(3))
    z = np.abs(errors) / deviations
    bands = {level: binom.interval(0.99, count, level) for level in (0.68, 0.95)}
    lines = [
        "# Constituents of two layers",
        "",
        f"Written by `python -m tests.acceptance.profile_layers`: {count} casts, of which "
        f"{np.mean(converged[:, 0]):.1%} converged.  99 % bands of what covers: "
        + ", ".join(f"{lo / count:.3f}-{hi / count:.3f} at {v}" for v, (lo, hi) in bands.items())
        + ".",
        "",
        "| quantity | median error | median sd (of the logarithm) | 68 % covers | 95 % covers |",
        "|---|---|---|---|---|",
    ]
    for i, name in enumerate([*ASKED, *DERIVED]):
        cover = [np.mean(z[:, i] < norm.ppf(0.5 + level / 2)) for level in bands]
        lines.append(
            f"| {name} | {100 * np.median(np.expm1(np.abs(errors[:, i]))):.1f} % | "
            f"{np.median(deviations[:, i]):.3f} | {cover[0]:.3f} | {cover[1]:.3f} |"
        )
    text = "\n".join(lines)
    print(text, flush=True)
    (Path(__file__).parent / "profile_layers.md").write_text(text + "\n")


if __name__ == "__main__":
    main()
