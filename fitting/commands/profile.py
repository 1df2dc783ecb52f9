"""`oceaninv fit-profile`."""

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fitting.commands.common import Output, SolarZenith, finish, preload, print_water, status

if TYPE_CHECKING:
    from fitting.posterior import Fit


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
    preload()
    with status("fitting Kd"):
        fit = fit_profile(profile, depth_range=depth_range, layers=_layers(layers))
    constituents = None
    if not kd_only:
        with status("fitting constituents (the first run compiles)"):
            constituents = fit_profile(profile, transport=TwoStream(), depth_range=depth_range)
    _print_kd(fit)
    if constituents is not None:
        print_water(constituents)
    finish(
        output or Path(path.stem),
        lambda p: save(p, fit, constituents),
        lambda p: picture(fit, p, constituents),
    )


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
