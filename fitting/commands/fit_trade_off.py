"""What a fit loses when its model of the light is cheapened, and what that saves."""

import csv
import dataclasses
import io
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import oceaninv as oi
from fitting.core.result import Fit
from fitting.observations.profile import Profile
from fitting.profile.fit_profile import fit_profile
from oceaninv.fidelity.planning import model_label
from oceaninv.foundation import provenance
from oceaninv.foundation.atomic_write import atomic_write, checksum_line, with_checksum
from oceaninv.foundation.figure_file import save_figure

TRANSPORTS = (oi.TwoStream(), oi.FourStream(), *(oi.PlaneParallel(n, 1) for n in (4, 8, 16)))
TOLERANCES = (0.1, 0.03)


@dataclasses.dataclass(frozen=True)
class FitRow:
    """One model of the light: constituents with their 95 % intervals.

    `shift`: of their coordinates from those of the most expensive model, in its standard
    deviations; `seconds`: processor time per fit; `share`: of that model's.
    """

    model: str
    seconds: float
    share: float
    value: Mapping[str, float]
    low: Mapping[str, float]
    high: Mapping[str, float]
    shift: Mapping[str, float]


def measure_fits(profile: Profile, repeats: int = 3) -> list[FitRow]:
    """Fits through every transport and at tolerances of 10 and 3 %; the last transport is the
    reference, with which the others are compared."""
    ways = [(model_label(t), {"transport": t}) for t in TRANSPORTS]
    ways += [(f"tolerance {100 * t:g} %", {"tolerance": t}) for t in TOLERANCES]
    found = [(name, *_timed(profile, way, repeats)) for name, way in ways]
    _, best, reference = found[len(TRANSPORTS) - 1]
    return [_row(name, fit, seconds, best, reference) for name, fit, seconds in found]


def _timed(profile: Profile, way: dict, repeats: int) -> tuple[Fit, float]:
    fit = fit_profile(profile, **way)  # compiles
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        fit = fit_profile(profile, **way)
        seconds.append(time.process_time() - start)
    return fit, float(np.median(seconds))


def _row(name: str, fit: Fit, seconds: float, best: Fit, reference: float) -> FitRow:
    asked = [p.name for p in fit.parameters if not p.nuisance]
    at = {n: fit.parameters.names.index(n) for n in asked}
    ends = {n: fit.interval(n) for n in asked}
    if fit.plan is not None:
        name = f"{name}: {fit.plan.transport}"
    return FitRow(
        name,
        seconds,
        seconds / reference,
        {n: fit.value[n] for n in asked},
        {n: ends[n][0] for n in asked},
        {n: ends[n][1] for n in asked},
        {n: abs(fit.x[i] - best.x[i]) / best.sd[n] for n, i in at.items()},
    )


def save_fits(path: Path, rows: list[FitRow], *, overwrite: bool = False) -> None:
    """The rows as csv."""
    names = list(rows[0].value)
    file = io.StringIO()
    file.writelines(f"# {line}\n" for line in [checksum_line(), *provenance.current().lines])
    writer = csv.writer(file, lineterminator="\n")
    parts = ("", "_low", "_high", "_shift_sd")
    heads = [f"{name}{part}" for name in names for part in parts]
    writer.writerow(("model", "seconds", "share_of_reference", *heads))
    for row in rows:
        cells = [
            f"{kind[name]:.4g}"
            for name in names
            for kind in (row.value, row.low, row.high, row.shift)
        ]
        writer.writerow((row.model, f"{row.seconds:.3g}", f"{row.share:.3g}", *cells))
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_text(with_checksum(file.getvalue()))


def draw_fits(path: Path, rows: list[FitRow], title: str, *, overwrite: bool = False) -> None:
    """Estimates and intervals against the processor time of a fit."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(rows[0].value)
    figure = Figure(figsize=(3.4 * len(names), 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = np.atleast_1d(figure.subplots(1, len(names)))
    for axes, name in zip(panels, names, strict=True):
        for i, row in enumerate(rows):
            middle, low, high = (kind[name] for kind in (row.value, row.low, row.high))
            axes.errorbar(
                row.seconds, middle, [[middle - low], [high - middle]], fmt="o", ms=5,
                color=f"C{i}", label=row.model,
            )  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="processor seconds", title=name)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", fontsize=7, ncol=2
    )
    figure.suptitle(title, fontsize=9)
    save_figure(figure, path, dpi=130, overwrite=overwrite)
