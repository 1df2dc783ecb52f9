"""`oceaninv template` and `oceaninv cameras`."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

_PHOTO = """\
# Readings of charts and open water in one photograph, for: oceaninv fit-photo FILE --depth 5+-1
# Lines that begin with # are remarks, but for those of the form "key: value" that are read.
# Name of the camera (oceaninv cameras lists those that are known), or generic:
# camera: generic
# Angle of the sun from the zenith, in air, degrees:
# solar_zenith: 40
# Heading of the camera relative to the sun, degrees; 180 with the sun behind:
# azimuth: 90
# Only if a lamp at the camera, not daylight, lit the charts, write a line "light: lamp" like these.
# units: kind=text, chart=text, range=m, zenith=degree, *=1
# kind: chart or background (open water).  chart: name of the chart.  reflectance: of the grey
# patch, 0 to 1.  range: metres from the camera.  zenith: direction of the line of sight, degrees:
# 90 horizontal, 180 straight down.  R, G, B: means of linear values (raw, not JPEG); R_sd, G_sd,
# B_sd: standard deviations of these means.  clipped: 1 leaves the row out.
# Replace the rows below, which are of clear water, by your own.
kind,chart,reflectance,range,zenith,R,G,B,R_sd,G_sd,B_sd,clipped
"""
_CAST = """\
# Irradiance at depths, for: oceaninv fit-profile FILE
# Lines that begin with # are remarks, but for those of the form "key: value" that are read.
# Angle of the sun from the zenith, in air, degrees; leave the line out if it is not known:
# solar_zenith: 40
# Unit of every column; of Ed W m-2 nm-1 or uW cm-2 nm-1:
# units: depth=m, Ed_*=W m-2 nm-1
# depth: metres, positive down, at least 5 of them.  Ed_<nm>: downward irradiance, one column per
# band; leave a cell empty where nothing was measured.  Columns Eu_<nm> and Lu_<nm> (upward), PAR
# and tilt may stand beside them.
# Replace the rows below, whose light falls by 0.04, 0.05 and 0.08 per metre, by your own.
depth,Ed_443,Ed_490,Ed_555
"""


class Kind(StrEnum):
    """What there are templates for."""

    photo = "photo"
    cast = "cast"


def template_command(
    kind: Annotated[Kind, typer.Argument(help="photo (readings of charts) or cast (a profile).")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="File to write; printed if not given."),
    ] = None,
) -> None:
    """Write a csv with remarks, to be filled in; never over a file that exists."""
    text = _photo() if kind == Kind.photo else _cast()
    if output is None:
        print(text, end="")
        return
    try:
        with output.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise ValueError(f"{output} exists: name another file with -o.") from None
    except OSError as error:
        raise ValueError(f"cannot write {output}: {error.strerror}.") from None
    print(f"wrote {output}")


def _cast() -> str:
    import numpy as np

    depth = np.arange(1.0, 31.0)
    light = np.array([1.0, 1.1, 1.0]) * np.exp(-np.outer(depth, [0.04, 0.05, 0.08]))
    table = np.column_stack([depth, light])
    rows = [",".join(f"{value:.4g}" for value in row) for row in table]
    return _CAST + "\n".join(rows) + "\n"


def _photo() -> str:
    import numpy as np

    veil, lost = np.array([0.02, 0.10, 0.12]), np.array([0.55, 0.13, 0.11])
    rows = []
    for chart, distance in (("A", 1.0), ("B", 3.0)):
        for grey in (0.9, 0.36, 0.09):
            kept = np.exp(-lost * distance)
            rows.append(("chart", chart, grey, distance, 0.3 * grey * kept + veil * (1 - kept)))
    rows.append(("background", "", "", "", veil))
    lines = []
    for name, chart, grey, distance, seen in rows:
        values = ",".join(f"{v:.4f}" for v in seen)
        lines.append(f"{name},{chart},{grey},{distance},90,{values},0.001,0.001,0.001,0")
    return _PHOTO + "\n".join(lines) + "\n"


def cameras_command() -> None:
    """List the cameras whose response is known; for any other write generic."""
    from oceaninv.foundation.spectrum import camera_names

    print("\n".join(["generic", *camera_names()]))
