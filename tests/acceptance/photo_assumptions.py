"""One assumption broken at a time: what the tables of a fit say of it, and what the fit does.

    python -m tests.acceptance.photo_assumptions

Prints the table and writes photo_assumptions.md beside this file; about five minutes.

ColorCheckers at 0.5, 1 and 2 m and open water at 5 m, no noise, everything unknown that `fit_photo`
leaves open.  Truth: a water by the fit's model but for one assumption, either one that has a prior,
at one standard deviation from its centre (`Fit.sensitivity`, linearised), or a table or shape that
is fixed (`fitting.assumptions`, fitted anew).  Both tables are of the unbroken water.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from fitting import Background, Chart, Fit, Photo, assumptions, fit_photo
from fitting._assumed import ALTERNATIVES, PREFIX
from fitting.cli import quick_compilation
from fitting.photo import WAVELENGTH, predict, prepare
from fitting.quantities import water_quantities
from tests.acceptance._photo_protocols import CONSTITUENTS, NAMES, QUANTITIES, WATERS, photo

RANGES = (0.5, 1.0, 2.0)
# Shapes of the water that have a prior.
SHAPES = (
    "tie", "cdom_slope", "detritus_slope", "detritus_exponent", "phytoplankton_exponent",
    "phytoplankton_absorption", "phytoplankton_scattering", "backscatter", "phytoplankton_package",
)  # fmt: skip
# Errors below this many standard deviations are no errors to be named.
SMALL = 0.1


def observed(water, **broken) -> tuple[Fit, np.ndarray]:
    """The fit of a water with numbers changed by name, and ln of its true answers."""
    parameters, (readings,), sunlight = prepare([photo(RANGES)], oi.TwoStream())
    values = {p.name: jnp.asarray(p.centre) for p in parameters}
    changes = dict(zip(CONSTITUENTS, water, strict=True)) | broken
    values |= {name: jnp.asarray(value) for name, value in changes.items()}
    true = water_quantities(values, WAVELENGTH, oi.TwoStream())
    seen = np.asarray(predict(values, readings, oi.TwoStream(), sunlight))
    frame, count = photo(RANGES), 24
    charts = [
        Chart(seen[count * k : count * (k + 1)], chart.reflectance, chart.distance)
        for k, chart in enumerate(frame.charts)
    ]
    again = Photo(charts, [Background(seen[count * len(charts) :])], response=frame.response,
                  depth=frame.depth, solar_zenith=frame.solar_zenith)  # fmt: skip
    return fit_photo(again), np.log([*water, *(float(true[n]) for n in QUANTITIES)])


def answers(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """ln of the modes of NAMES, and their standard deviations."""
    own = [fit.parameters.names.index(n) for n in CONSTITUENTS]
    logs = [*fit.x[own], *(np.log(float(fit.quantities[n].value)) for n in QUANTITIES)]
    sd = [*(fit.sd[n] for n in CONSTITUENTS), *(float(fit.quantities[n].sd) for n in QUANTITIES)]
    return np.array(logs), np.array(sd)


def rows(water_name: str):
    """Of one water, by assumption: error in standard deviations, that foretold, chi2; and how much
    of the error each row could explain, by assumption."""
    water = WATERS[water_name]
    plain, true = observed(water)
    found, sd = answers(plain)
    start = found - true
    known = {p.name: p for p in plain.parameters}
    fixed = assumptions(plain)
    table = {n: np.array([plain.sensitivity[q][n] for q in NAMES]) / sd for n in SHAPES}
    table |= {n: np.array([fixed[q][n] for q in NAMES]) / sd for n in ALTERNATIVES}
    for name in table:
        if name in known:
            p = known[name]
            there = p.transform.coordinate(p.centre) + (p.spread or 1.0)
            broken = {name: float(p.transform.physical(np.float64(there)))}
        else:
            broken = {PREFIX + name: 1.0}
        fit, truth = observed(water, **broken)
        away = (answers(fit)[0] - truth - start) / sd
        near = {n: abs(away @ row) / max(np.linalg.norm(row), 1e-9) for n, row in table.items()}
        yield name, away, -table[name], fit.metadata["reduced_chi2"], near


def main():
    quick_compilation()
    jax.config.update("jax_enable_x64", True)
    lines = [
        "# One assumption broken at a time\n",
        "`python -m tests.acceptance.photo_assumptions`.  Errors of the fit, and in brackets what "
        "the table of the unbroken fit says, in standard deviations.  Rank: of all rows by how "
        "much of the error each explains, that of the assumption that is broken, where the error "
        f"is above {SMALL} standard deviations; sizes: foretold over actual.",
    ]
    path = Path(__file__).with_name("photo_assumptions.md")
    ranks, sizes, turns = [], [], []
    for water in ("coastal", "clear", "turbid"):
        lines += [
            f"\n## {water.capitalize()}\n",
            "| broken | " + " | ".join(NAMES) + " | size | cosine | rank | chi2 |",
            "|---" * (len(NAMES) + 5) + "|",
        ]
        for name, away, said, chi2, near in rows(water):
            cells = [f"{a:+.2f} ({s:+.2f})" for a, s in zip(away, said, strict=True)]
            length, told = np.linalg.norm(away), np.linalg.norm(said)
            size, cosine, rank = "-", "-", "-"
            if length > SMALL:
                place = 1 + sum(value > near[name] * 1.0001 for value in near.values())
                turn = float(away @ said / (length * max(told, 1e-9)))
                ranks.append(place)
                sizes.append(told / length)
                turns.append(turn)
                size, cosine, rank = f"{told / length:.2f}", f"{turn:.3f}", str(place)
            cells += [size, cosine, rank, f"{chi2:.2f}"]
            lines.append(f"| {name} | {' | '.join(cells)} |")
            path.write_text("\n".join(lines) + "\n")
    lines.append(
        f"\nOf {len(ranks)} errors above {SMALL} standard deviations the table ranks the broken "
        f"assumption first in {np.sum(np.array(ranks) == 1)}, among the first three in "
        f"{np.sum(np.array(ranks) <= 3)}; foretold over actual size {np.min(sizes):.2f} to "
        f"{np.max(sizes):.2f}, median {np.median(sizes):.2f}; cosine between them least "
        f"{np.min(turns):.3f}, median {np.median(turns):.3f}."
    )
    path.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
