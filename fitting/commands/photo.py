"""`oceaninv fit-photo`."""

from pathlib import Path
from typing import Annotated

import typer

from fitting.commands.common import Output, SolarZenith, finish, preload, print_water, status


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
    preload()
    with status("fitting constituents (the first run compiles)"):
        fit = fit_photo(photo, matrix=matrix)
    if clipped or photo.masked:
        print(f"left out: {clipped} clipped rows, {photo.masked} missing or non-positive values")
    print_water(fit)
    finish(output or Path(path.stem), lambda p: save(p, fit), lambda p: picture(fit, p))


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
