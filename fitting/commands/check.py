"""`oceaninv check`."""

from pathlib import Path
from typing import Annotated

import typer


def check_command(
    paths: Annotated[list[Path], typer.Argument(help="Pictures, or csv of chart readings.")],
    encoding: Annotated[
        str | None, typer.Option(help="linear or sRGB, for files that do not say.")
    ] = None,
) -> None:
    """Say whether photographs and chart readings are fit to be inverted; code 1 where not."""
    bad = 0
    for path in paths:
        lines = _charts(path) if path.suffix.lower() == ".csv" else _picture(path, encoding)
        print(path)
        for passed, text in lines:
            print(f"  {'ok' if passed else 'NO'}  {text}")
            bad += not passed
    if bad:
        print(f"{bad} objection(s)")
        raise typer.Exit(1)


def _charts(path: Path) -> list[tuple[bool, str]]:
    import numpy as np

    from fitting.readers import read_sheet
    from fitting.verdicts import linearity

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
    return lines


def _picture(path: Path, encoding: str | None) -> list[tuple[bool, str]]:
    import numpy as np

    from fitting.photographs import read_photograph

    photo = read_photograph(path, encoding)
    lines = []
    for c, plane in zip("RGB", np.moveaxis(photo.values, 2, 0), strict=True):
        zero = float(np.mean(~(plane > 0)))
        full = float(np.mean(plane >= 1))
        text = f"{c}: {100 * zero:.2f} % at or below zero, {100 * full:.2f} % at full scale"
        if zero > 0.05:
            text += "; the channel was cut by the developer or is dark: lower its black level"
        if full > 0.01:
            text += "; expose less, and read no patch there"
        lines.append((zero <= 0.05 and full <= 0.01, text))
    if photo.flash:
        lines.append((False, "a flash fired: natural-light fits do not apply to what it lit"))
    return lines
