"""`oceaninv fit-profile`."""

import dataclasses
import itertools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fitting.commands.shared_options import (
    Output,
    Overwrite,
    SolarZenith,
    Tolerance,
    check_outputs,
    known_values,
    noting,
    preload,
    print_doubt,
    print_water,
    status,
    transport_class,
    with_endings,
)
from oceaninv.foundation.provenance import current, record_inputs

if TYPE_CHECKING:
    from fitting.core.result import Fit
    from fitting.files.cast_file import Reading
    from fitting.observations.profile import Profile
    from fitting.profile.archive import Task
    from fitting.profile.kd.smooth_kd import SmoothKd

# Those that are the same for every water and cheap enough to fit with.
_TRANSPORTS = ("two-stream", "four-stream", "plane-parallel")


def fit_profile_command(
    paths: Annotated[
        list[Path], typer.Argument(help="csv, SeaBASS or netCDF (BGC-Argo) with Ed; one or many.")
    ],
    output: Output = None,
    low: Annotated[
        float | None,
        typer.Option(
            "--from", help="Shallowest depth, m.", rich_help_panel="How to read the files"
        ),
    ] = None,
    high: Annotated[
        float | None,
        typer.Option("--to", help="Deepest depth, m.", rich_help_panel="How to read the files"),
    ] = None,
    solar_zenith: SolarZenith = None,
    layers: Annotated[
        str,
        typer.Option(
            help="Layers of constant Kd: a number, or auto to let the data choose; with "
            "--constituents, of these too (plane-parallel).",
            rich_help_panel="Model",
        ),
    ] = "1",
    kd_only: Annotated[
        bool | None,
        typer.Option(
            "--kd-only/--constituents",
            help="Fit Kd alone, or constituents too.  [default: constituents of one cast, Kd alone "
            "of many]",
            show_default=False,
            rich_help_panel="Model",
        ),
    ] = None,
    merge: Annotated[
        bool,
        typer.Option(
            help="All casts given are of one station: fit them as one.",
            rich_help_panel="How to read the files",
        ),
    ] = False,
    table: Annotated[
        Path | None,
        typer.Option(
            help="Also write the spectra as TABLE.csv or TABLE.sb (SeaBASS).",
            rich_help_panel="Output",
        ),
    ] = None,
    transport: Annotated[
        str | None,
        typer.Option(
            help=f"Model of the light for constituents: {', '.join(_TRANSPORTS)}; "
            "two-stream if neither it nor a tolerance is given.",
            rich_help_panel="Model",
        ),
    ] = None,
    tolerance: Tolerance = None,
    know: Annotated[
        list[str] | None,
        typer.Option(
            help="What is known, as cdom=0.12+-0.01; repeatable.", rich_help_panel="Model"
        ),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            help="Unit of Ed where the file states none: 'uW cm-2 nm-1'.",
            rich_help_panel="How to read the files",
        ),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(
            help="The file's columns by ours: depth=z,Ed_490=irr.",
            rich_help_panel="How to read the files",
        ),
    ] = None,
    depth_offset: Annotated[
        float,
        typer.Option(
            help="Metres from pressure sensor down to the sensor of Ed.",
            rich_help_panel="How to read the files",
        ),
    ] = 0.0,
    upward_offset: Annotated[
        float | None,
        typer.Option(
            help="The same to the sensors of Eu and Lu, if it differs.",
            rich_help_panel="How to read the files",
        ),
    ] = None,
    tilt_limit: Annotated[
        float | None,
        typer.Option(
            help="Leave out samples tilted further, degrees.",
            rich_help_panel="How to read the files",
        ),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(help="Address of a dask scheduler, for archives.", rich_help_panel="Output"),
    ] = None,
    smooth: Annotated[
        bool,
        typer.Option(
            "--smooth",
            help="Also Kd(z) without layers: group smooth of STEM.nc.",
            rich_help_panel="Model",
        ),
    ] = False,
    sample: Annotated[
        bool,
        typer.Option(
            help="Draw constituents from the posterior (NUTS; minutes, needs blackjax).",
            rich_help_panel="Model",
        ),
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Fit Kd of every band and the constituents of the water to depth profiles of Ed.

    Eu, Lu and PAR are fitted where a file has them.  Of many files, or a file of many casts, -o
    names the folder of results.
    """
    reading = _reading(solar_zenith, unit, columns, depth_offset, upward_offset, tilt_limit)
    wanted = _wanted(low, high, layers, kd_only, transport, tolerance, know, smooth, sample)
    profile = _one_profile(paths, reading, merge, cluster)
    if profile is None:
        _fit_many(paths, _archive_task(wanted, reading, output, table, overwrite, paths), cluster)
        return
    files = with_endings(output or Path(f"{paths[0].stem}_fit"), ".nc", ".png")
    files += [] if table is None else [table]
    check_outputs(files, paths, overwrite)
    record_inputs(paths)
    _fit_one(profile, wanted, files, overwrite)


def fit_archive_again(options: Mapping[str, Any], arguments: tuple[str, ...]) -> None:
    """Fit files of an archive as `fit_profile_command` with these `options` by their names does,
    and let each result name `arguments`; also of one file, which that would not take for an
    archive."""
    reading = _reading(
        *(options[name] for name in (
            "solar_zenith", "unit", "columns", "depth_offset", "upward_offset", "tilt_limit"
        ))
    )  # fmt: skip
    wanted = _wanted(
        *(options[name] for name in (
            "low", "high", "layers", "kd_only", "transport", "tolerance", "know", "smooth", "sample"
        ))
    )  # fmt: skip
    paths = list(options["paths"])
    task = _archive_task(
        wanted, reading, options["output"], options["table"], options["overwrite"], paths
    )
    _fit_many(paths, dataclasses.replace(task, arguments=arguments), None)


def _reading(solar_zenith, unit, columns, depth_offset, upward_offset, tilt_limit) -> "Reading":
    """How to read the files, from options of these names."""
    from fitting.files.cast_file import Reading

    units: dict[str, str] = {}
    if unit is not None:
        units = dict.fromkeys(("Ed", "Eu", "Lu", "surface"), unit)
    return Reading(solar_zenith, units, _columns(columns), depth_offset, upward_offset, tilt_limit)


def _wanted(low, high, layers, kd_only, transport, tolerance, know, smooth, sample) -> "_Wanted":
    """What to fit, from options of these names."""
    depth_range = None
    if low is not None or high is not None:
        depth_range = (low or 0.0, 1e5 if high is None else high)
    count, priors = _layers(layers), _priors(know or [])
    return _Wanted(depth_range, count, kd_only, transport, tolerance, priors, smooth, sample)


@dataclasses.dataclass(frozen=True)
class _Wanted:
    """What the options ask for; ValueError where they contradict each other.

    `kd_only`: None leaves it open: constituents of one cast, Kd alone of many.
    """

    depth_range: tuple[float, float] | None
    layers: int | None
    kd_only: bool | None
    transport: str | None
    tolerance: float | None
    priors: dict
    smooth: bool
    sample: bool

    def __post_init__(self):
        if self.transport is not None and self.tolerance is not None:
            raise ValueError("--tolerance chooses the transport: leave out it or --transport.")
        if self.sample and self.kd_only:
            raise ValueError("--sample draws constituents: leave out it or --kd-only.")
        self.named(self.transport)

    @staticmethod
    def named(name: str | None):
        """The transport of that name, two-stream by default."""
        return transport_class(name or "two-stream", _TRANSPORTS)()

    def model(self) -> dict:
        """Arguments of `fit_profile` for the constituents of one cast."""
        if self.tolerance is not None:
            return {"tolerance": self.tolerance}
        # Layers asked for together with constituents are layers of these.
        layered = self.kd_only is False and self.layers != 1
        name = self.transport or ("plane-parallel" if layered else None)
        return {"transport": self.named(name), **({"layers": self.layers} if layered else {})}


def _one_profile(
    paths: list[Path], reading: "Reading", merge: bool, cluster: str | None
) -> "Profile | None":
    """The one cast in the files, or all of them merged; None for an archive."""
    from fitting.files.cast_file import profile_of, raw_casts

    if not merge and (len(paths) > 1 or cluster is not None):
        return None
    casts = [cast for path in paths for cast in raw_casts(path, reading)]
    if len(casts) == 1:
        return profile_of(casts[0], reading)
    if not merge:
        return None
    from fitting.profile.merge_casts import merged

    return merged([profile_of(cast, reading) for cast in casts])


def _archive_task(
    wanted: _Wanted,
    reading: "Reading",
    output: Path | None,
    table: Path | None,
    overwrite: bool,
    paths: list[Path],
) -> "Task":
    from fitting.profile.archive import Task

    if table is not None:
        raise ValueError("--table is for one cast; archives are written as netCDF.")
    if wanted.sample or wanted.smooth:
        raise ValueError("--sample and --smooth are for one cast.")
    if wanted.tolerance is not None and wanted.kd_only is False:
        raise ValueError("--tolerance is for one cast; name a --transport for archives.")
    water = wanted.named(wanted.transport) if wanted.kd_only is False else None
    if wanted.priors and water is None:
        raise ValueError("--know applies to constituents: add --constituents.")
    return Task(
        output or Path("kd"),
        reading,
        wanted.depth_range,
        wanted.layers,
        water,
        wanted.priors or None,
        overwrite,
        _arguments_that_count(paths),
    )


def _arguments_that_count(paths: list[Path]) -> tuple[str, ...] | None:
    """The arguments of the command but for files, folder and workers: numbers do not depend on
    these."""
    given = current().arguments
    if given is None:
        return None
    kept, words = [], iter(given)
    for word in words:
        if word in ("-o", "--output", "--cluster"):
            next(words, None)
        elif not (re.match("-o|--output=|--cluster=|--overwrite$", word) or Path(word) in paths):
            kept.append(word)
    return tuple(kept)


def _fit_one(profile: "Profile", wanted: _Wanted, files: list[Path], overwrite: bool) -> None:
    """`files`: the netCDF file, the picture and, if wanted, the table to write.

    What one step finds is written even where the next one fails.
    """
    from fitting import fit_profile
    from fitting.report.netcdf_file import save
    from fitting.report.picture import picture

    depth_range = wanted.depth_range
    if depth_range is not None and depth_range[1] > profile.depth.max():
        depth_range = (depth_range[0], float(profile.depth.max()))
    preload()
    with status("fitting Kd"):
        fit = fit_profile(profile, depth_range=depth_range, layers=wanted.layers)
    failures: list[str] = []
    constituents = None if wanted.kd_only else _constituents(profile, wanted, depth_range, failures)
    smooth = _smooth(profile, depth_range, failures) if wanted.smooth else None
    print_doubt(fit, constituents)
    _print_kd(fit)
    if constituents is not None:
        print_water(constituents)
    if smooth is not None:
        layers = len(smooth.interfaces) + 1
        print(f"smooth Kd(z): e^{smooth.evidence:+.1f} times as likely as {layers} layer(s)")
    data, image, *table = files
    save(data, fit, constituents, smooth, overwrite=overwrite)
    picture(fit, image, constituents, overwrite=overwrite)
    for path in table:
        from fitting.report.spectra_table import write_spectra

        write_spectra(path, fit, constituents, overwrite=overwrite)
    print(f"wrote {' and '.join(map(str, files))}")
    if failures:
        raise ValueError("; ".join(failures))


def _constituents(profile: "Profile", wanted: _Wanted, depth_range, failures) -> "Fit | None":
    from fitting import fit_profile
    from fitting import sample as draw

    found = None
    message = "fitting constituents (the first run compiles)"
    with status(message), noting(failures, "constituents"):
        options = {"depth_range": depth_range, "priors": wanted.priors}
        found = fit_profile(profile, **options, **wanted.model())
    if found is not None and wanted.sample:
        with status("sampling the posterior (minutes)"), noting(failures, "the posterior"):
            found = draw(found)
    return found


def _smooth(profile: "Profile", depth_range, failures) -> "SmoothKd | None":
    from fitting import smooth_kd

    found = None
    with status("fitting a smooth Kd(z)"), noting(failures, "a smooth Kd(z)"):
        found = smooth_kd(profile, depth_range)
    return found


def _fit_many(paths: list[Path], task: "Task", cluster: str | None) -> None:
    import sys

    from rich.console import Console
    from rich.progress import Progress

    from fitting.profile.archive import fit_archive

    failed = casts = resumed = 0
    with Progress(console=Console(stderr=True)) as progress:
        bar = progress.add_task("fitting", total=len(paths))
        for outcome in fit_archive(paths, task, cluster):
            progress.advance(bar)
            casts, resumed = casts + outcome.casts, resumed + outcome.resumed
            failed += bool(outcome.problems)
            for sentence in outcome.problems:
                print(f"oceaninv: {sentence}", file=sys.stderr)
    print(f"{casts} casts of {len(paths)} files; {resumed} files were done before")
    print(f"results are in {task.folder}")
    if failed:
        raise ValueError(
            f"{failed} of {len(paths)} files could not be used in full; the rest is done."
        )


def _columns(text: str | None) -> dict[str, str]:
    pairs = [pair.partition("=") for pair in (text or "").split(",") if pair]
    for ours, _, theirs in pairs:
        if not (ours and theirs):
            raise ValueError(f"--columns is {text!r}; write ours=theirs, as depth=z,Ed_490=irr.")
    return {ours.strip(): theirs.strip() for ours, _, theirs in pairs}


def _priors(texts: list[str]) -> dict:
    """Priors from "cdom=0.12+-0.01"."""
    from fitting.core.parameters import Parameter
    from fitting.water_model.unknowns import constituents
    from oceaninv.foundation.tables import unknown

    known = {p.name: p for p in constituents()}
    # Of layers, as cdom_2; the fit answers for layers that it does not have.
    of_layers = {f"{p.name}_{i}": p for i in range(1, 10) for p in constituents()}
    priors = {}
    for name, (value, sd) in known_values(texts).items():
        if name not in known and name not in of_layers:
            raise unknown("constituent", name, sorted(known))
        # The coordinate is a logarithm: its spread is the relative one.
        priors[name] = Parameter(name, value, sd / value, unit=(known | of_layers)[name].unit)
    return priors


def _layers(text: str) -> int | None:
    if text == "auto":
        return None
    if not text.isdigit():
        raise ValueError(f"--layers is {text!r}; write a number or auto.")
    return int(text)


def _print_kd(fit: "Fit") -> None:
    from rich.console import Console
    from rich.table import Table

    kd = fit.quantities["Kd"]
    low, high = kd.interval(0.95, fit.dof)
    table = Table(title=f"Kd, {fit.metadata['kd_definition']}", title_justify="left")
    for name in ("nm", "Kd (1/m)", "95 % interval", "noise", "depths", "down to (m)"):
        table.add_column(name, justify="right")
    noise = fit.metadata["relative_noise"]
    for i, wavelength in enumerate(fit.wavelength):
        scatter = "given" if noise == "given" else f"{100 * noise[i]:.1f} %"
        table.add_row(
            f"{wavelength:g}",
            *_shown_kd(kd.value[i], kd.sd[i], low[i], high[i]),
            scatter,
            str(fit.metadata["depths_used"][i]),
            f"{fit.metadata['deepest_used_m'][i]:.1f}",
        )
    Console().print(table)
    if fit.metadata["interfaces_m"]:
        _print_layers(fit)
    _print_surface(fit)
    ways = fit.metadata["ways_down_and_up"]
    if ways > 1:
        print(f"the cast went down or up {ways} times: each way was fitted, then combined")
    for reason, number in fit.metadata["left_out"].items():
        print(f"{reason}: {number}")
    print(f"self-shading, immersion: {fit.metadata['self_shading_and_immersion']}")
    print(f"search: {fit.result}")


def _shown_kd(value: float, sd: float, low: float, high: float) -> tuple[str, str]:
    """Kd and its interval as text; no bare number where the data do not fix it."""
    if not sd <= 0.5:
        return "not identifiable", ""
    return f"{value:.4g}", f"{low:.4g} - {high:.4g}"


def _print_surface(fit: "Fit") -> None:
    """Upward light and PAR, where there is any."""
    from rich.console import Console
    from rich.table import Table

    named = [name for name in ("Ku", "KLu", "R", "Rrs", "nLw") if name in fit.quantities]
    if named:
        table = Table(title="Upward light, with 95 % intervals", title_justify="left")
        table.add_column("nm", justify="right")
        for name in named:
            table.add_column(f"{name} ({fit.quantities[name].unit})", justify="right")
        ends = [(fit.quantities[n].sd, *fit.quantities[n].interval()) for n in named]
        for i, wavelength in enumerate(fit.wavelength):
            spans = [_shown_kd(1.0, sds[i], low[i], high[i])[1] for sds, low, high in ends]
            table.add_row(f"{wavelength:g}", *spans)
        Console().print(table)
    for name in ("PAR_0", "Z_10", "Z_eu"):
        if name in fit.quantities:
            quantity = fit.quantities[name]
            low, high = quantity.interval()
            value = f"{float(quantity.value):.3g} {quantity.unit} ({low:.3g} - {high:.3g})"
            print(f"{name}: {value}, {quantity.long_name}")


def _print_layers(fit: "Fit") -> None:
    from rich.console import Console
    from rich.table import Table

    edges = [0.0, *fit.metadata["interfaces_m"], max(fit.metadata["deepest_used_m"])]
    table = Table(title="Kd (1/m) by layer, with 95 % intervals", title_justify="left")
    table.add_column("nm", justify="right")
    for top, bottom in itertools.pairwise(edges):
        table.add_column(f"{top:.3g} - {bottom:.3g} m", justify="right")
    for wavelength in fit.wavelength:
        layers = [n for n in fit.numbers() if n.wavelength == wavelength]
        table.add_row(f"{wavelength:g}", *(number.interval_text for number in layers))
    Console().print(table)
