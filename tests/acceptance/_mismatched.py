"""Photographs of waters that the fit's model does not know, from an exact solver.

    python -m tests.acceptance._mismatched FOLDER

FOLDER holds the specific IOPs, siops_neil2011_hydrolight_lab.csv.  Writes
tests/reference/mismatched_radiances.csv (about 10 minutes, nearly all of it PythonicDISORT).

Twelve waters of pure water (Pope & Fry 1997, Morel 1974), chlorophyll 0.5-5 mg/m3, minerals 0.1-1
g/m3 and CDOM 0.02-0.3 /m at 440 nm, with the specific IOPs that Neil, Cunningham & McKee 2011
(Remote Sensing of Environment 115:3719) used in EcoLight: scattering that does not vary with
wavelength nor follows chlorophyll^0.62, bb/b of 0.014 (algae) and 0.041 (minerals) as the
Fournier-Forand function of that ratio.  None of this is what the default model assumes.
"""

import csv
import io
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from tests.acceptance._folder import data_folder

ROOT = Path(__file__).parents[2]
SPECIFIC = "siops_neil2011_hydrolight_lab.csv"
CACHE = ROOT / "tests/reference/mismatched_radiances.csv"
WAVELENGTH = oi.spectrum.bands(16)
KD_BAND = 490.0
DEPTH = 5.0
RANGES = (1.0, 2.0, 4.0)
INDEX = 1.34
# Lines of sight are horizontal but for this: an exactly horizontal ray never leaves the slab.
_LEVEL = 1e-3


class Water(NamedTuple):
    """One water, its sun, and what an exact photograph at 5 m of it holds (sun of 1 above)."""

    chlorophyll: float
    minerals: float
    cdom: float
    sun: float
    kd_490: float
    c_550: float
    a_cdm_440: float
    bb_550: float
    c: np.ndarray
    Ed: np.ndarray
    path: np.ndarray
    background: np.ndarray


def recipes(count: int = 12, seed: int = 7) -> np.ndarray:
    """(water, 4) chlorophyll, minerals, CDOM (log-uniform) and sun zenith: a Latin hypercube."""
    rng = np.random.default_rng(seed)
    low, high = np.log([0.5, 0.1, 0.02, 20.0]), np.log([5.0, 1.0, 0.3, 60.0])
    strata = np.stack([rng.permutation(count) for _ in low], axis=1)
    return np.exp(low + (high - low) * (strata + 0.5) / count)


def specific(path: Path, wavelength) -> dict[str, np.ndarray]:
    """Columns of the table of specific IOPs at `wavelength`; blank cells are interpolated."""
    lines = [row for row in path.read_text().splitlines() if not row.startswith("#")]
    rows = list(csv.DictReader(lines))
    out = {}
    for name in rows[0]:
        kept = [(float(r["wavelength_nm"]), float(r[name])) for r in rows if r[name]]
        out[name] = np.interp(wavelength, *np.array(kept).T)
    return out


def exact_bands(recipe, table, wavelength):
    """Exact fields of one water: per band the slab, a and b."""
    from tests.reference.disort import deep_thickness, refracted_beam, solve

    sun = recipe[3]
    mu0, beam = refracted_beam(sun, INDEX)
    a, parts = iops(recipe, table, wavelength)
    b = sum(share for share, _ in parts)
    seawater = oi.phase.Seawater(oi.water.phase_constant("Morel1974"))
    shapes = jax.jit(lambda ratios, x: jnp.stack([oi.phase.FournierForand(r)(x) for r in ratios]))
    for i in range(len(wavelength)):
        ratios = jnp.asarray([ratio[i] for _, ratio in parts[1:]])
        weight = np.array([share[i] for share, _ in parts]) / b[i]
        moments = np.stack(
            [np.asarray(seawater.moments(64))]
            + [np.asarray(oi.phase.FournierForand(float(r)).moments(64)) for r in ratios]
        )

        def phase(cosine, ratios=ratios, weight=weight):
            x = jnp.asarray(float(cosine))
            return float(weight @ np.append(seawater(x), shapes(ratios, x)))

        c = a[i] + b[i]
        chi = weight @ moments
        albedo, chi = b[i] / c, chi / chi[0]
        decay = min(1.0, np.sqrt(3 * (1 - albedo) * (1 - albedo * chi[1])))
        thickness = deep_thickness(albedo, chi[1], max((DEPTH + 1) * c, 3.5 / decay))
        slab = solve(
            albedo, chi, phase, mu0, thickness,
            beam=beam, index=INDEX, streams=24, modes=16, breaks=[DEPTH * c], tolerance=1e-5,
        )  # fmt: skip
        yield slab, c, thickness


def iops(recipe, table, wavelength):
    """a (wl,) and [(b (wl,), bb/b (wl,))] of sea water, algae and minerals."""
    chlorophyll, minerals, cdom, _ = recipe
    a = (
        np.asarray(oi.water.absorption(wavelength, "PopeFry1997"))
        + chlorophyll * table["a*chl"]
        + minerals * table["a*mss"]
        + cdom * table["a*cdom"]
    )
    pure = np.asarray(oi.water.scattering(wavelength, "Morel1974"))
    parts = [(pure, np.full_like(pure, 0.5))]
    for amount, name in ((chlorophyll, "chl"), (minerals, "mss")):
        parts.append((amount * table[f"b*{name}"], table[f"bb*{name}"] / table[f"b*{name}"]))
    return a, parts


def mean_kd(slab, c, thickness) -> float:
    """Mean Kd from the surface to the depth of 10 % light, 1/m."""
    tau = np.linspace(0, thickness, 2000)
    down = np.log(slab.irradiance(tau)[0])
    level = np.interp(np.log(10.0), down[0] - down, tau)
    return float(np.log(10.0) / (level / c))


def compute(recipe, path: Path) -> Water:
    """One water, exactly."""
    chlorophyll, minerals, cdom, sun = recipe
    beam, Ed, veil, background = [], [], [], []
    for slab, c, _ in exact_bands(recipe, specific(path, WAVELENGTH), WAVELENGTH):
        at = DEPTH * c
        beam.append(c)
        Ed.append(slab.irradiance(at)[0][0])
        veil.append([slab.radiance(at, _LEVEL, 0.0, length=c * r) for r in RANGES])
        background.append(slab.radiance(at, _LEVEL, 0.0))
    at_490 = np.array([KD_BAND])
    kd = next(mean_kd(*one) for one in exact_bands(recipe, specific(path, at_490), at_490))
    marks = np.array([440.0, 550.0])
    table = specific(path, marks)
    a, parts = iops(recipe, table, marks)
    c_550 = float(a[1] + sum(share for share, _ in parts)[1])
    a_cdm = float(cdom * table["a*cdom"][0] + minerals * table["a*mss"][0])
    bb_550 = float(sum(share * ratio for share, ratio in parts)[1])
    return Water(
        chlorophyll, minerals, cdom, sun, kd, c_550, a_cdm, bb_550,
        np.array(beam), np.array(Ed), np.array(veil).T, np.array(background),
    )  # fmt: skip


_SCALARS = Water._fields[:8]


def write(waters: list[Water]) -> None:
    """Store waters as rows: name, then scalars or the sixteen bands."""
    out = io.StringIO()
    out.write(
        "# Exact photographs of twelve waters at 5 m, sun 1 at every band above a flat surface\n"
        "# (n = 1.34), horizontal views at right angles to the sun; PythonicDISORT, 24 streams.\n"
        "# Regenerate: python -m tests.acceptance._mismatched.  Specific IOPs of Neil, Cunningham\n"
        "# & McKee 2011.  sun: degrees; kd_490 (mean to 10 % light), c_550, a_cdm_440, "
        "bb_550: 1/m;\n"
        "# c (1/m), Ed, path_<range> (path radiance), background: at 16 bands of 400-700 nm.\n"
    )
    for k, water in enumerate(waters):
        for name in _SCALARS:
            out.write(f"{k},{name},{getattr(water, name):.7g}\n")
        rows = {"c": water.c, "Ed": water.Ed, "background": water.background}
        rows |= {f"path_{r:g}": row for r, row in zip(RANGES, water.path, strict=True)}
        for name, values in rows.items():
            out.write(f"{k},{name}," + ",".join(f"{v:.7g}" for v in values) + "\n")
    CACHE.write_text(out.getvalue())


def load() -> list[Water]:
    """The stored waters."""
    table: dict[int, dict[str, np.ndarray]] = {}
    for line in CACHE.read_text().splitlines():
        if not line.startswith("#"):
            k, name, *values = line.split(",")
            table.setdefault(int(k), {})[name] = np.array(values, dtype=float)
    return [
        Water(
            *(float(row[name][0]) for name in _SCALARS),
            row["c"],
            row["Ed"],
            np.stack([row[f"path_{r:g}"] for r in RANGES]),
            row["background"],
        )
        for row in table.values()
    ]


def main():
    jax.config.update("jax_enable_x64", True)
    path = data_folder("_mismatched", SPECIFIC) / SPECIFIC
    waters = []
    for k, recipe in enumerate(recipes()):
        waters.append(compute(recipe, path))
        print(f"water {k}: " + ", ".join(f"{n} {getattr(waters[-1], n):.4g}" for n in _SCALARS))
    write(waters)


if __name__ == "__main__":
    main()
