"""Does `oceaninv.plan` keep its word?  Random scenes, every rung tried on each.

    python -m tests.acceptance.plan fit [FOLDER]
    python -m tests.acceptance.plan [FOLDER]

The first fits the error models and their margins on `CALIBRATION` scenes, writes
oceaninv/fidelity/errors.csv, and how plans for scenes of folds left out fare in
plan_calibration.md.  The second plans `TEST` scenes of another seed at tolerances of 10, 3
and 1 %, compares with what each rung really errs by and costs, prints the table and writes plan.md
beside this file.  What the rungs say is kept in FOLDER, if one is given, from which a run that was
cut off goes on.  Seeded; about ten minutes of one core each.
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np

import oceaninv as oi
from oceaninv.fidelity import _errors as errors
from oceaninv.fidelity import choice as planning
from tests.acceptance import _plan_scenes as scenes

QUANTITIES = planning.QUANTITIES
CALIBRATION, CALIBRATION_SEED = 240, 11
TEST, TEST_SEED = 200, 29
TOLERANCES = (0.1, 0.03, 0.01)
# Least share of plans that must be kept at each tolerance in scenes which a fit has not seen.
KEPT, FOLDS = 0.965, 5


def collect(draws, name: str, folder: Path | None):
    """By quantity and rung: values, lit bands and seconds; the reference among the rungs."""
    found = {}
    for quantity, ladder in scenes.RUNS.items():
        for rung in (scenes.REFERENCE, *ladder):
            key = quantity, planning.rung(rung)
            file = folder and folder / f"{name}_{'_'.join(key)}.npz"
            if file and file.exists():
                found[key] = tuple(np.load(file).values())
                continue
            found[key] = scenes.answers(draws, rung, quantity)
            if file:
                np.savez(file, *found[key])
            print(*key, f"{1e3 * found[key][2]:.3g} ms", flush=True)
    return found


def cases(draws):
    """(scene, eye's depth, `errors.Bands`) of each draw, concrete."""
    out = []
    for i in range(draws.depth.shape[0]):
        p = jax.tree.map(lambda v, i=i: v[i], draws)
        this, eye = _built(p)
        out.append((this, float(eye), errors.bands_of(this, this.water)))
    return out


@jax.jit
def _built(p):
    this = scenes.scene(p)
    return this, scenes.levels(this, p)[1]


def by_band(value, truth, quantity):
    """(scene, wl) errors of the bands."""
    relative = np.abs(value / truth - 1.0)
    if quantity == "irradiance":
        return relative.max(axis=1)
    if quantity == "radiance":
        return np.quantile(relative[:, : scenes.DIRECTIONS], 0.95, axis=1)
    seen, true = value[:, scenes.DIRECTIONS :], truth[:, scenes.DIRECTIONS :]
    return np.sqrt(np.mean((seen - true) ** 2, axis=1)) / true.mean(axis=1)


def key_of(quantity: str) -> str:
    """Photographs are made of radiance."""
    return "irradiance" if quantity == "irradiance" else "radiance"


class Sample:
    """One quantity of many scenes: features of their bands, and what each rung errs by."""

    def __init__(self, found, all_cases, quantity: str):
        key = key_of(quantity)
        truth, lit, _ = found[key, planning.rung(scenes.REFERENCE)]
        self.quantity, self.names = quantity, [planning.rung(r) for r in planning.LADDERS[quantity]]
        self.bands = [bands for *_, bands in all_cases]
        self.at = [errors.depths_of(bands, this, quantity, eye) for this, eye, bands in all_cases]
        self.rows = np.stack(
            [
                errors.features(bands, this, at)
                for (this, _, bands), at in zip(all_cases, self.at, strict=True)
            ]
        )
        self.use = lit if key == "radiance" else np.ones_like(lit)
        self.target, self.true, self.cost = {}, {}, {}
        # Models are made of all that was run; plans choose from the quantity's ladder.
        self.known = [planning.rung(r) for r in scenes.RUNS[key]]
        for name in self.known:
            value, _, self.cost[name] = found[key, name]
            self.target[name] = np.log(by_band(value, truth, quantity) + errors.LEAST)
            self.true[name] = scenes.errors(value, truth, lit, quantity)

    def solve(self, name: str, training: np.ndarray) -> np.ndarray:
        """Coefficients of one rung from some of the scenes."""
        use = self.use & training[:, None]
        x, y = self.rows[use], self.target[name][use]
        scale = np.sqrt(np.mean(x**2, axis=0)) + 1e-12
        ridge = 1e-3 * len(x) * np.eye(x.shape[1])
        normal = (x / scale).T @ (x / scale) + ridge
        return np.linalg.solve(normal, (x / scale).T @ y) / scale

    def expected(self, i: int, coefficients: np.ndarray) -> float:
        """ln of what a scene is expected to err by, without a margin."""
        per_band = self.rows[i] @ coefficients
        return errors.combine(per_band, self.bands[i], self.at[i], self.quantity, scenes.channels())

    def unseen(self, name: str) -> np.ndarray:
        """(scene,) the same from fits to the other folds."""
        fold = np.arange(len(self.rows)) % FOLDS
        parts = [self.solve(name, fold != k) for k in range(FOLDS)]
        return np.array([self.expected(i, parts[k]) for i, k in enumerate(fold)])


def margins(sample: Sample) -> dict[str, float]:
    """By rung: the smallest quantile of what errors exceed their expectation by, one for all rungs,
    with which plans are kept often enough at every tolerance."""
    expected = {name: sample.unseen(name) for name in sample.known}
    excess = {n: np.log(sample.true[n] + errors.LEAST) - expected[n] for n in sample.known}
    found = {}
    for share in np.linspace(0.6, 0.995, 80):
        found = {n: float(np.quantile(excess[n], share)) for n in sample.known}
        if all(_kept(sample, expected, found, tolerance) >= KEPT for tolerance in TOLERANCES):
            break
    return found


def _kept(sample: Sample, expected, margin, tolerance: float) -> float:
    """Share of the promised plans that keep their tolerance."""
    return _outcome(sample, expected, margin, tolerance)[0]


def _outcome(sample: Sample, expected, margin, tolerance: float) -> tuple[float, float, float]:
    """Shares of promised plans that are kept and of plans that are promised; median cost of the
    promised ones over the cheapest sufficient rung."""
    promised = np.stack([expected[n] + margin[n] <= np.log(tolerance) for n in sample.names])
    true = np.stack([sample.true[n] for n in sample.names])
    cost = np.array([sample.cost[n] for n in sample.names])
    chosen, some = np.argmax(promised, axis=0), promised.any(axis=0)
    kept = true[chosen, np.arange(len(chosen))] <= tolerance
    least = np.min(np.where(true <= tolerance, cost[:, None], np.inf), axis=0)
    ratio = (cost[chosen] / least)[some & np.isfinite(least)]
    if not some.any():
        return 1.0, 0.0, np.nan
    return float(kept[some].mean()), float(some.mean()), float(np.median(ratio))


def crossed(found, all_cases) -> str:
    """Table of plans for calibration scenes, each by models that have not seen it."""
    lines = [
        "# plan() on calibration scenes, cross-validated\n",
        f"`python -m tests.acceptance.plan fit`: {len(all_cases)} scenes of seed "
        f"{CALIBRATION_SEED} in {FOLDS} folds, each planned by error models that were fitted to "
        "the others; only the margins, one number per quantity, are common to all.\n",
        "| quantity | tolerance | kept, where promised | promised | cost / cheapest, median |",
        "|---|---|---|---|---|",
    ]
    for quantity in QUANTITIES:
        sample = Sample(found, all_cases, quantity)
        expected, margin = {n: sample.unseen(n) for n in sample.names}, margins(sample)
        for tolerance in TOLERANCES:
            kept, promised, ratio = _outcome(sample, expected, margin, tolerance)
            lines.append(
                f"| {quantity} | {100 * tolerance:g} % | {kept:.3f} | {promised:.3f} | "
                f"{ratio:.2f} |"
            )
    return "\n".join([*lines, *_rungs(found, all_cases)]) + "\n"


def fit(found, all_cases) -> dict[tuple[str, str], errors.Model]:
    """Error models of every rung."""
    models = {}
    for quantity in QUANTITIES:
        sample = Sample(found, all_cases, quantity)
        everything = np.ones(len(all_cases), bool)
        for name, margin in margins(sample).items():
            coefficients = sample.solve(name, everything)
            models[quantity, name] = errors.Model(coefficients, margin, sample.cost[name])
    return models


def write(models) -> None:
    lines = [
        "# title: What each rung of the ladder errs by: coefficients of the features of a band",
        f"# source: fitted to {CALIBRATION} random scenes by python -m tests.acceptance.plan fit",
        "# columns: quantity, rung, margin (ln), seconds per scene, coefficients",
    ]
    for (quantity, rung), model in models.items():
        numbers = [f"{v:.5g}" for v in (model.margin, model.seconds, *model.coefficients)]
        lines.append(",".join([quantity, f'"{rung}"', *numbers]))
    errors.DATA.write_text("\n".join(lines) + "\n")


def table(found, all_cases) -> str:
    count = len(all_cases)
    lines = [
        "# plan() against exhaustive trial\n",
        f"`python -m tests.acceptance.plan`: {count} random scenes of seed {TEST_SEED}, in whose "
        "sight nothing was chosen but one rung: 10 streams and orders joined radiance's ladder "
        "after a first look at them without 28 "
        f"(error models and margins: {CALIBRATION} scenes of seed "
        f"{CALIBRATION_SEED}, `python -m tests.acceptance.plan fit`).  Chlorophyll 0.01-30 mg/m3, "
        "CDOM and detritus 0.001-5 /m, sun 0-75 degrees, sky in half, depth 0.5-40 m, floor in "
        f"half; bands 420-630 nm.  Truth: {planning.rung(scenes.REFERENCE)}.  Cost: processor "
        "seconds per scene of the compiled program, over the cheapest rung that keeps the "
        "tolerance; among scenes in which one does (possible).\n",
        "| quantity | tolerance | kept, where promised | promised | kept of all | possible | "
        "cost / cheapest, median (mean) | chosen |",
        "|---|---|---|---|---|---|---|---|",
    ]
    shares = []
    for quantity in QUANTITIES:
        sample = Sample(found, all_cases, quantity)
        for tolerance in TOLERANCES:
            lines.append(_row(sample, all_cases, tolerance))
        batched = found[key_of(quantity), planning.rung(scenes.REFERENCE)][2]
        shares.append(_planning(sample, all_cases, float(batched)))
    lines += _rungs(found, all_cases)
    lines += ["", *shares]
    return "\n".join(lines)


def _rungs(found, all_cases) -> list[str]:
    """What each rung errs by, and costs."""
    lines = [
        "\nWhat each rung errs by on these scenes, median / 95th percentile, and costs:\n",
        "| rung | irradiance | radiance | photograph | ms per scene |",
        "|---|---|---|---|---|",
    ]
    samples = {quantity: Sample(found, all_cases, quantity) for quantity in QUANTITIES}
    for key, ladder in scenes.RUNS.items():
        for name in map(planning.rung, ladder):
            cells = {}
            for quantity, sample in samples.items():
                here = key_of(quantity) == key
                e = sample.true[name] if here else np.zeros(0)
                cells[quantity] = f"{np.median(e):.2g} / {np.quantile(e, 0.95):.2g}" if here else ""
            cost = 1e3 * found[key, name][2]
            lines.append(f"| {name} | {' | '.join(cells.values())} | {cost:.2g} |")
    return lines


def _row(sample: Sample, all_cases, tolerance: float) -> str:
    """What became of the plans at one tolerance."""
    kept, ratio, chosen, promised, possible = [], [], [], [], []
    for i, (this, eye, _) in enumerate(all_cases):
        views = errors.views(this, errors.looks(this, sample.quantity, eye))
        choice = planning.choose(this, tolerance, sample.quantity, views, scenes.channels())
        name = planning.rung(choice[0])
        chosen.append(name)
        promised.append(choice[1] <= tolerance)
        kept.append(sample.true[name][i] <= tolerance)
        good = [sample.cost[n] for n in sample.names if sample.true[n][i] <= tolerance]
        possible.append(bool(good))
        if good:
            ratio.append(sample.cost[name] / min(good))
    kept, promised = np.array(kept), np.array(promised)
    counts = ", ".join(f"{n} {chosen.count(n)}" for n in sample.names if n in chosen)
    where = f"{kept[promised].mean():.3f}" if promised.any() else "-"
    return (
        f"| {sample.quantity} | {100 * tolerance:g} % | {where} | {promised.mean():.3f} | "
        f"{kept.mean():.3f} | {np.mean(possible):.3f} | {np.median(ratio):.2f} "
        f"({np.mean(ratio):.2f}) | {counts} |"
    )


def _planning(sample: Sample, all_cases, batched: float) -> str:
    """Time of whole plans beside the run that they save: of the reference, which would do in every
    scene.  For irradiance one call of the front end, its program compiled before; radiance, of
    which that is a small part, takes `batched` seconds per scene."""
    quantity = sample.quantity
    planned, run = [], []
    for this, eye, _ in all_cases:
        start = time.process_time()
        planning.plan(this, 0.03, quantity, depth=eye)
        planned.append(time.process_time() - start)
        if quantity == "irradiance":
            start = time.process_time()
            depths = np.linspace(0.1, 1.0, 10) * eye
            jax.block_until_ready(oi.irradiance(this, depths, scenes.REFERENCE).Ed.value)
            run.append(time.process_time() - start)
    saved = np.mean(run[1:]) if run else batched
    return (
        f"Planning {quantity} at 3 %: {1e3 * np.mean(planned[1:]):.2g} ms in the mean over all "
        f"scenes, {100 * np.mean(planned[1:]) / saved:.2g} % of a run of "
        f"{planning.rung(scenes.REFERENCE)} ({1e3 * saved:.3g} ms, 4 bands).\n"
    )


def main():
    jax.config.update("jax_enable_x64", True)
    fitting, folders = "fit" in sys.argv[1:], [w for w in sys.argv[1:] if w != "fit"]
    count, seed = (CALIBRATION, CALIBRATION_SEED) if fitting else (TEST, TEST_SEED)
    draws = scenes.draw(count, seed)
    folder = Path(folders[0]) if folders else None
    found, all_cases = collect(draws, f"{count}_{seed}", folder), cases(draws)
    if fitting:
        write(fit(found, all_cases))
        Path(__file__).with_name("plan_calibration.md").write_text(crossed(found, all_cases))
        return
    report = table(found, all_cases)
    print(report)
    Path(__file__).with_suffix(".md").write_text(report + "\n")


if __name__ == "__main__":
    main()
