"""`oceaninv check`."""

from pathlib import Path
from typing import Annotated

import typer


def check_command(
    paths: Annotated[list[Path], typer.Argument(help="Pictures, or csv of chart readings.")],
    encoding: Annotated[
        str | None, typer.Option(help="linear or sRGB, for files that do not say.")
    ] = None,
    range_map: Annotated[
        Path | None, typer.Option(help="Range map of the picture: gaps and units.")
    ] = None,
) -> None:
    """Say whether photographs and chart readings are fit to be inverted; code 1 where not."""
    if range_map is not None and len(paths) > 1:
        raise ValueError("--range-map belongs to one picture; check one at a time.")
    bad = 0
    for path in paths:
        if path.suffix.lower() == ".csv":
            lines = _charts(path)
        else:
            lines = _picture(path, encoding, range_map)
        print(path)
        for passed, text in lines:
            print(f"  {'ok' if passed else 'NO'}  {text}")
            bad += not passed
    if bad:
        print(f"{bad} objection(s)")
        raise typer.Exit(1)


def _charts(path: Path) -> list[tuple[bool, str]]:
    import numpy as np

    from fitting.files.csv_sheet import read_sheet
    from fitting.images.quality_checks import FLASH, linearity, of_range

    sheet = read_sheet(path)
    sheet.require("kind", "chart", "reflectance", "R", "G", "B")
    values = np.stack([sheet.numbers(c) for c in "RGB"], axis=1)
    reflectance = sheet.numbers("reflectance")
    names = sheet.texts("chart")
    is_chart = np.array([kind == "chart" for kind in sheet.texts("kind")])
    lines = []
    for name in dict.fromkeys(n for n, chart in zip(names, is_chart, strict=True) if chart):
        rows = is_chart & np.array([n == name for n in names])
        rows &= np.all(np.isfinite(values) & (values > 0), axis=1) & np.isfinite(reflectance)
        if rows.sum() < 4:
            lines.append((True, f"chart {name}: {int(rows.sum())} patches, too few to judge"))
            continue
        found = linearity(values[rows], reflectance[rows])
        known = np.zeros(int(rows.sum()), dtype=bool)
        if "clipped" in sheet.columns:
            known = sheet.numbers("clipped")[rows] == 1
        fresh = found.clipped & ~known
        text = f"chart {name}: {found.sentence()}"
        if found.clipped.any() and not fresh.any():
            text += " (all marked so in the file)"
        lines.append((not fresh.any(), text))
    if is_chart.any() and "range" in sheet.columns:
        lines += of_range(sheet.numbers("range")[is_chart], "ranges of the charts")
    grey = reflectance[is_chart & np.isfinite(reflectance)]
    if grey.size and grey.max() > 1.5:
        lines.append((False, f"reflectances up to {grey.max():.3g} look like per cent: divide "
                      "them by 100"))  # fmt: skip
    if sheet.header.get("flash") == "fired" and sheet.header.get("light") != "lamp":
        lines.append((False, FLASH))
    return lines


def _picture(path: Path, encoding: str | None, range_map: Path | None) -> list[tuple[bool, str]]:
    from fitting.images.photograph_file import read_photograph, read_range
    from fitting.images.quality_checks import of_picture, of_range

    photo = read_photograph(path, encoding)
    if range_map is None:
        return of_picture(photo)
    return of_picture(photo) + of_range(read_range(range_map, photo.values.shape[:2]))
