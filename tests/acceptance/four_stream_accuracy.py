"""Four-stream and two-stream against the exact model over random waters.

    python -m tests.acceptance.four_stream_accuracy [irradiance]

Prints the tables and writes four_stream_accuracy.md beside this file, or the second of them only.
Seeded.  Waters of the first: albedo 0.2 to 0.98, Henyey-Greenstein 0.8 to 0.95, sun 0 to 60 degrees
in air, n = 1.34; deep, or over a floor of reflectance 0.3 at 2 to 8 optical depths; radiance at 0.5
to 7 optical depths, irradiance to the 1 % level.

A second table holds irradiance in waters of many phase functions, as the formulas were made for:
albedo 0.2 to 0.97 (two in five above 0.7, spaced in ln(1 - albedo)); Henyey-Greenstein 0.8 and
0.924, Petzold, Fournier-Forand of 0.5, 1, 2 and 3 % backscatter; a third over a floor of 0.05 to
0.5 at 2 to 12 optical depths; a third under a sky of a tenth to half of the light; a fifth under
the sun in the zenith; three in ten without a surface.
"""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi

COUNT, DEPTHS = 120, 6
MODELS = {"TwoStream": oi.TwoStream(), "FourStream": oi.FourStream()}
TRUTH = oi.PlaneParallel(streams=20)


def waters(count: int = COUNT, seed: int = 3):
    """albedo, g, solar zenith (degrees), floor depth and depths of the radiance, all with c = 1."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform(2.0, 8.0, count)
    return (
        rng.uniform(0.2, 0.98, count),
        rng.uniform(0.8, 0.95, count),
        rng.uniform(0.0, 60.0, count),
        floor,
        rng.uniform(0.5, 0.9 * floor),
    )


def views(seed: int = 4, count: int = 24) -> np.ndarray:
    """(ray, 3) directions the eye looks in, away from the horizon by 3 degrees."""
    rng = np.random.default_rng(seed)
    mu = rng.uniform(-1.0, 1.0, count)
    mu = np.sign(mu) * np.maximum(np.abs(mu), 0.05)
    azimuth, sine = rng.uniform(0.0, 2 * np.pi, count), np.sqrt(1 - mu**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), mu], axis=1)


def scene(albedo, g, zenith, floor_depth):
    """One water of one band with c = 1 /m."""
    b = albedo[None]
    water = oi.IOPs(np.array([500.0]), 1.0 - b, b, oi.phase.HenyeyGreenstein(g))
    floor = None if floor_depth is None else oi.Floor(floor_depth, jnp.full(1, 0.3))
    return oi.Scene(water, oi.Light(zenith, jnp.ones(1)), oi.FlatSurface(), floor)


@eqx.filter_jit
def solved(transport, parameters, directions, with_floor: bool):
    """Radiance (water, ray) and Ed, Eu (water, depth) on a grid of depths."""

    def one(albedo, g, zenith, floor_depth, z):
        this = scene(albedo, g, zenith, floor_depth if with_floor else None)
        origin = jnp.zeros_like(directions).at[:, 2].set(z)
        light = oi.radiance(this, oi.Rays(origin, directions), transport).value[:, 0]
        grid = jnp.linspace(0.05, 0.95, DEPTHS)
        grid = grid * (floor_depth if with_floor else 4.6 / (1.0 - 0.9 * albedo))
        field = oi.irradiance(this, grid, transport)
        return light, field.Ed.value[:, 0], field.Eu.value[:, 0]

    return jax.lax.map(lambda p: one(*p), parameters)


def from_sun(zenith, directions):
    """(water, ray) degrees between the light seen and the refracted sun's."""
    sine = np.sin(np.radians(zenith)) / 1.34
    sun = np.stack([sine, 0 * sine, np.sqrt(1 - sine**2)], axis=1)
    best = None
    # Whichever azimuth convention puts the sun nearer: both signs are left out.
    for sign in (1.0, -1.0):
        towards = -directions * np.array([sign, 1.0, 1.0])
        angle = np.degrees(np.arccos(np.clip(sun @ towards.T, -1, 1)))
        best = angle if best is None else np.minimum(best, angle)
    return best


def table(count: int = COUNT) -> str:
    parameters, directions = waters(count), views()
    away = from_sun(parameters[2], directions) > 10.0
    arrays = tuple(jnp.asarray(p) for p in parameters)
    lines = [
        "# Four-stream against the exact model\n",
        f"`python -m tests.acceptance.four_stream_accuracy`: {count} waters, {len(directions)} "
        "directions beyond 10 degrees of the refracted sun; truth PlaneParallel(streams=20).  "
        "Median / 90th percentile of the |relative error|.\n",
        "| | radiance | Ed to the 1 % level | Eu |",
        "|---|---|---|---|",
    ]
    for with_floor in (False, True):

        def fields(model, with_floor=with_floor):
            found = solved(model, arrays, jnp.asarray(directions), with_floor)
            return [np.asarray(x) for x in found]

        exact = fields(TRUTH)
        bright = exact[1] > 0.01 * exact[1][:, :1]
        for name, model in MODELS.items():
            found = [
                np.asarray(x) for x in solved(model, arrays, jnp.asarray(directions), with_floor)
            ]
            errors = [
                np.abs(f / e - 1)[keep]
                for f, e, keep in zip(found, exact, (away, bright, bright), strict=True)
            ]
            cells = [f"{np.median(e):.4f} / {np.quantile(e, 0.9):.4f}" for e in errors]
            lines.append(f"| {name}, {'floor' if with_floor else 'deep'} | {' | '.join(cells)} |")
    return "\n".join(lines)


KINDS = 7


def phases():
    """The phase functions of the second table."""
    shares = (0.005, 0.01, 0.02, 0.03)
    peaked = (oi.phase.FournierForand(backscatter_ratio=share) for share in shares)
    round_ = (oi.phase.HenyeyGreenstein(g) for g in (0.8, 0.924))
    return *round_, oi.phase.petzold(), *peaked


def many_waters(count: int, seed: int = 5):
    """albedo, kind of scattering, zenith (degrees), depth and reflectance of the floor, sky's share
    of the light; and which have a surface and which a floor."""
    rng = np.random.default_rng(seed)
    high = 1 - np.exp(rng.uniform(np.log(0.03), np.log(0.3), count))
    albedo = np.where(rng.random(count) < 0.4, high, rng.uniform(0.2, 0.97, count))
    zenith = np.where(rng.random(count) < 0.2, 0.0, rng.uniform(0.0, 60.0, count))
    sky = np.where(rng.random(count) < 0.35, rng.uniform(0.1, 0.5, count), 0.0)
    phase = rng.integers(KINDS, size=count)
    depth, reflectance = rng.uniform(2.0, 12.0, count), rng.uniform(0.05, 0.5, count)
    surface, floor = rng.random(count) < 0.7, rng.random(count) < 0.35
    return (albedo, phase, zenith, depth, reflectance, sky), surface, floor


@eqx.filter_jit
def irradiances(transport, kinds, parameters, surface: bool, floor: bool):
    """Ed, Eu and E0, each (water, depth), down to some 1 % of the light."""

    def one(albedo, phase, zenith, depth, reflectance, sky):
        b = jax.nn.one_hot(phase, KINDS, dtype=albedo.dtype)[:, None] * albedo
        water = oi.IOPs(np.array([500.0]), (1.0 - albedo)[None], b, kinds)
        sun = jnp.cos(jnp.radians(zenith)) * jnp.ones(1)
        light = oi.Light(zenith, jnp.ones(1), sun * sky / (1.0 - sky) / jnp.pi)
        below = oi.Floor(depth, reflectance[None]) if floor else None
        this = oi.Scene(water, light, oi.FlatSurface() if surface else None, below)
        grid = jnp.linspace(0.0, 1.0, 10) * 4.6 / (1.0 - 0.9 * albedo)
        field = oi.irradiance(this, jnp.minimum(grid, depth) if floor else grid, transport)
        return [e.value[:, 0] for e in (field.Ed, field.Eu, field.E0)]

    return jax.lax.map(lambda p: one(*p), parameters)


def irradiance_table(count: int = 300) -> str:
    """Errors to the 1 % level, by how much the light is scattered."""
    parameters, surface, floor = many_waters(count)
    errors, kinds = {name: [] for name in MODELS}, phases()
    albedos = []
    for choice in ((s, f) for s in (True, False) for f in (True, False)):
        kept = (surface == choice[0]) & (floor == choice[1])
        some = tuple(jnp.asarray(p[kept]) for p in parameters)
        exact = np.array(irradiances(TRUTH, kinds, some, *choice))
        bright = exact[0] > 0.01 * exact[0][:, :1]
        albedos.append(np.broadcast_to(parameters[0][kept][:, None], bright.shape)[bright])
        for name, model in MODELS.items():
            found = np.array(irradiances(model, kinds, some, *choice))
            errors[name].append((found / exact - 1)[:, bright])
    albedo = np.concatenate(albedos)
    lines = [
        "",
        f"Irradiance to the 1 % level in {count} waters of many phase functions, with and without "
        "surface, floor and sky (seed 5).",
        "",
        "| | Ed | Ed, signed median | Eu | E0 |",
        "|---|---|---|---|---|",
    ]
    for name, parts in errors.items():
        every = np.concatenate(parts, axis=1)
        for low, high in ((0.0, 1.0), (0.0, 0.5), (0.5, 0.8), (0.8, 1.0)):
            some = every[:, (albedo >= low) & (albedo < high)]
            cells = [f"{np.median(e):.4f} / {np.quantile(e, 0.9):.4f}" for e in np.abs(some)]
            cells.insert(1, f"{np.median(some[0]):+.4f}")
            which = "all" if high - low == 1 else f"albedo {low} to {high}"
            lines.append(f"| {name}, {which} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    path = Path(__file__).with_suffix(".md")
    if sys.argv[1:] == ["irradiance"]:
        first = path.read_text(encoding="utf-8").split("\nIrradiance to the 1 % level")[0]
    else:
        first = table()
    text = first.rstrip() + "\n" + irradiance_table()
    print(text)
    path.write_text(text + "\n", encoding="utf-8")
