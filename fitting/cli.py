"""The command `oceaninv`."""

import itertools
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fitting.posterior import Fit

INPUT_ERROR = 3

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Water constituents from underwater light, with honest intervals.",
)


@app.callback()
def _commands() -> None:
    """Water constituents from underwater light, with honest intervals."""


def quick_compilation() -> None:
    """Halve compile times on a CPU; must come before JAX starts its backend.

    A fit runs once for a tenth of a second, so its program is not worth optimising: level 0 halves
    the compile time, and so does the older of jaxlib 0.10's two code generators (measured).  Other
    versions are left alone: an unknown flag would end the process.
    """
    from importlib.metadata import version

    if version("jaxlib").startswith("0.10."):
        quick = "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {quick}".strip()


def _set_up() -> None:
    """float64 and a cache of compiled programs; must come before the first array."""
    quick_compilation()
    import jax

    jax.config.update("jax_enable_x64", True)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(root / "oceaninv" / "programs"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Stem of the files to write: STEM.nc and STEM.png."),
]
SolarZenith = Annotated[
    float | None, typer.Option(help="Sun zenith angle in air, degrees; unknown if not given.")
]


@app.command("fit-profile")
def fit_profile_command(
    path: Annotated[Path, typer.Argument(help="csv with columns depth and Ed_<nm>.")],
    output: Output = None,
    low: Annotated[float | None, typer.Option("--from", help="Shallowest depth, m.")] = None,
    high: Annotated[float | None, typer.Option("--to", help="Deepest depth, m.")] = None,
    solar_zenith: SolarZenith = None,
    layers: Annotated[
        str, typer.Option(help="Layers of constant Kd: a number, or auto to let the data choose.")
    ] = "1",
    kd_only: Annotated[bool, typer.Option(help="Skip the fit of constituents.")] = False,
) -> None:
    """Fit Kd of every band and the constituents of the water to a depth profile of Ed."""
    from fitting import fit_profile
    from fitting.readers import read_profile
    from fitting.report import picture, save
    from oceaninv import TwoStream

    profile = read_profile(path, solar_zenith)
    depth_range = None
    if low is not None or high is not None:
        deepest = float(profile.depth.max())
        depth_range = (low or 0.0, deepest if high is None else high)
    _preload()
    with _status("fitting Kd"):
        fit = fit_profile(profile, depth_range=depth_range, layers=_layers(layers))
    constituents = None
    if not kd_only:
        with _status("fitting constituents (the first run compiles)"):
            constituents = fit_profile(profile, transport=TwoStream(), depth_range=depth_range)
    _print_kd(fit)
    if constituents is not None:
        _print_water(constituents)
    _finish(
        output or Path(path.stem),
        lambda p: save(p, fit, constituents),
        lambda p: picture(fit, p, constituents),
    )


@app.command("fit-photo")
def fit_photo_command(
    path: Annotated[Path, typer.Argument(help="csv of chart and background readings.")],
    depth: Annotated[str, typer.Option(help="Depth of the camera in m, as 5 or 5+-2.")],
    output: Output = None,
    camera: Annotated[
        str | None, typer.Option(help='Camera by name; "generic" if unknown.')
    ] = None,
    solar_zenith: SolarZenith = None,
    azimuth: Annotated[
        float | None,
        typer.Option(help="Heading relative to the sun, degrees: 180 with the sun behind."),
    ] = None,
    matrix: Annotated[
        bool, typer.Option(help="Free 3 x 3 colour matrix (raw developer unknown).")
    ] = False,
) -> None:
    """Fit the water's constituents to readings of charts and open water in a photograph."""
    from fitting import fit_photo
    from fitting.readers import read_photo
    from fitting.report import picture, save

    metres, relative = _depth(depth)
    photo, clipped = read_photo(path, metres, relative, camera, solar_zenith, azimuth)
    _preload()
    with _status("fitting constituents (the first run compiles)"):
        fit = fit_photo(photo, matrix=matrix)
    if clipped or photo.masked:
        print(f"left out: {clipped} clipped rows, {photo.masked} missing or non-positive values")
    _print_water(fit)
    _finish(output or Path(path.stem), lambda p: save(p, fit), lambda p: picture(fit, p))


def _layers(text: str) -> int | None:
    if text == "auto":
        return None
    if not text.isdigit():
        raise ValueError(f"--layers is {text!r}; write a number or auto.")
    return int(text)


def _depth(text: str) -> tuple[float, float]:
    """(metres, relative standard deviation) from "5" or "5+-2"."""
    value, _, spread = text.partition("+-")
    try:
        metres = float(value)
        relative = float(spread) / metres if spread else 0.02
    except (ValueError, ZeroDivisionError):
        raise ValueError(f"--depth is {text!r}; write metres as 5 or 5+-2.") from None
    if not (metres > 0 and relative > 0):
        raise ValueError(f"--depth is {text!r}; depth and its spread must be positive.")
    return metres, relative


def _status(text: str):
    from rich.console import Console

    return Console(stderr=True).status(text)


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
            f"{kd.value[i]:.4g}",
            f"{low[i]:.4g} - {high[i]:.4g}",
            scatter,
            str(fit.metadata["depths_used"][i]),
            f"{fit.metadata['deepest_used_m'][i]:.1f}",
        )
    Console().print(table)
    if fit.metadata["interfaces_m"]:
        _print_layers(fit)
    if fit.metadata["masked_values"]:
        print(f"masked: {fit.metadata['masked_values']} missing or non-positive values")
    print(f"search: {fit.result}")


def _print_layers(fit: "Fit") -> None:
    from rich.console import Console
    from rich.table import Table

    edges = [0.0, *fit.metadata["interfaces_m"], max(fit.metadata["deepest_used_m"])]
    table = Table(title="Kd (1/m) by layer, with 95 % intervals", title_justify="left")
    table.add_column("nm", justify="right")
    for top, bottom in itertools.pairwise(edges):
        table.add_column(f"{top:.3g} - {bottom:.3g} m", justify="right")
    for wavelength in fit.wavelength:
        names = [f"Kd_{wavelength:g}_{i}" for i in range(1, len(edges))]
        intervals = [fit.interval(name) for name in names]
        table.add_row(f"{wavelength:g}", *(f"{low:.3g} - {high:.3g}" for low, high in intervals))
    Console().print(table)


def _print_water(fit: "Fit") -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"Water by {fit.metadata['transport']}", title_justify="left")
    for name in ("quantity", "unit", "value", "95 % interval"):
        table.add_column(name, justify="left" if name in ("quantity", "unit") else "right")
    leans = Table(title="Shift of the value per sd of an assumption", title_justify="left")
    leans.add_column("quantity")
    leans.add_column("leans most on", overflow="fold")
    for name, quantity in fit.quantities.items():
        if quantity.value.ndim == 0:
            low, high = quantity.interval(0.95, fit.dof)
            known = bool(quantity.sd <= 0.5)
            table.add_row(name, quantity.unit, *_shown(float(quantity.value), low, high, known))
            leans.add_row(name, _leaning(fit, name))
    for parameter in fit.parameters:
        if not parameter.nuisance:
            name = parameter.name
            low, high = fit.interval(name)
            known = fit.identifiable[name]
            table.add_row(name, parameter.unit, *_shown(fit.value[name], low, high, known))
            leans.add_row(name, _leaning(fit, name))
    Console().print(table, leans)
    print(f"search: {fit.result}")


def _shown(value, low, high, known: bool) -> tuple[str, str]:
    best = f"{value:.3g}" if known else "not identifiable"
    return best, f"{low:.3g} - {high:.3g}"


def _leaning(fit: "Fit", name: str) -> str:
    shifts = sorted(fit.sensitivity[name].items(), key=lambda item: -abs(item[1]))[:2]
    return ", ".join(f"{key} {100 * shift:+.0f} %" for key, shift in shifts)


def _finish(stem: Path, write_data, write_picture) -> None:
    data, image = stem.with_name(stem.name + ".nc"), stem.with_name(stem.name + ".png")
    write_data(data)
    write_picture(image)
    print(f"wrote {data} and {image}")


def run(arguments: list[str]) -> int:
    """Run one command; returns the exit code, 3 after a sentence about bad input."""
    try:
        app(arguments, standalone_mode=True)
    except (ValueError, OSError) as error:
        print(f"oceaninv: {error}", file=sys.stderr)
        return INPUT_ERROR
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def _preload() -> None:
    """Import what the results are written with while the compiler keeps the other core busy."""
    import threading

    def load():
        import xarray  # noqa: F401

    threading.Thread(target=load, daemon=True).start()


def main() -> None:
    """The console script."""
    _set_up()
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
