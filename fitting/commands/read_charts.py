"""`oceaninv read-charts`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fitting.commands.shared_options import (
    FieldOfView,
    IntrinsicsFile,
    KnownLength,
    Overwrite,
    RangeKind,
    RangeScale,
    check_outputs,
    check_range_options,
    range_inputs,
    read_ranges,
    with_endings,
)
from oceaninv.foundation.provenance import record_inputs

if TYPE_CHECKING:
    from fitting.images.photograph_file import Photograph


def read_charts_command(
    path: Annotated[Path, typer.Argument(help="Photograph: raw, EXR, 16-bit PNG or TIFF.")],
    chart: Annotated[
        list[str],
        typer.Option(
            help='One chart, as "A DGK18 4.65 x,y x,y x,y x,y": name, kind (ColorChecker24, DGK18 '
            'or a csv), range in m or "map", then the corners in pixels, clockwise from its top '
            'left (see oceaninv pick).  "find" instead of the corners takes the largest chart '
            "found, then the next; not of a csv."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Stem of the files: STEM.csv and STEM_patches.png."),
    ],
    background: Annotated[
        list[str] | None,
        typer.Option(help='Window of open water, as "x0,y0 x1,y1" or "x0,y0 x1,y1 zenith".'),
    ] = None,
    zenith: Annotated[
        list[float] | None,
        typer.Option(
            help="Zenith angle of the line of sight, degrees; 90 (horizontal) if not given.  Once "
            "for all charts, or once for each."
        ),
    ] = None,
    range_map: Annotated[
        Path | None,
        typer.Option(help='Range map of the photograph, for charts whose range is "map".'),
    ] = None,
    range_kind: RangeKind = None,
    range_scale: RangeScale = None,
    known_length: KnownLength = None,
    intrinsics: IntrinsicsFile = None,
    fov: FieldOfView = None,
    encoding: Annotated[
        str | None, typer.Option(help="linear or sRGB, for files that do not say.")
    ] = None,
    lamp: Annotated[
        bool,
        typer.Option(
            "--lamp", help="What is seen was lit by a lamp at the camera, not by daylight."
        ),
    ] = False,
    camera: Annotated[
        str | None,
        typer.Option(help="Name of the camera, or generic; by default that of the file."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Read the patches of charts in a photograph into a csv, and draw where they were read."""
    import numpy as np

    from fitting.images.chart_reading import overlay, read_chart, table_of
    from fitting.images.photograph_file import read_photograph

    data, image = with_endings(output, ".csv", "_patches.png")
    asked = [_chart(text) for text in chart]
    named = [Path(kind) for _, kind, *_ in asked if kind.lower().endswith(".csv")]
    options = range_kind, range_scale, known_length, intrinsics, fov
    check_range_options(range_map, *options)
    inputs = [path, *range_inputs(range_map, intrinsics), *named]
    check_outputs([data, image], inputs, overwrite)
    record_inputs(inputs)
    photograph = read_photograph(path, encoding)
    ranges = None
    if range_map is not None:
        ranges = read_ranges(range_map, photograph, *options)
    tilts = zenith or [90.0]
    if len(tilts) not in (1, len(chart)):
        raise ValueError(
            f"--zenith is given {len(tilts)} times for {len(chart)} charts: give it once, or once "
            "each."
        )
    readings, rows, places = [], [], {}
    for text, (name, kind, distance, corners) in zip(chart, asked, strict=True):
        if corners is None:
            from fitting.images.chart_detection import find_charts

            if kind not in places:
                places[kind] = find_charts(photograph, kind)
            if not places[kind]:
                raise ValueError(
                    f"--chart is {text!r}: no more charts of the kind were found; give the corners."
                )
            corners = places[kind].pop(0)
        reading = read_chart(photograph, corners, kind)
        if distance is None:
            distance = _median(ranges, reading.outline, text)
        readings.append(reading)
        rows.append((name, kind, distance, reading))
        print(f"{name} at {distance:.2f} m: {reading.message()}")
    print(_camera(camera, photograph))
    windows = [_window(text, tilts[0]) for text in background or ()]
    content = table_of(
        photograph, rows, windows, tilts if len(tilts) > 1 else tilts[0], camera, lamp
    )
    from oceaninv.foundation.atomic_write import atomic_write

    overlay(photograph, readings, image, overwrite=overwrite)
    with atomic_write(data, overwrite=overwrite) as temporary:
        temporary.write_text(content, encoding="utf-8")
    left = int(np.sum([(~r.kept).sum() for r in readings]))
    print(f"left out: {left} patches.  wrote {data} and {image}")


def _camera(name: str | None, photograph: "Photograph") -> str:
    """Whose response is written into the csv; why, where it is the generic one by default."""
    if name is not None or photograph.camera is not None:
        return f"camera: {name or photograph.camera}"
    model = photograph.exif.get("Model")
    why = f"the response of {model} is not known" if model else "the file names no camera"
    return f"camera: generic, for {why}; name another of `oceaninv cameras` with --camera"


def _point(text: str) -> tuple[float, float]:
    x, y = text.split(",")
    return float(x), float(y)


def _chart(text: str):
    """(name, kind, range or None, corners or None) of one --chart."""
    parts = text.split()
    try:
        name, kind, distance = parts[:3]
        corners = None if parts[3:] == ["find"] else [_point(p) for p in parts[3:]]
        metres = None if distance == "map" else float(distance)
        if corners is not None and len(corners) != 4:
            raise ValueError
    except ValueError:
        raise ValueError(
            f'--chart is {text!r}; write "name kind range x,y x,y x,y x,y", range in m or "map".'
        ) from None
    return name, kind, metres, corners


def _window(text: str, zenith: float):
    """(x0, y0, x1, y1, zenith) of one --background."""
    parts = text.split()
    try:
        first, second = _point(parts[0]), _point(parts[1])
        return (*first, *second, float(parts[2]) if len(parts) > 2 else zenith)
    except (ValueError, IndexError):
        raise ValueError(
            f'--background is {text!r}; write "x0,y0 x1,y1", and a zenith after it if it differs.'
        ) from None


def _median(ranges, outline, text: str) -> float:
    """Median range over the patches of a chart."""
    import numpy as np

    if ranges is None:
        raise ValueError(f'--chart is {text!r}, whose range is "map": give --range-map.')
    column, row = np.round(outline.mean(axis=1)).astype(int).T
    found = np.nanmedian(ranges[row, column]) if np.isfinite(ranges[row, column]).any() else np.nan
    if not np.isfinite(found):
        raise ValueError(f"the range map has no range on the chart of {text!r}: give it in m.")
    return float(found)
