"""Does `oceaninv.plan` keep its word?  Random scenes, every transport tried on each.

    python -m tests.acceptance.plan fit [FOLDER]
    python -m tests.acceptance.plan [FOLDER]

The first fits the error models and their margins on the scenes `CALIBRATION`, writes
oceaninv/fidelity/errors.csv and centres.csv, and how plans for scenes of folds left out fare in
plan_calibration.md.  The second plans the scenes `TEST` of another seed at tolerances of 10, 3
and 1 %, compares with the true error and cost of each transport, prints the table and writes it to
plan.md beside this file.  The results of the transports are kept in FOLDER, if one is given; an
interrupted run continues from there.  Seeded; about forty minutes of one core, and eight.
"""

import functools
import sys
import time
from pathlib import Path

import jax
import numpy as np

import oceaninv as oi
from oceaninv.fidelity import error_model as errors
from oceaninv.fidelity import planning
from tests.acceptance import _plan_models as models
from tests.acceptance import _plan_scenes as scenes

# (scenes, seed): an even count, for odd and even scenes see other bands.
CALIBRATION = ((240, 11), (200, 47), (200, 53), (200, 59), (400, 83))
TEST = (200, 71)
PEOPLES = (8, 31)  # bands of 400-700 nm for which planning is timed
TIMED = 40  # scenes


def collected(sets, folder: Path | None):
    """By quantity and transport: values, lit bands and seconds, of scenes of several seeds."""
    parts = [collect(scenes.draw(count, seed), f"{count}_{seed}", folder) for count, seed in sets]
    found = {}
    for key in parts[0]:
        values, lit, seconds = zip(*(part[key] for part in parts), strict=True)
        found[key] = np.concatenate(values), np.concatenate(lit), float(min(seconds))
    return found


def collect(draws, name: str, folder: Path | None):
    """The same of one seed; the reference among the transports."""
    found = {}
    for quantity, candidates in scenes.RUNS.items():
        for transport in (scenes.REFERENCES[quantity], *candidates):
            key = quantity, planning.model_label(transport)
            file = folder and folder / f"{name}_{'_'.join(key)}.npz"
            if file and file.exists():
                found[key] = tuple(np.load(file).values())
                continue
            found[key] = scenes.answers(draws, transport, quantity)
            if file:
                np.savez(file, *found[key])
            print(*key, f"{1e3 * found[key][2]:.3g} ms", flush=True)
    return found


def cases(draws):
    """By kind: (scene, eye's depth, `errors.Bands`) of each draw, concrete."""
    found = {kind: [] for kind in scenes.RUNS}
    for kind, out in found.items():
        for i in range(draws.depth.shape[0]):
            p = jax.tree.map(lambda v, i=i: v[i], draws)
            this, eye = _built(p, kind)
            out.append((this, float(eye), errors.bands_of(this, this.water)))
    return found


@functools.partial(jax.jit, static_argnums=(1, 2))
def _built(p, kind, count=8):
    this = scenes.scene(p, kind, np.linspace(400.0, 700.0, count))
    return this, scenes.levels(this, p)[1]


def crossed(found, all_cases) -> str:
    """Tables of plans for calibration scenes, each by models that have not seen it."""
    lines = [
        "# plan() on calibration scenes, cross-validated\n",
        f"`python -m tests.acceptance.plan fit`: {sum(n for n, _ in CALIBRATION)} scenes of seeds "
        f"{', '.join(str(seed) for _, seed in CALIBRATION)} in {models.FOLDS} folds, each planned "
        "by error models that were fitted to the others; only the margins, one share of the scenes "
        "per quantity whose excess over the expected error they cover, are common to all: the "
        f"fewest that keep {100 * models.KEPT[0]:g} % at every tolerance, or "
        f"{100 * models.KEPT[1]:g} % where that costs no more.  Kept: of "
        "promised plans, and of scenes in which some candidate keeps the tolerance.\n",
        *_HEAD,
    ]
    frontier = [
        "\nWhat margins buy: the least share kept over the three tolerances, of promised plans "
        "and of scenes in which some transport does, and the median cost over the cheapest "
        "sufficient transport at 10 / 3 / 1 %, of the candidates and of all that was tried.\n",
        "| quantity | excess covered | kept | cost, candidates | cost, all |",
        "|---|---|---|---|---|",
    ]
    for quantity in models.QUANTITIES:
        sample = models.Sample(found, all_cases, quantity)
        expected = {n: sample.unseen(n) for n in sample.known}
        margin = models.margins(sample)
        for tolerance in models.TOLERANCES:
            outcome = models.outcome(sample, expected, margin, tolerance)
            lines.append(f"| {quantity} | {100 * tolerance:g} % | {_cells(outcome)} |")
        for share in (0.7, 0.8, 0.85, 0.9, 0.95, 0.98):
            margin = models.quantiles(sample, expected, share)
            rows = [models.outcome(sample, expected, margin, t) for t in models.TOLERANCES]
            kept = min(min(row.word, row.of_possible) for row in rows)
            own, every = (
                " / ".join(f"{row[k]:.2f}" for row in rows)
                for k in map(models.Outcome._fields.index, ("own", "every"))
            )
            frontier.append(f"| {quantity} | {share:g} | {kept:.3f} | {own} | {every} |")
    return "\n".join([*lines, *frontier, *_rungs(found, all_cases)]) + "\n"


_HEAD = (
    "| quantity | tolerance | kept, where promised | promised | kept, where possible | "
    "cost / cheapest of the candidates, median (mean) | cost / cheapest of all, median |",
    "|---|---|---|---|---|---|---|",
)


def _cells(outcome) -> str:
    return (
        f"{outcome.word:.3f} | {outcome.promised:.3f} | {outcome.of_possible:.3f} | "
        f"{outcome.own:.2f} ({outcome.mean:.2f}) | {outcome.every:.2f}"
    )


def table(found, all_cases, draws) -> str:
    lines = [
        "# plan() against exhaustive trial\n",
        f"`python -m tests.acceptance.plan`: {TEST[0]} random scenes of seed {TEST[1]}, never "
        "looked at before (error models, margins and the choice of transports: other scenes, "
        "`python -m tests.acceptance.plan fit`, plan_calibration.md).  Chlorophyll "
        "0.01-30 mg/m3, CDOM and detritus 0.001-5 /m, sun 0-75 degrees, sky in half, depth "
        "0.5-40 m, floor in half; eight bands of 400-700 nm, of radiance every second one.  Truth: "
        f"{' and '.join(map(planning.model_label, scenes.REFERENCES.values()))}.  Cost: processor "
        "seconds per scene of the compiled program, over the cheapest transport that keeps the "
        "tolerance, of the candidates and of all that was tried; among scenes in which one does "
        "(possible).  Where nothing is promised the transport that comes nearest is run.\n",
        f"{_HEAD[0]} kept of all | chosen |",
        f"{_HEAD[1]}---|---|",
    ]
    for quantity in models.QUANTITIES:
        sample = models.Sample(found, all_cases, quantity)
        for tolerance in models.TOLERANCES:
            lines.append(_row(sample, tolerance))
    lines += _rungs(found, all_cases)
    lines += ["", *_planning(draws)]
    return "\n".join(lines)


def _rungs(found, all_cases) -> list[str]:
    """What each transport errs by, and costs."""
    lines = [
        "\nWhat each transport errs by on these scenes, median / 95th percentile, and costs:\n",
        "| transport | irradiance | radiance | photograph | ms per scene |",
        "|---|---|---|---|---|",
    ]
    samples = {
        quantity: models.Sample(found, all_cases, quantity) for quantity in models.QUANTITIES
    }
    for key, candidates in scenes.RUNS.items():
        for name in map(planning.model_label, candidates):
            cells = {}
            for quantity, sample in samples.items():
                here = models.key_of(quantity) == key
                e = sample.true[name] if here else np.zeros(0)
                cells[quantity] = f"{np.median(e):.2g} / {np.quantile(e, 0.95):.2g}" if here else ""
            cost = 1e3 * found[key, name][2]
            lines.append(f"| {name} | {' | '.join(cells.values())} | {cost:.2g} |")
    return lines


def _row(sample: models.Sample, tolerance: float) -> str:
    """What became of the plans at one tolerance."""
    chosen, promised = [], []
    for i, (this, eye, _) in enumerate(sample.cases):
        views = errors.features_of_waters(this, errors.observed_waters(this, sample.quantity, eye))
        found = planning.choose(this, tolerance, sample.quantity, views, scenes.channels(i % 2))
        chosen.append(planning.model_label(found[0]))
        promised.append(found[1] <= tolerance)
    outcome = models.judged(sample, chosen, np.array(promised), tolerance)
    of_all = np.mean([sample.true[n][i] <= tolerance for i, n in enumerate(chosen)])
    counts = ", ".join(f"{n} {chosen.count(n)}" for n in sample.names if n in chosen)
    return (
        f"| {sample.quantity} | {100 * tolerance:g} % | {_cells(outcome)} | {of_all:.3f} | "
        f"{counts} |"
    )


def _planning(draws) -> list[str]:
    """Time of whole plans beside one call of the last candidate, its program compiled before:
    what has to be run without planning so that no scene errs by more than 1 %."""
    lines = [
        "| planning at 3 % | bands | ms | run of the last transport, ms | share |",
        "|---|---|---|---|---|",
    ]
    for quantity in models.QUANTITIES:
        last = planning.CANDIDATES[quantity][-1]
        for count in PEOPLES:
            planned, run = [], []
            for i in range(TIMED):
                p = jax.tree.map(lambda v, i=i: v[i], draws)
                this, eye = _built(p, "irradiance", count)
                eye = float(eye)
                start = time.process_time()
                planning.plan(this, 0.03, quantity, depth=eye)
                planned.append(time.process_time() - start)
                start = time.process_time()
                if quantity == "irradiance":
                    depths = np.linspace(0.1, 1.0, 10) * eye
                    jax.block_until_ready(oi.irradiance(this, depths, last).Ed.value)
                elif i < TIMED // 8:
                    origin = np.zeros(p.views.shape)
                    origin[:, 2] = eye
                    rays = oi.Rays(origin, p.views)
                    jax.block_until_ready(oi.radiance(this, rays, last).value)
                else:
                    continue
                run.append(time.process_time() - start)
            mine, saved = 1e3 * np.mean(planned[1:]), 1e3 * np.mean(run[1:])
            name = planning.model_label(last)
            lines.append(
                f"| {quantity} | {count} | {mine:.2g} | {name}: {saved:.3g} | "
                f"{100 * mine / saved:.2g} % |"
            )
    return lines


def main():
    jax.config.update("jax_enable_x64", True)
    fitting, folders = "fit" in sys.argv[1:], [w for w in sys.argv[1:] if w != "fit"]
    sets = CALIBRATION if fitting else (TEST,)
    draws = scenes.draws_of(sets)
    found, all_cases = collected(sets, Path(folders[0]) if folders else None), cases(draws)
    if fitting:
        models.write_centres(all_cases)
        models.write(models.fit(found, all_cases))
        Path(__file__).with_name("plan_calibration.md").write_text(crossed(found, all_cases))
        return
    report = table(found, all_cases, draws)
    print(report)
    Path(__file__).with_suffix(".md").write_text(report + "\n")


if __name__ == "__main__":
    main()
