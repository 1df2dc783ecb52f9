"""How much the absorption of algae varies at a given chlorophyll, on European coasts.

    python -m tests.acceptance.algae_coastlooc FOLDER

FOLDER holds coastlooc_spectra.csv and coastlooc_stations.csv, tables of Massicotte et al. 2023
(Earth System Science Data 15:3529, doi 10.17882/93570).  Prints the table and writes
algae_coastlooc.md beside this file; a second.

At stations with AC-9 absorption the absorption without water's, 412-676 nm, is split into the
algae's mean spectrum at the measured chlorophyll (Bricaud et al. 1998) times a factor, and an
exponential whose slope is chosen best: non-negative least squares, 5 % and 0.005 /m a reading.  The
spread of that factor holds what nature varies and what is measured wrongly: chlorophyll, AC-9, the
split.
"""

import csv
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from oceaninv.foundation.tables import load
from tests.acceptance._folder import data_folder

NEEDED = (412, 440, 488, 510, 555, 676)
SLOPES = np.linspace(0.008, 0.022, 15)


def table_of(path: Path) -> list[dict[str, str]]:
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def algae(chlorophyll: float, wavelength: np.ndarray) -> np.ndarray:
    known = load("Bricaud1998")
    power = np.asarray(known.at(wavelength, "E_phi"))
    return np.asarray(known.at(wavelength, "A_phi")) * chlorophyll**power


def split(chlorophyll: float, seen: dict[int, float]) -> tuple[float, float]:
    """Factor on the algae's mean absorption, and their share of the absorption at 440 nm."""
    grid = np.array(sorted(nm for nm in seen if nm <= 676), dtype=float)
    a = np.array([seen[int(nm)] for nm in grid])
    weight = 1 / (0.05 * a + 0.005)
    found = []
    for slope in SLOPES:
        columns = np.stack([algae(chlorophyll, grid), np.exp(-slope * (grid - 440))], axis=1)
        (factor, _), misfit = nnls(columns * weight[:, None], a * weight)
        found.append((misfit, factor))
    factor = min(found)[1]
    return factor, factor * algae(chlorophyll, np.array([440.0]))[0] / seen[440]


def spread(logs: np.ndarray) -> str:
    low, middle, high = np.quantile(logs, [0.16, 0.5, 0.84])
    robust = 1.4826 * np.median(np.abs(logs - middle))
    return f"{len(logs)} | {np.exp(middle):.2f} | {robust:.2f} | {0.5 * (high - low):.2f}"


def main():
    folder = data_folder("algae_coastlooc", "coastlooc_spectra.csv", "coastlooc_stations.csv")
    stations = {row["station"]: row for row in table_of(folder / "coastlooc_stations.csv")}
    spectra: dict[str, dict[int, float]] = {}
    for row in table_of(folder / "coastlooc_spectra.csv"):
        if row["a_nonwater_per_m"]:
            own = spectra.setdefault(row["station"], {})
            own[int(row["wavelength_nm"])] = float(row["a_nonwater_per_m"])
    rows = []
    for name, seen in spectra.items():
        chlorophyll = stations[name]["chlorophyll_a_mg_m3"]
        enough = all(nm in seen for nm in NEEDED) and (630 in seen or 650 in seen)
        if chlorophyll and enough:
            rows.append((float(chlorophyll), *split(float(chlorophyll), seen)))
    chlorophyll, factor, share = np.array(rows).T
    lines = [
        "# Absorption of algae at given chlorophyll\n",
        "`python -m tests.acceptance.algae_coastlooc FOLDER`: stations of COASTLOOC; factor on the "
        "mean of Bricaud et al. 1998.  Spreads are of its logarithm.\n",
        "| stations | number | median | 1.48 x median deviation | half of the 16-84 % range |",
        "|---|---|---|---|---|",
    ]
    for words, kept in (
        ("all", factor > 0),
        ("chlorophyll above 0.5 mg/m3", (factor > 0) & (chlorophyll > 0.5)),
        (
            "and a fifth of the absorption at 440 nm theirs",
            (factor > 0) & (chlorophyll > 0.5) & (share > 0.2),
        ),
    ):
        lines.append(f"| {words} | {spread(np.log(factor[kept]))} |")
    lines.append(
        f"\nNo algae found at {np.sum(factor == 0)} of {len(factor)} stations; they are left out.  "
        "In the open ocean chlorophyll explains 0.90 of the variance of ln absorption at 440 nm "
        "over three decades (Bricaud et al. 1998): 0.3-0.4 are left.  A fit of photographs takes "
        "0.55."
    )
    text = "\n".join(lines) + "\n"
    Path(__file__).with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
