"""`oceaninv check`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fitting.commands.shared_options import (
    FieldOfView,
    IntrinsicsFile,
    KnownLength,
    RangeKind,
    RangeScale,
    check_range_options,
    read_ranges,
)

if TYPE_CHECKING:
    from fitting.images.quality_checks import QualityCheck


def check_command(
    paths: Annotated[list[Path], typer.Argument(help="Pictures, or csv of chart readings.")],
    encoding: Annotated[
        str | None, typer.Option(help="linear or sRGB, for files that do not say.")
    ] = None,
    range_map: Annotated[
        Path | None, typer.Option(help="Range map of the picture, checked for gaps and units.")
    ] = None,
    range_kind: RangeKind = None,
    range_scale: RangeScale = None,
    known_length: KnownLength = None,
    intrinsics: IntrinsicsFile = None,
    fov: FieldOfView = None,
) -> None:
    """Check whether photographs and chart readings can be used for a fit; exit code 1 if not."""
    if range_map is not None and len(paths) > 1:
        raise ValueError("--range-map belongs to one picture; check one at a time.")
    options = range_kind, range_scale, known_length, intrinsics, fov
    check_range_options(range_map, *options)
    problems = 0
    for path in paths:
        if path.suffix.lower() == ".csv":
            checks = _charts(path)
        else:
            checks = _picture(path, encoding, range_map, options)
        print(path)
        for passed, message in checks:
            print(f"  {'ok' if passed else 'NO'}  {message}")
            problems += not passed
    if problems:
        print(f"{problems} problem(s)")
        raise typer.Exit(1)


def _charts(path: Path) -> "list[QualityCheck]":
    import numpy as np

    from fitting.files.csv_sheet import read_sheet
    from fitting.images.photo_csv import patches_of
    from fitting.images.quality_checks import FLASH, QualityCheck, of_chart, of_range

    sheet = read_sheet(path)
    sheet.require("kind", "chart", "reflectance", "R", "G", "B")
    values = np.stack([sheet.numbers(c) for c in "RGB"], axis=1)
    reflectance = sheet.numbers("reflectance")
    neutral, expected = patches_of(sheet)
    marked = np.zeros(len(values), dtype=bool)
    if "clipped" in sheet.columns:
        marked = sheet.numbers("clipped") == 1
    names = sheet.texts("chart")
    is_chart = np.array([kind == "chart" for kind in sheet.texts("kind")])
    checks = []
    for name in dict.fromkeys(n for n, chart in zip(names, is_chart, strict=True) if chart):
        rows = is_chart & np.array([n == name for n in names])
        rows &= np.all(np.isfinite(values) & (values > 0), axis=1) & np.isfinite(reflectance)
        checks += of_chart(
            values[rows], reflectance[rows], neutral[rows], expected[rows], marked[rows], name
        )
    if is_chart.any() and "range" in sheet.columns:
        checks += of_range(sheet.numbers("range")[is_chart], "ranges of the charts")
    known = reflectance[is_chart & np.isfinite(reflectance)]
    if known.size and known.max() > 1.5:
        per_cent = f"reflectances up to {known.max():.3g} look like per cent: divide them by 100"
        checks.append(QualityCheck(False, per_cent))
    if sheet.header.get("flash") == "fired" and sheet.header.get("light") != "lamp":
        checks.append(QualityCheck(False, FLASH))
    return checks


def _picture(
    path: Path, encoding: str | None, range_map: Path | None, options: tuple
) -> "list[QualityCheck]":
    from fitting.images.photograph_file import read_photograph
    from fitting.images.quality_checks import of_picture, of_range

    photo = read_photograph(path, encoding)
    if range_map is None:
        return of_picture(photo)
    return of_picture(photo) + of_range(read_ranges(range_map, photo, *options))
