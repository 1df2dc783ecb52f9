"""Real casts of three instruments: Kd against the maker's, a turbid estuary, a flow-through file.

    python -m tests.acceptance.real_casts FOLDER

FOLDER holds casts that may not be redistributed: cops_iml4_20150630.csv (C-OPS, St Lawrence
Estuary), hyperpro_001AB_20160501_ed.csv with hyperpro_001AB_20160501_kd_prosoft_L4.csv (HyperPro
and the Kd of its maker's software), example_seabass_tara_acs.sb (flow-through absorption).  Prints
the table and writes real_casts.md beside this file; half a minute.  Ends with status 1 if a value
leaves the range beside it.  The fast tests use synthetic casts of the same kinds, of known truth
(tests/fitting/synthetic_casts.py).
"""

import csv
import sys
from pathlib import Path

import jax
import numpy as np

from fitting import Profile, fit_profile
from fitting.files.cast_file import Reading, read_cast
from fitting.files.seabass import read_seabass
from tests.acceptance._folder import data_folder

COPS, SEABASS = "cops_iml4_20150630.csv", "example_seabass_tara_acs.sb"
HYPERPRO = ("hyperpro_001AB_20160501_ed.csv", "hyperpro_001AB_20160501_kd_prosoft_L4.csv")
# Kd (1/m) of 1-8 m, by a straight line through ln(Ed) of the same cast, read to two digits.
COPS_KD = {412: 1.49, 443: 1.16, 490: 0.77, 555: 0.48, 625: 0.64}
UNITS = {"Ed": "uW cm-2 nm-1", "Lu": "uW cm-2 nm-1 sr-1", "surface": "uW cm-2 nm-1"}

Row = tuple[str, float, float, float]


def estuary(path: Path) -> list[Row]:
    profile = read_cast(path, Reading(units=UNITS, depth_offset=-0.09, upward_offset=0.25))
    assert profile.reference is not None
    fit = fit_profile(profile, depth_range=(1.0, 8.0))
    index = profile.wavelength.tolist().index
    kd, rrs = fit.quantities["Kd"].value, fit.quantities["Rrs"].value
    ratio = fit.quantities["KLu"].value / kd
    off = max(abs(kd[index(band)] / value - 1) for band, value in COPS_KD.items())
    green = rrs[index(555)]
    return [
        ("C-OPS: largest difference of Kd from a straight line, five bands", off, 0.0, 0.05),
        (
            "C-OPS: what shadow bands leave on the reference",
            np.ptp(profile.reference[:, 8]),
            0,
            0.05,
        ),
        ("C-OPS: Rrs(555), 1/sr", green, 0.003, 0.008),
        ("C-OPS: Rrs(412) / Rrs(555)", rrs[index(412)] / green, 0.0, 0.4),
        ("C-OPS: Rrs(665) / Rrs(555)", rrs[index(665)] / green, 0.0, 0.6),
        ("C-OPS: least KLu / Kd, 443-589 nm", ratio[index(443) : index(625)].min(), 0.85, 1.15),
        ("C-OPS: largest KLu / Kd, 443-589 nm", ratio[index(443) : index(625)].max(), 0.85, 1.15),
        ("C-OPS: depth of 10 % of PAR, m", float(fit.quantities["Z_10"].value), 2.5, 4.5),
    ]


def table(path: Path, prefix: str):
    """Wavelengths, depths and the columns that start with `prefix`."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.reader(lines))
    columns = [i for i, column in enumerate(rows[0]) if column.startswith(prefix)]
    wavelength = np.array([float(rows[0][i].removeprefix(prefix)) for i in columns])
    numbers = np.array([[float(v) if v else np.nan for v in row] for row in rows[1:]])
    return wavelength, numbers[:, 0], numbers[:, columns]


def against_the_maker(folder: Path, low: float = 5.0, high: float = 25.0) -> list[Row]:
    """Our mean Kd from low to high metres over the maker's, 412-555 nm, by fitted range."""
    wavelength, depth, Ed = table(folder / HYPERPRO[0], "Ed_")
    _, z, makers = table(folder / HYPERPRO[1], "Kd_")
    bands = (wavelength >= 411.9) & (wavelength <= 555.5)
    mean = makers[(z >= low) & (z <= high)][:, bands].mean(axis=0)
    rows = []
    for depth_range in ((5.0, 25.0), (0.0, 30.0), (0.0, 40.0)):
        profile = Profile(depth, wavelength[bands], 0.01 * Ed[:, bands])
        fit = fit_profile(profile, depth_range=depth_range, layers=None)
        curve = fit.posterior_predictive.predicted
        ours = np.log(curve[depth == low] / curve[depth == high])[0] / (high - low)
        name = f"HyperPro, {depth_range[0]:g}-{depth_range[1]:g} m fitted"
        off = float(np.max(np.abs(ours / mean - 1)))
        rows.append((f"{name}: largest difference from the maker's Kd", off, 0.0, 0.05))
        rows.append((f"{name}: interfaces", float(len(fit.metadata["interfaces_m"])), 1.0, 3.0))
    return rows


def flow_through(path: Path) -> list[Row]:
    file = read_seabass(path)
    said = 0.0
    try:
        read_cast(path)
    except ValueError as error:
        said = float("this is not a profile" in str(error))
    latitude = file.degrees("north_latitude")
    assert latitude is not None
    rows = len(file.columns["ap440.7"]) - len(file.columns["wt"])
    return [
        ("SeaBASS: northern latitude, degrees", latitude, 6.036, 6.036),
        ("SeaBASS: rows of ap440.7 less those of Wt", float(rows), 0.0, 0.0),
        ("SeaBASS: refused as a profile (1: yes)", said, 1.0, 1.0),
    ]


def main() -> int:
    folder = data_folder("real_casts", COPS, *HYPERPRO, SEABASS)
    jax.config.update("jax_enable_x64", True)
    rows = estuary(folder / COPS) + against_the_maker(folder) + flow_through(folder / SEABASS)
    lines = [
        "# Real casts",
        "",
        "`python -m tests.acceptance.real_casts FOLDER`.",
        "",
        "| what | found | asked |",
        "|---|---|---|",
        *(f"| {name} | {value:.4g} | {low:g} to {high:g} |" for name, value, low, high in rows),
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    Path(__file__).with_suffix(".md").write_text(text)
    return int(not all(low <= value <= high for _, value, low, high in rows))


if __name__ == "__main__":
    sys.exit(main())
