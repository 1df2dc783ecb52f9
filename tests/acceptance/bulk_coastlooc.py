"""What AC-9 spectra of real coastal waters say about algae, minerals and dissolved colour.

    python -m tests.acceptance.bulk_coastlooc SPECTRA.csv [--every N]

SPECTRA.csv: the COASTLOOC data (Massicotte et al. 2023, Earth Syst. Sci. Data 15:3529,
SEANOE 10.17882/93570, CC BY) with columns station, wavelength_nm, a_nonwater_per_m,
bp_per_m; lines that start with # are comments.  Beside it, if there, coastlooc_stations.csv with
station, area, suspended_particulate_matter_g_m3.  Prints the table and writes it beside this file
(bulk_coastlooc.md).  Every 6th station (the default) takes about ten minutes.

Noise is taken as 3 % and 0.005 /m, what AC-9 readings are worth; a misfit above 1 is what
algae, minerals and CDOM of the recipe do not describe.  The factors on absorption, the exponents
of sizes and the slope of CDOM are free within their priors.
"""

import argparse
import collections
import csv
from pathlib import Path

import jax
import numpy as np

from fitting import Bulk, NaturalWater, fit_bulk

RELATIVE, FLOOR = 0.03, 0.005
LEAST_BANDS = 6
DENSITY = 2.65  # g/cm3, quartz and clay: minerals by volume to g/m3
SHOWN = ("algae", "minerals", "cdom")


def rows(path: Path):
    """Records of a csv with comment lines."""
    with path.open() as lines:
        yield from csv.DictReader(line for line in lines if not line.startswith("#"))


def read(path: Path):
    """Wavelengths and, by station, (2, wl) readings of a and b; NaN where there is none."""
    stations = collections.defaultdict(dict)
    for row in rows(path):
        if row["a_nonwater_per_m"] and row["bp_per_m"]:
            reading = float(row["a_nonwater_per_m"]), float(row["bp_per_m"])
            stations[row["station"]][float(row["wavelength_nm"])] = reading
    grid = np.array(sorted({wl for bands in stations.values() for wl in bands}))
    nothing = (np.nan, np.nan)
    return grid, {
        name: np.array([bands.get(wl, nothing) for wl in grid]).T
        for name, bands in stations.items()
        if len(bands) >= LEAST_BANDS
    }


def fit(grid, readings, name):
    """One station; the spread of missing readings does not matter."""
    sigma = np.sqrt((RELATIVE * np.nan_to_num(readings)) ** 2 + FLOOR**2)
    bulk = Bulk(
        grid, a=readings[0], b=readings[1], sigma={"a": sigma[0], "b": sigma[1]}, source=name
    )
    return fit_bulk(bulk, NaturalWater(total=False))


def record(found, kind) -> str:
    """A row of the table."""
    seen = found.posterior_predictive
    residual = np.abs(seen.predicted / seen.observed - 1)
    cells = [found.metadata["source"], kind.get("area", ""), f"{found.metadata['misfit']:.2f}"]
    cells += [f"{100 * np.nanmedian(row):.1f}" for row in residual]
    for name in SHOWN:
        low, high = found.interval(name)
        mark = "" if found.identifiable[name] else " ?"
        cells.append(f"{found.value[name]:.2g} ({low:.2g}-{high:.2g}){mark}")
    matter = kind.get("suspended_particulate_matter_g_m3", "")
    cells += [f"{1e6 * DENSITY * found.value['minerals']:.2g}", matter]
    return "| " + " | ".join(cells) + " |"


def summary(fits, grid) -> list[str]:
    """Misfit, residuals by band, and how often each unknown is identifiable."""
    misfit = np.array([f.metadata["misfit"] for f in fits])
    text = [
        f"{len(fits)} stations, {sum(f.converged for f in fits)} converged. Misfit (rms residual "
        f"in standard deviations): median {np.median(misfit):.2f}, 90 % below "
        f"{np.percentile(misfit, 90):.2f}, largest {misfit.max():.2f}.",
        "",
        "Median of model/measured - 1, %, and (in brackets) of its size:",
        "",
        "| | " + " | ".join(f"{wl:g} nm" for wl in grid) + " |",
        "|---" * (len(grid) + 1) + "|",
    ]
    ratio = np.array(
        [f.posterior_predictive.predicted / f.posterior_predictive.observed for f in fits]
    )
    for i, name in enumerate(("a", "b")):
        off = 100 * (ratio[:, i] - 1)
        cells = [f"{np.nanmedian(band):+.1f} ({np.nanmedian(np.abs(band)):.1f})" for band in off.T]
        text.append(f"| {name} | " + " | ".join(cells) + " |")
    text += [
        "",
        "| unknown | identifiable at | median sd over prior spread | most sensitive to |",
        "|---|---|---|---|",
    ]
    for p in fits[0].parameters:
        known = sum(f.identifiable[p.name] for f in fits)
        share = np.median([f.sd[p.name] / p.spread for f in fits])
        shifts = fits[0].sensitivity.get(p.name, {})
        most = ""
        if shifts:
            size = {k: np.median([abs(f.sensitivity[p.name][k]) for f in fits]) for k in shifts}
            worst = max(size, key=size.__getitem__)
            most = f"{worst} ({size[worst]:.2f} per spread)"
        text.append(f"| {p.name} | {known}/{len(fits)} | {share:.2f} | {most} |")
    return text


def table(path: Path, every: int) -> str:
    """The text of bulk_coastlooc.md."""
    grid, stations = read(path)
    beside = path.parent / "coastlooc_stations.csv"
    kinds = {row["station"]: row for row in rows(beside)} if beside.exists() else {}
    chosen = list(stations)[::every]
    fits = [fit(grid, stations[name], name) for name in chosen]
    text = [
        "# COASTLOOC: algae, minerals and CDOM from AC-9 spectra",
        "Written by `tests/acceptance/bulk_coastlooc.py`, which says what was done. Data: "
        "Massicotte et al. 2023, ESSD 15:3529, SEANOE 10.17882/93570 (CC BY).",
        "",
        *summary(fits, grid),
        "",
        "Volume fractions, a_cdom(440) in 1/m with 95 % intervals; `?`: not identifiable (sd of "
        "the logarithm above 0.5, or hardly narrower than the prior). SPM in g/m3: minerals at "
        f"{DENSITY} g/cm3, and as weighed (minerals and organic matter). Where the misfit is well "
        "above 1 the intervals are too narrow. `cdom` takes along whatever absorbs like it, "
        "non-algal particles included; `algae` stands for particles that absorb little and "
        "`minerals` for those that absorb much: neither is a count of what its name says.",
        "",
        "| station | area | misfit | a, % | b, % | algae | minerals | cdom | SPM fit | weighed |",
        "|---" * 10 + "|",
        *[record(f, kinds.get(f.metadata["source"], {})) for f in fits],
    ]
    return "\n".join(text) + "\n"


def main() -> None:
    """Fit, print, write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("path", type=Path)
    parser.add_argument("--every", type=int, default=6)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    text = table(asked.path, asked.every)
    print(text)
    Path(__file__).with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()
