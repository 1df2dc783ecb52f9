"""Error against processor time of every candidate model of a scene."""

import csv
import dataclasses
import io
import re
import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from oceaninv.fidelity.candidate_models import CandidateModel, candidate_models, references
from oceaninv.foundation import provenance
from oceaninv.foundation.atomic_write import atomic_write, checksum_line, with_checksum
from oceaninv.foundation.figure_file import save_figure
from oceaninv.scene.camera import Camera
from oceaninv.scene.scene import Scene
from oceaninv.water.attenuation import kd_lee2005
from oceaninv.water.iops import IOPs

RAYS, DEPTHS = 48, 10
LONGEST = 20.0  # processor seconds after which a model is not run again


@dataclasses.dataclass(frozen=True)
class Row:
    """One model: processor `seconds` per run, without compilation; `error` as `oceaninv.plan`
    defines it; `best`: no other model is both faster and more accurate."""

    model: str
    seconds: float
    compile_seconds: float
    error: float
    best: bool = False


@dataclasses.dataclass(frozen=True)
class Trade:
    """Rows of one scene, fastest first, and the estimated error of the reference."""

    title: str
    quantity: str
    reference: str
    reference_error: float
    rows: tuple[Row, ...]

    @property
    def doubt(self) -> float:
        """The former name of `reference_error`."""
        warnings.warn("doubt is now reference_error.", DeprecationWarning, stacklevel=2)
        return self.reference_error


def measure(
    scene: Scene, camera: Camera, quantity: str = "photograph", repeats: int = 7, title=""
) -> Trade:
    """Measure every candidate model on one scene.

    Water, light, surface, floor and inelastic light are kept; objects and lamps are left out.  The
    reference is PlaneParallel with 28 streams; its error is the difference from 22 streams.
    """
    if quantity not in ("irradiance", "radiance", "photograph"):
        raise ValueError(f"quantity is {quantity!r}; choose from irradiance, radiance, photograph.")
    scene = dataclasses.replace(scene, objects=(), lamps=())
    benchmark = _Benchmark(scene, camera, quantity)
    first, second = references(scene, quantity)
    truth, *_ = benchmark.run(first, 0)
    reference_error = benchmark.error(benchmark.run(second, 0)[0], truth)
    rows = []
    for model in candidate_models(scene, quantity):
        try:
            value, seconds, compiled = benchmark.run(model, repeats)
        except ValueError:  # a model that does not solve this scene
            continue
        error = benchmark.error(np.asarray(value, float), truth, model.pick)
        rows.append(Row(model.name, seconds, compiled, error))
    return Trade(title, quantity, first.name, reference_error, _pareto_front(rows))


def _pareto_front(rows: list[Row]) -> tuple[Row, ...]:
    """The rows, fastest first; `best` marks those that no other beats in both time and error."""
    front, least = [], np.inf
    for row in sorted(rows, key=lambda row: (row.seconds, row.error)):
        front.append(dataclasses.replace(row, best=row.error < least))
        least = min(least, row.error)
    return tuple(front)


class _Benchmark:
    """Runs models on a sample of the scene's rays or depths and compares their results."""

    def __init__(self, scene: Scene, camera: Camera, quantity: str):
        self.scene, self.quantity, self.response = scene, quantity, camera.response
        rays = camera.rays()
        pick = np.unique(np.linspace(0, len(rays.origin) - 1, RAYS).round().astype(int))
        self.origin, self.direction = rays.origin[pick], rays.direction[pick]
        water = scene.water if isinstance(scene.water, IOPs) else scene.water.iops[0]
        kd = kd_lee2005(water.a, water.bb, scene.light.zenith)
        deepest = float(jnp.max(4.6 / kd))
        if scene.floor is not None:
            deepest = min(deepest, float(scene.floor.depth))
        self.depths = jnp.linspace(0.1, 1.0, DEPTHS) * deepest

    def run(self, model: CandidateModel, repeats: int):
        """Value, median processor seconds of `repeats` runs (fewer where runs are long), and
        processor seconds of compilation."""

        def cast(leaf):
            floating = jnp.issubdtype(leaf.dtype, jnp.inexact)
            return leaf.astype(model.precision) if floating else leaf

        scene, *points = jax.tree.map(cast, (self.scene, self.origin, self.direction, self.depths))
        # Phase functions are constants of the program, as in a fit; everything else is an argument.
        varied, fixed = eqx.partition(scene, _all_but_phases(scene))

        def answer(varied, origin, direction, depths):
            return model.answer(eqx.combine(varied, fixed), origin, direction, depths)

        program, compiled = _compiled(jax.jit(answer).lower(varied, *points))
        value = program(varied, *points)
        seconds = []
        for _ in range(repeats):
            start = time.process_time()
            value = jax.block_until_ready(program(varied, *points))
            seconds.append(time.process_time() - start)
            if sum(seconds) > LONGEST:
                break
        return np.asarray(value), float(np.median(seconds or [np.nan])), compiled

    def error(self, value: np.ndarray, truth: np.ndarray, pick=None) -> float:
        """The error as `oceaninv.plan` defines it; `pick`: the bands that were computed."""
        if self.quantity == "photograph":
            bands = self.scene.wavelength
            weights = np.asarray(self.response.weights(bands))
            thin = weights if pick is None else self.response.weights(bands[list(pick)])
            seen, true = value @ np.asarray(thin).T, truth @ weights.T
            return float(np.max(np.sqrt(np.mean((seen - true) ** 2, axis=0)) / true.mean(axis=0)))
        truth = truth if pick is None else truth[:, list(pick)]
        lit = truth > 0.01 * truth.max(axis=0)
        relative = np.abs(value[lit] / truth[lit] - 1.0)
        if self.quantity == "irradiance":
            return float(relative.max())
        return float(np.quantile(relative, 0.95))


def _all_but_phases(scene: Scene):
    def phases(scene):
        waters = (scene.water,) if isinstance(scene.water, IOPs) else scene.water.iops
        return [water.phases for water in waters]

    return eqx.tree_at(
        phases,
        jax.tree.map(lambda _: True, scene),
        replace_fn=lambda found: jax.tree.map(lambda _: False, found),
    )


_PROGRAMS: dict[str, tuple] = {}


def _compiled(lowered) -> tuple:
    """The program and its seconds of compilation; scenes of the same structure share one."""
    text = lowered.as_text()
    if text not in _PROGRAMS:
        start = time.process_time()
        program = lowered.compile()
        _PROGRAMS[text] = (program, time.process_time() - start)
    return _PROGRAMS[text]


def how_to_choose(trades: list[Trade], tolerances=(0.3, 0.1, 0.03, 0.01)) -> str:
    """A table by scene: the model that keeps each tolerance in the least processor time."""
    head = " | ".join(f"{100 * t:g} %" for t in tolerances)
    lines = [
        f"| scene | quantity | {head} | reference's own error |",
        "|---|---|" + "---|" * (len(tolerances) + 1),
    ]
    for trade in trades:
        cells = []
        for tolerance in tolerances:
            good = [row for row in trade.rows if row.error <= tolerance]
            fast = min(good, key=lambda row: row.seconds, default=None)
            cells.append("none" if fast is None else f"{fast.model}, {1e3 * fast.seconds:.2g} ms")
        lines.append(
            f"| {trade.title} | {trade.quantity} | {' | '.join(cells)} | "
            f"{100 * trade.reference_error:.2g} % |"
        )
    return "\n".join(lines) + "\n"


def save_rows(path: Path, trade: Trade, *, overwrite: bool = False) -> None:
    """Write the rows as csv."""
    file = io.StringIO()
    file.write(
        f"# {trade.title}: {trade.quantity}; error of the reference {trade.reference} itself: "
        f"{trade.reference_error:.2g}\n# {checksum_line()}\n"
    )
    file.writelines(f"# {line}\n" for line in provenance.current().lines)
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(("model", "seconds", "compile_seconds", "error", "best"))
    for row in trade.rows:
        numbers = (f"{v:.3g}" for v in (row.seconds, row.compile_seconds, row.error))
        writer.writerow((row.model, *numbers, int(row.best)))
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_text(with_checksum(file.getvalue()))


def load_rows(path: Path) -> Trade:
    """Read what `save_rows` wrote."""
    head, *lines = path.read_text().splitlines()
    title, quantity, reference, reference_error = _HEAD.fullmatch(head).groups()  # pyright: ignore
    rows = tuple(
        Row(
            row["model"],
            float(row["seconds"]),
            float(row["compile_seconds"]),
            float(row["error"]),
            row["best"] == "1",
        )
        for row in csv.DictReader(line for line in lines if not line.startswith("#"))
    )
    return Trade(title, quantity, reference, float(reference_error), rows)


_HEAD = re.compile(r"# (.*): (\w+); error of the reference (.*) itself: (.*)")


def draw_rows(path: Path, trade: Trade, *, overwrite: bool = False) -> None:
    """Draw error against time, log-log; models that another beats in both are grey."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    rows = trade.rows
    best = [row for row in rows if row.best]
    axes.plot([r.seconds for r in best], [r.error for r in best], "-", lw=1.0, color="tab:blue")
    for i, row in enumerate(rows):
        colour = "tab:blue" if row.best else "0.7"
        axes.plot(row.seconds, row.error, "o", ms=6, color=colour)
        axes.annotate(
            row.model,
            (row.seconds, row.error),
            xytext=(5, (3, -9, 13, -19)[i % 4]),  # neighbours often have similar errors
            textcoords="offset points",
            fontsize=7,
            color="0.2" if row.best else "0.6",
        )
    axes.axhspan(0.0, max(trade.reference_error, 1e-12), color="0.9", zorder=0)
    axes.margins(x=0.15)
    axes.set(xscale="log", yscale="log", xlabel="processor seconds per run", ylabel="error")
    title = f"{trade.title}: {trade.quantity}"
    axes.set_title(f"{title} (grey band: the reference's own error)", fontsize=10)
    save_figure(figure, path, dpi=130, overwrite=overwrite)
