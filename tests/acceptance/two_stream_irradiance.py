"""Irradiance of the two-stream against the exact model, and the fit of its three constants.

    python -m tests.acceptance.two_stream_irradiance

Prints the table and writes it beside this file.  Seeded; some minutes on one core.  The constants
are fitted to random waters; the errors are of the cases of two_stream_accuracy.py (Jerlov waters),
which the fit has not seen, with PlaneParallel(16) as the truth.
"""

import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

import oceaninv as oi
from oceaninv.transport.closed_form import two_stream
from tests.acceptance.two_stream_accuracy import (
    FLOOR_DEPTH,
    PHASES,
    SKY_FRACTION,
    SUNS,
    coefficients,
    phase,
    sky_radiance,
)

EXACT = oi.PlaneParallel(streams=16)
WATERS, LEVELS = 24, 15


@eqx.filter_jit
def _fields(water, light, surface, floor, depths):
    scene = oi.Scene(water, light, surface, floor)
    out = {}
    for name, model in (("exact", EXACT), ("two", oi.TwoStream())):
        field = oi.irradiance(scene, depths, model)
        out[name] = tuple(x.value for x in (field.Ed, field.Eu, field.E0))
    # The two-stream's own numbers, of the sun's beam.
    inner = two_stream.solve(scene, scene.beam())
    own, net, _, _ = two_stream._own(inner, depths)
    top = two_stream._own(inner, jnp.zeros(1))[0]
    q = -jnp.log(own / top)
    albedo = (inner.b_star / (water.a + inner.b_star))[None, :]
    return out | {
        "q": q,
        "own": own,
        "net": net,
        "albedo": albedo + 0 * q,
        "mu0": inner.mu0 + 0 * q,
        "lag": two_stream._lag(inner, water.a, q),
    }


def training(seed: int = 11):
    """Settings of random waters with c = 1 /m, exact and two-stream fields of each."""
    rng = np.random.default_rng(seed)
    shapes = [functools.partial(oi.phase.HenyeyGreenstein, g) for g in rng.uniform(0.75, 0.95, 5)]
    shapes += [
        functools.partial(oi.phase.FournierForand, backscatter_ratio=ratio)
        for ratio in (0.006, 0.01, 0.015, 0.02, 0.03)
    ]
    shapes += [oi.phase.petzold] * 3
    for shape in shapes:
        for index in (None, 1.34):
            for with_floor in (False, True):
                even = rng.uniform(0.2, 0.97, WATERS)
                bright = 1 - np.exp(rng.uniform(np.log(0.03), np.log(0.3), WATERS))
                b = jnp.asarray(np.where(rng.uniform(size=WATERS) < 0.6, even, bright))
                water = oi.IOPs(np.arange(1.0, WATERS + 1), 1.0 - b, b, shape())
                zenith = 0.0
                if rng.uniform() > 0.2:
                    zenith = float(np.degrees(np.arccos(rng.uniform(0.5, 1.0))))
                bottom = rng.uniform(2.0, 12.0)
                floor = oi.Floor(bottom, jnp.asarray(rng.uniform(0.02, 0.5, WATERS)))
                reach = bottom * (1 - 1e-6) if with_floor else 25.0
                depths = jnp.concatenate(
                    [jnp.full(1, 1e-3), reach * jnp.linspace(0.04, 1, LEVELS - 1)]
                )
                yield _fields(
                    water,
                    oi.Light(jnp.asarray(zenith), jnp.ones(WATERS)),
                    None if index is None else oi.FlatSurface(index),
                    floor if with_floor else None,
                    depths,
                )


def fit() -> np.ndarray:
    """The constants of `two_stream._lag`, by robust least squares down to the 1 % level."""
    columns = []
    for found in training():
        exact, model = np.asarray(found["exact"][0]), np.asarray(found["two"][0])
        keep = exact > 0.01 * exact[:1]
        missing = np.log(exact / model) + np.asarray(found["lag"])
        columns.append(np.stack([np.asarray(x)[keep] for x in (missing, *map(found.get, _NEEDED))]))
    missing, q, albedo, mu0 = np.concatenate(columns, axis=1)
    q = q / (1 + (q / 10) ** 4) ** 0.25

    def residual(k):
        return albedo * (k[0] + 1 - mu0) * q * (k[1] + k[2] * q) - missing

    return least_squares(residual, [0.1, -0.4, 0.1], loss="soft_l1", f_scale=0.01).x


_NEEDED = ("q", "albedo", "mu0")


def test_settings():
    """(label parts, fields) of the Jerlov waters; the light of the last is partly the sky's."""
    a, b = (jnp.asarray(x) for x in coefficients())
    count = a.size
    for name in PHASES:
        water = oi.IOPs(np.arange(1.0, count + 1), a, b, phase(name))
        for sun in SUNS:
            for index in (None, 1.34):
                for with_floor in (False, True):
                    for share in (0.0, SKY_FRACTION) if index else (0.0,):
                        floor = oi.Floor(FLOOR_DEPTH, jnp.full(count, 0.3)) if with_floor else None
                        sky = jnp.full(count, sky_radiance(sun, index)) if share else None
                        yield (
                            (with_floor, bool(share)),
                            _to_one_percent(
                                water,
                                oi.Light(jnp.asarray(sun), jnp.ones(count), sky),
                                None if index is None else oi.FlatSurface(index),
                                floor,
                            ),
                        )


def _to_one_percent(water, light, surface, floor):
    """Fields at ten depths to the 1 % level of each water, or to the floor: waters share depths,
    so that the nearest of a fine grid are taken."""
    grid = jnp.concatenate([jnp.full(1, 1e-6), jnp.linspace(0.02, 1.0, 400) * 15.0])
    if floor is None:
        grid = jnp.concatenate([jnp.full(1, 1e-6), jnp.geomspace(0.05, 400.0, 400)])
    found = _fields(water, light, surface, floor, grid)
    exact = np.asarray(found["exact"][0])
    deepest = (exact > 0.01 * exact[:1]).cumprod(axis=0).sum(axis=0) - 1
    z = np.asarray(grid)
    picks = [
        np.searchsorted(z, np.arange(1, 11) / 10 * z[last] - 1e-9).clip(0, last) for last in deepest
    ]
    rows = np.stack(picks, axis=1)

    def take(array):
        return np.take_along_axis(np.asarray(array), rows, axis=0)

    return jax.tree.map(take, found)


def table() -> str:
    errors = {}
    for (with_floor, with_sky), found in test_settings():
        kind = "30 % sky, n = 1.34" if with_sky else ("floor" if with_floor else "deep")
        exact = found["exact"]
        rows = {
            key: two / one - 1
            for key, one, two in zip(("Ed", "Eu", "E0"), exact, found["two"], strict=True)
        }
        if not with_sky:
            rows["Ed, the two-stream's own"] = found["own"] / exact[0] - 1
            rows["Ed, its net flux and the exact Eu"] = (found["net"] + exact[1]) / exact[0] - 1
        for key, error in rows.items():
            for label in (kind,) if with_sky else (kind, "sun only"):
                errors.setdefault((key, label), []).append(np.abs(error).ravel())
    lines = ["| | median | 90 % | 99 % | values |", "|---|---|---|---|---|"]
    for (key, label), parts in sorted(errors.items()):
        error = np.concatenate(parts)
        cells = [f"{np.quantile(error, level):.4f}" for level in (0.5, 0.9, 0.99)]
        lines.append(f"| {key}, {label} | {' | '.join(cells)} | {error.size} |")
    return "\n".join(lines)


def main():
    jax.config.update("jax_enable_x64", True)
    fitted = ", ".join(f"{x:.4f}" for x in fit())
    report = (
        "# Irradiance of the two-stream against the exact model\n\n"
        "`python -m tests.acceptance.two_stream_irradiance`: Jerlov waters to the 1 % level,"
        " |relative error| against PlaneParallel(16).\n\n"
        f"Constants fitted to random waters: {fitted}; in use: {two_stream._LAG}.\n\n{table()}\n"
    )
    print(report)
    Path(__file__).with_suffix(".md").write_text(report)


if __name__ == "__main__":
    main()
