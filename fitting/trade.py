"""Error against time: every rung of the ladder on one scene."""

import csv
import dataclasses
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from fitting.report import whole
from oceaninv.iops import IOPs
from oceaninv.transport.base import AbstractTransport

RAYS, DEPTHS = 48, 10
REFERENCE, SECOND = oi.PlaneParallel(28), oi.PlaneParallel(22)
STREAMS = (4, 8, 12, 16)


@dataclasses.dataclass(frozen=True)
class Row:
    """One model: `seconds` per run, compilation apart; `error` as `oceaninv.plan` defines it."""

    model: str
    seconds: float
    compile_seconds: float
    error: float
    best: bool = False


def measure(
    scene: oi.Scene, camera: oi.Camera, quantity: str = "photograph", repeats: int = 7
) -> tuple[list[Row], float]:
    """Rows of the ladder, cheapest first, and the error of the reference itself.

    Water, light, surface and floor only: things, lamps and inelastic light are left out.  The
    reference is PlaneParallel with 28 streams and its error the difference to 22.  `best`: no other
    model is both faster and better.
    """
    if quantity not in ("irradiance", "radiance", "photograph"):
        raise ValueError(f"quantity is {quantity!r}; choose from irradiance, radiance, photograph.")
    scene = oi.Scene(scene.water, scene.light, scene.surface, scene.floor)
    judge = _Judge(scene, camera, quantity)
    truth, *_ = judge.run(REFERENCE, 1)
    doubt = judge.error(judge.run(SECOND, 1)[0], truth)
    rows = []
    for transport in _ladder(quantity):
        for precision in ("float64", "float32"):
            try:
                value, seconds, compiled = judge.run(transport, repeats, precision)
            except ValueError:  # a closed form that does not solve this scene
                break
            error = judge.error(np.asarray(value, float), truth)
            rows.append(Row(f"{_name(transport)}, {precision}", seconds, compiled, error))
    rows.sort(key=lambda row: row.seconds)
    front, least = [], np.inf
    for row in rows:
        front.append(dataclasses.replace(row, best=row.error < least))
        least = min(least, row.error)
    return front, doubt


def _ladder(quantity: str) -> list[AbstractTransport]:
    plane = [
        oi.PlaneParallel(n, orders)
        for n in STREAMS
        for orders in ((1,) if quantity == "irradiance" else (n // 2, n))
    ]
    return [oi.KdTransport(), oi.TwoStream(), oi.FourStream(), *plane]


def _name(transport: AbstractTransport) -> str:
    if isinstance(transport, oi.PlaneParallel):
        return f"PlaneParallel({transport.streams}, {transport.orders})"
    return type(transport).__name__


class _Judge:
    """Runs a transport on the scene's sample of rays or depths."""

    def __init__(self, scene: oi.Scene, camera: oi.Camera, quantity: str):
        self.scene, self.quantity = scene, quantity
        rays = camera.rays()
        pick = np.unique(np.linspace(0, len(rays.origin) - 1, RAYS).round().astype(int))
        self.origin, self.direction = rays.origin[pick], rays.direction[pick]
        self.weights = np.asarray(camera.response.weights(scene.wavelength))
        water = scene.water if isinstance(scene.water, IOPs) else scene.water.iops[0]
        kd = oi.attenuation.kd_lee2005(water.a, water.bb, scene.light.zenith)
        deepest = float(jnp.max(4.6 / kd))
        if scene.floor is not None:
            deepest = min(deepest, float(scene.floor.depth))
        self.depths = jnp.linspace(0.1, 1.0, DEPTHS) * deepest

    def run(self, transport: AbstractTransport, repeats: int, precision: str = "float64"):
        """Value, median seconds and seconds of compilation."""

        def cast(leaf):
            return leaf.astype(precision) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf

        scene, *points = jax.tree.map(cast, (self.scene, self.origin, self.direction, self.depths))
        # Phase functions stay constants, as they are in a fit; all else is an argument.
        waters = (
            (lambda s: s.water.phases)
            if isinstance(scene.water, IOPs)
            else (lambda s: [w.phases for w in s.water.iops])
        )
        spec = eqx.tree_at(
            waters,
            jax.tree.map(lambda _: True, scene),
            replace_fn=lambda phases: jax.tree.map(lambda _: False, phases),
        )
        varied, fixed = eqx.partition(scene, spec)

        def answer(varied, origin, direction, depths):
            this = eqx.combine(varied, fixed)
            if self.quantity == "irradiance":
                return oi.irradiance(this, depths, transport).Ed.value
            return oi.radiance(this, oi.Rays(origin, direction), transport).value

        start = time.perf_counter()
        program = jax.jit(answer).lower(varied, *points).compile()
        compiled = time.perf_counter() - start
        value = program(varied, *points)
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            value = jax.block_until_ready(program(varied, *points))
            seconds.append(time.perf_counter() - start)
        return np.asarray(value), float(np.median(seconds)), compiled

    def error(self, value: np.ndarray, truth: np.ndarray) -> float:
        if self.quantity == "photograph":
            seen, true = value @ self.weights.T, truth @ self.weights.T
            return float(np.max(np.sqrt(np.mean((seen - true) ** 2, axis=0)) / true.mean(axis=0)))
        lit = truth > 0.01 * truth.max(axis=0)
        relative = np.abs(value[lit] / truth[lit] - 1.0)
        if self.quantity == "irradiance":
            return float(relative.max())
        return float(np.quantile(relative, 0.95))


def save_rows(path: Path, rows: list[Row], doubt: float, quantity: str) -> None:
    """The rows as csv."""
    with whole(path) as temporary, temporary.open("w", newline="") as file:
        file.write(f"# {quantity}; error of the reference {REFERENCE!r} itself: {doubt:.2g}\n")
        writer = csv.writer(file)
        writer.writerow(("model", "seconds", "compile_seconds", "error", "best"))
        for row in rows:
            numbers = (f"{v:.3g}" for v in (row.seconds, row.compile_seconds, row.error))
            writer.writerow((row.model, *numbers, int(row.best)))


def draw_rows(path: Path, rows: list[Row], doubt: float, title: str) -> None:
    """Error against time, log-log; models that another beats in both are grey."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    best = [row for row in rows if row.best]
    axes.plot([r.seconds for r in best], [r.error for r in best], "-", lw=1.0, color="tab:blue")
    for row in rows:
        colour = "tab:blue" if row.best else "0.7"
        axes.plot(row.seconds, row.error, "o", ms=6, color=colour)
        axes.annotate(
            row.model,
            (row.seconds, row.error),
            xytext=(5, 3),
            textcoords="offset points",
            fontsize=7,
            color="0.2" if row.best else "0.6",
        )
    axes.axhspan(0.0, max(doubt, 1e-12), color="0.9", zorder=0)
    axes.set(xscale="log", yscale="log", xlabel="seconds per run", ylabel="error")
    axes.set_title(f"{title} (grey band: the reference's own error)", fontsize=10)
    with whole(path) as temporary:
        figure.savefig(temporary, dpi=130)
