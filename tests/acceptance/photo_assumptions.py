"""One assumption broken at a time: what the tables of a fit say of it, and what the fit does.

    python -m tests.acceptance.photo_assumptions

Prints the table and writes photo_assumptions.md beside this file; about ten minutes.

ColorCheckers at 0.5, 1 and 2 m and open water at 5 m, no noise, everything unknown that `fit_photo`
leaves open.  Truth: a water by the fit's model but for one assumption, either one that has a prior,
at one standard deviation from its centre (`Fit.sensitivity`, linearised), or a table or shape that
is fixed (`fitting.photo.assumptions`, fitted anew).  Priors of constituents are centred on the
water:
elsewhere they are a second assumption that does not hold, and pull by as much as the first leaves
open.  How often the tables name the first one then, too, is counted last.

The tables are those of the fit that errs, which is all that its user has.  What is fitted anew from
there comes to the truth if the search does; what ranks then say is whether any other row looks like
it.  Ranks by the tables of the unbroken water's fit stand beside them.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from fitting import Background, Chart, Fit, Photo, assumptions, fit_photo
from fitting.commands.main import quick_compilation
from fitting.observations.photo import WAVELENGTH
from fitting.photo.forward_model import predict
from fitting.photo.problem import prepare
from fitting.water_model.alternatives import ALTERNATIVES, PREFIX
from fitting.water_model.quantities import water_quantities
from tests.acceptance._photo_protocols import CONSTITUENTS, NAMES, QUANTITIES, WATERS, photo

RANGES = (0.5, 1.0, 2.0)
# Shapes of the water that have a prior.
SHAPES = (
    "detritus_scattering_ratio", "cdom_slope", "detritus_slope", "detritus_exponent",
    "phytoplankton_exponent", "phytoplankton_absorption", "phytoplankton_scattering",
    "backscatter", "phytoplankton_package",
)  # fmt: skip
# Errors below this many standard deviations are no errors to be named.
SMALL = 0.1
WATERS_HERE = ("coastal", "clear", "turbid")


def observed(water, centred: bool, **broken) -> tuple[Fit, np.ndarray]:
    """The fit of a water with numbers changed by name, and ln of its true answers."""
    parameters, (readings,), sunlight = prepare([photo(RANGES)], oi.TwoStream())
    values = {p.name: jnp.asarray(p.centre) for p in parameters}
    changes = dict(zip(CONSTITUENTS, water, strict=True)) | broken
    values |= {name: jnp.asarray(value) for name, value in changes.items()}
    known = {p.name: p for p in parameters if not p.nuisance}
    true = water_quantities(values, WAVELENGTH, oi.TwoStream())
    seen = np.asarray(predict(values, readings, oi.TwoStream(), sunlight))
    frame, count = photo(RANGES), 24
    charts = [
        Chart(
            seen[count * k : count * (k + 1)],
            chart.reflectance,
            chart.distance,
            board=chart.board,
        )
        for k, chart in enumerate(frame.charts)
    ]
    again = Photo(charts, [Background(seen[count * len(charts) :])], response=frame.response,
                  depth=frame.depth, solar_zenith=frame.solar_zenith)  # fmt: skip
    moved = {n: dataclasses.replace(p, centre=changes[n]) for n, p in known.items()}
    priors = moved if centred else None
    return fit_photo(again, priors=priors), np.log([*water, *(float(true[n]) for n in QUANTITIES)])


def answers(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """ln of the modes of NAMES, and their standard deviations."""
    own = [fit.parameters.names.index(n) for n in CONSTITUENTS]
    logs = [*fit.x[own], *(np.log(float(fit.quantities[n].value)) for n in QUANTITIES)]
    sd = [*(fit.sd[n] for n in CONSTITUENTS), *(float(fit.quantities[n].sd) for n in QUANTITIES)]
    return np.array(logs), np.array(sd)


def tables(fit: Fit, sd) -> dict[str, np.ndarray]:
    """How far NAMES would move, in standard deviations, by assumption."""
    fixed = assumptions(fit)
    found = {n: np.array([fit.sensitivity[q][n] for q in NAMES]) / sd for n in SHAPES}
    return found | {n: np.array([fixed[q][n] for q in NAMES]) / sd for n in ALTERNATIVES}


def place(name: str, away, table) -> int:
    """Of all rows by how much of the error each explains, which is that of `name`: 1 is first."""
    near = {n: abs(away @ row) / max(np.linalg.norm(row), 1e-9) for n, row in table.items()}
    return 1 + sum(value > near[name] * 1.0001 for value in near.values())


def rows(water_name: str, centred: bool):
    """Of one water, by assumption: error in standard deviations, that foretold, chi2; and the
    ranks by the tables of the fit that errs and of the one that does not."""
    water = WATERS[water_name]
    plain, true = observed(water, centred)
    found, sd = answers(plain)
    start, before = found - true, tables(plain, sd)
    known = {p.name: p for p in plain.parameters}
    for name in before:
        if name in known:
            p = known[name]
            there = p.transform.coordinate(p.centre) + (p.spread or 1.0)
            broken = {name: float(p.transform.physical(np.float64(there)))}
        else:
            broken = {PREFIX + name: 1.0}
        fit, truth = observed(water, centred, **broken)
        away = (answers(fit)[0] - truth - start) / sd
        table = tables(fit, sd)
        places = place(name, away, table), place(name, away, before)
        yield name, away, -table[name], fit.metadata["reduced_chi2"], places


def alike(away, said) -> tuple[float, float]:
    """Size of what is foretold over that of the error, and the cosine between them."""
    length, told = np.linalg.norm(away), np.linalg.norm(said)
    return float(told / length), float(away @ said / (length * max(told, 1e-9)))


def summary(counted) -> str:
    """In words: (size, cosine, rank, rank before) of every error."""
    sizes, turns, *ranks = np.array(counted).T
    first, three = (np.sum(np.array(ranks) <= most, axis=1) for most in (1, 3))
    return (
        f"Of {len(counted)} errors above {SMALL} standard deviations the tables rank the broken "
        f"assumption first in {first[0]}, among the first three in {three[0]} (those of the "
        f"unbroken fit: {first[1]} and {three[1]}); foretold over actual size {sizes.min():.2f} "
        f"to {sizes.max():.2f}, median {np.median(sizes):.2f}; cosine between them least "
        f"{turns.min():.3f}, median {np.median(turns):.3f}."
    )


def main():
    quick_compilation()
    jax.config.update("jax_enable_x64", True)
    lines = [
        "# One assumption broken at a time\n",
        "`python -m tests.acceptance.photo_assumptions`.  Errors of the fit, and in brackets what "
        "the tables of that fit say, in standard deviations of the unbroken one.  Rank: of all "
        "rows by how much of the error each explains, that of the assumption that is broken, where "
        f"the error is above {SMALL} standard deviations; before: by the tables of the unbroken "
        "fit; sizes: foretold over actual.",
    ]
    path, counted = Path(__file__).with_name("photo_assumptions.md"), []
    for water in WATERS_HERE:
        lines += [
            f"\n## {water.capitalize()}\n",
            "| broken | " + " | ".join(NAMES) + " | size | cosine | rank | before | chi2 |",
            "|---" * (len(NAMES) + 6) + "|",
        ]
        for name, away, said, chi2, places in rows(water, True):
            cells = [f"{a:+.2f} ({s:+.2f})" for a, s in zip(away, said, strict=True)]
            numbers = ["-"] * 4
            if np.linalg.norm(away) > SMALL:
                size, turn = alike(away, said)
                counted.append((size, turn, *places))
                numbers = [f"{size:.2f}", f"{turn:.3f}", *map(str, places)]
            lines.append(f"| {name} | {' | '.join([*cells, *numbers, f'{chi2:.2f}'])} |")
            path.write_text("\n".join(lines) + "\n")
    lines.append("\n" + summary(counted))
    lines.append("\n## Priors of constituents where they are by default\n")
    for water in WATERS_HERE:
        found = [
            (*alike(away, said), *places)
            for _, away, said, _, places in rows(water, False)
            if np.linalg.norm(away) > SMALL
        ]
        lines.append(f"{water.capitalize()}: {summary(found)}\n")
        path.write_text("\n".join(lines).rstrip() + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
