"""`oceaninv fit-photo`."""

from pathlib import Path
from typing import Annotated

import typer

from fitting.commands.shared_options import (
    FieldOfView,
    IntrinsicsFile,
    KnownLength,
    Output,
    Overwrite,
    RangeKind,
    RangeScale,
    SolarZenith,
    Tolerance,
    check_outputs,
    check_range_options,
    known_values,
    noting,
    number_with_sd,
    preload,
    print_doubt,
    print_water,
    range_inputs,
    read_ranges,
    status,
    with_endings,
)
from oceaninv.foundation.provenance import record_inputs


def fit_photo_command(
    paths: Annotated[
        list[Path],
        typer.Argument(help="csv of chart and background readings, one of each photograph."),
    ],
    depth: Annotated[
        list[str],
        typer.Option(
            help="Depth of the camera in m, as 5 or 5+-2; once, or once a photograph.",
            rich_help_panel="Sun and camera",
        ),
    ],
    output: Output = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help='Camera by name; "generic" if unknown.', rich_help_panel="Sun and camera"
        ),
    ] = None,
    size: Annotated[
        float | None,
        typer.Option(
            help="Width of the charts' boards in m, where it is not that of the named chart.",
            rich_help_panel="Sun and camera",
        ),
    ] = None,
    solar_zenith: SolarZenith = None,
    azimuth: Annotated[
        float | None,
        typer.Option(
            help="Heading relative to the sun, degrees: 180 with the sun behind.",
            rich_help_panel="Sun and camera",
        ),
    ] = None,
    matrix: Annotated[
        bool,
        typer.Option(
            help="Free 3 x 3 colour matrix (raw developer unknown).", rich_help_panel="Model"
        ),
    ] = False,
    know: Annotated[
        list[str] | None,
        typer.Option(
            help="Value known otherwise, as cdom=0.12+-0.01 or Kd_490=0.09+-0.01.",
            rich_help_panel="Model",
        ),
    ] = None,
    robust: Annotated[
        float | None,
        typer.Option(
            help="Standard deviations beyond which a reading counts linearly.",
            rich_help_panel="Model",
        ),
    ] = None,
    tolerance: Tolerance = None,
    response_shift: Annotated[
        float,
        typer.Option(
            help="Standard deviation (nm) of an unknown shift of the response.",
            rich_help_panel="Model",
        ),
    ] = 0.0,
    picture_of: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="The photograph itself, to take its water out.",
            rich_help_panel="Picture without water",
        ),
    ] = None,
    range_map: Annotated[
        Path | None,
        typer.Option(help="Range map of --picture.", rich_help_panel="Picture without water"),
    ] = None,
    range_kind: RangeKind = None,
    range_scale: RangeScale = None,
    known_length: KnownLength = None,
    intrinsics: IntrinsicsFile = None,
    fov: FieldOfView = None,
    pixels: Annotated[
        bool,
        typer.Option(
            "--pixels",
            help="Fit what is seen in --picture, too, unknown as it is.",
            rich_help_panel="Picture without water",
        ),
    ] = False,
    encoding: Annotated[
        str | None,
        typer.Option(
            help="linear or sRGB, for a --picture that does not say.",
            rich_help_panel="Picture without water",
        ),
    ] = None,
    report: Annotated[
        bool,
        typer.Option(
            "--report",
            help="Write STEM.html, a page with everything in it.",
            rich_help_panel="Output",
        ),
    ] = False,
    sample: Annotated[
        bool,
        typer.Option(
            help="Draw from the posterior (NUTS; minutes, needs blackjax).", rich_help_panel="Model"
        ),
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Fit the water's constituents to readings of charts and open water in photographs."""
    from fitting import sample as draw
    from fitting.images.photo_csv import read_photo
    from fitting.images.photograph_file import pixels_of
    from fitting.photo.developed import fit_checked
    from fitting.photo.restore import restored_paths
    from fitting.report.netcdf_file import save
    from fitting.report.picture import picture

    depths = [_depth(text) for text in depth]
    if len(depths) not in (1, len(paths)):
        raise ValueError(
            f"--depth is given {len(depths)} times for {len(paths)} photographs: give it once, or "
            "once each."
        )
    if len(paths) > 1 and picture_of is not None:
        raise ValueError("--picture belongs to one photograph: fit it alone to take its water out.")
    known = known_values(know or [])
    if robust is not None and not robust > 0:
        raise ValueError(f"--robust is {robust:g}; a positive number wanted.")
    stem = output or Path(f"{paths[0].stem}_fit")
    data, image, page = with_endings(stem, ".nc", ".png", ".html")
    outputs = [data, image, *([page] if report else [])]
    inputs = list(paths)
    if picture_of is not None and range_map is not None:
        outputs += restored_paths(stem)
        inputs += [picture_of, *range_inputs(range_map, intrinsics)]
    options = range_kind, range_scale, known_length, intrinsics, fov
    check_range_options(range_map, *options)
    shown = _shown(picture_of, range_map, encoding, options)
    scenery = None
    if pixels:
        if shown is None:
            raise ValueError("--pixels needs --picture and --range-map.")
        scenery = pixels_of(*shown)
    read = [
        read_photo(
            path, *place, camera, solar_zenith, azimuth, response_shift=response_shift,
            pixels=scenery, size=size,
        )
        for path, place in zip(paths, depths * (len(paths) // len(depths)), strict=True)
    ]  # fmt: skip
    check_outputs(outputs, inputs, overwrite)
    record_inputs(inputs)
    photos, clipped = [photo for photo, _ in read], sum(count for _, count in read)
    masked = sum(photo.masked for photo in photos)
    preload()
    with status("fitting constituents (the first run compiles)"):
        options = {"know": known, "robust": robust, "tolerance": tolerance}
        fit, said = fit_checked(photos, matrix=matrix, **options)
    failures: list[str] = []
    if sample:
        with status("sampling the posterior (minutes)"), noting(failures, "the posterior"):
            fit = draw(fit)
    print_doubt(fit)
    if said:
        print(said)
    generic = [path for path, photo in zip(paths, photos, strict=True) if photo.response is None]
    if generic:
        named = ", ".join(str(path) for path in generic)
        print(f"camera of {named}: generic (mean of 50 measured ones, three components fitted)")
    if clipped or masked:
        print(f"left out: {clipped} clipped rows, {masked} missing or non-positive values")
    factor = fit.noise_factor or 1.0
    if factor > 1.0:
        print(f"readings scatter {factor:.1f} x as much as their noise says: intervals widened")
    print_water(fit)
    save(data, fit, overwrite=overwrite)
    picture(fit, image, overwrite=overwrite)
    print(f"wrote {data} and {image}")
    pictures = [] if shown is None else _without_water(fit, photos[0], shown, stem, overwrite)
    if report:
        from fitting.report.web_page import write_html

        write_html(fit, page, pictures, overwrite=overwrite)
        print(f"wrote {page}")
    if failures:
        raise ValueError("; ".join(failures))


def _shown(picture_of: Path | None, range_map: Path | None, encoding: str | None, options: tuple):
    """The photograph and its ranges, or None; read before the fit, so that it fails early."""
    if (picture_of is None) != (range_map is None):
        raise ValueError("--picture and --range-map go together: one without the other is no use.")
    if picture_of is None or range_map is None:
        return None
    from fitting.images.photograph_file import read_photograph

    photograph = read_photograph(picture_of, encoding)
    return photograph, read_ranges(range_map, photograph, *options)


def _without_water(fit, photo, shown, stem: Path, overwrite: bool) -> list[tuple[str, Path]]:
    """Write the restored picture and its residual; (caption, file) of what a page can show."""
    from fitting.photo.restore import restore

    photograph, ranges = shown
    views = [float(chart.zenith) for chart in photo.charts]
    restored = restore(fit, photograph, ranges, zenith=sum(views) / len(views) if views else 90.0)
    exr, png, residual = restored.save(stem, overwrite=overwrite)
    if said := restored.message():
        print(said)
    print(f"wrote {exr}, {png} and {residual}")
    return [("Without the water", png), ("Where the fitted water does not suit", residual)]


def _depth(text: str) -> tuple[float, float]:
    """(metres, relative standard deviation) from "5" or "5+-2"."""
    found = number_with_sd(text)
    if found is None:
        raise ValueError(f"--depth is {text!r}; write metres as 5 or 5+-2, both positive.")
    metres, sd = found
    return metres, 0.02 if sd is None else sd / metres
