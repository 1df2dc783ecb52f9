"""Readings of charts and open water from csv files with a header of `# key: value` lines."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

import oceaninv as oi
from fitting.files.csv_sheet import Sheet, header_number, read_sheet
from fitting.observations.photo import WAVELENGTH, Background, Board, Chart, Photo, Pixels
from fitting.observations.profile import Profile


def read_profile(path: str | Path, solar_zenith: float | None = None) -> Profile:
    """The one cast in a file of any kind that `fitting.files.cast_file` knows.

    csv: column `depth` (m) and columns `Ed_<wavelength in nm>`, units in the header; they may be
    W m-2 nm-1 or uW cm-2 nm-1 and are returned as the former; a missing or other unit is refused.
    `solar_zenith` (degrees) overrides the file's.
    """
    from fitting.files.cast_file import Reading, read_cast

    return read_cast(path, Reading(solar_zenith=solar_zenith))


def read_photo(
    path: str | Path,
    depth: float,
    depth_sd: float = 0.02,
    camera: str | None = None,
    solar_zenith: float | None = None,
    azimuth: float | None = None,
    field_noise: float = 0.03,
    response_shift: float = 0.0,
    pixels: Pixels | None = None,
    size: float | None = None,
) -> tuple[Photo, int]:
    """Readings of charts and open water in one photograph, and the number of clipped rows left out.

    Columns: kind (chart or background), chart (name), reflectance (0-1, neutral), range (m),
    zenith (degrees of the line of sight), R, G, B (linear) and R_sd, G_sd, B_sd; optional
    `clipped` (1 leaves the row out), `target` and `patch`: a chart that
    `fitting.images.chart_targets.target`
    knows and the number in it, whose spectrum then stands for `reflectance`.  `field_noise`:
    relative scatter that is added to the stated standard deviations (caustics, unevenness).
    `camera`: a name of the response table, "generic", or None for the header's `camera`.
    `solar_zenith` and `azimuth` (degrees, 180 with the sun behind the camera): None takes the
    header's, else 40 and that of `Photo`.  `response_shift` and `pixels` as in `Photo`.

    Boards: those of the rows' `target`; else as wide and high as the header's `board_width` and
    `board_height` (m) say; else unknown.  `size`: width of the boards in m, instead of the
    target's; a square board where the rows name no target.

    Header `relative_exposure`: time (s) x ISO/100 / f-number^2, by which photographs of one camera
    share its gains.  `light: lamp`: a lamp at the camera lit the charts.  Without that line
    ValueError where the header says `flash: fired`.
    """
    from fitting.images.quality_checks import FLASH

    sheet = read_sheet(path)
    lamp = sheet.header.get("light") == "lamp"
    if sheet.header.get("flash") == "fired" and not lamp:
        raise ValueError(f"{sheet.path}: {FLASH}.")
    channels = ["R", "G", "B"]
    sheet.require(
        "kind", "chart", "reflectance", "range", "zenith", *channels, *(f"{c}_sd" for c in channels)
    )
    if sheet.unit("range") != "m":
        raise ValueError(f"{sheet.path}: range must be in m, not {sheet.unit('range')!r}.")
    values = np.stack([sheet.numbers(c) for c in channels], axis=1)
    sd = np.stack([sheet.numbers(f"{c}_sd") for c in channels], axis=1)
    sd = np.hypot(sd, field_noise * values)
    keep = np.ones(len(values), dtype=bool)
    if "clipped" in sheet.columns:
        keep = sheet.numbers("clipped") != 1
    kinds, names = sheet.texts("kind"), sheet.texts("chart")
    for row, kind in enumerate(kinds, start=1):
        if kind not in ("chart", "background"):
            raise ValueError(
                f"{sheet.path}: data row {row}: kind is {kind!r}; chart or background wanted."
            )
    zenith, distance = sheet.numbers("zenith"), sheet.numbers("range")
    reflectance = _spectra(sheet)
    boards = _boards(sheet, size)
    is_chart = np.array([kind == "chart" for kind in kinds])
    try:
        charts = []
        for name in dict.fromkeys(n for n, k in zip(names, kinds, strict=True) if k == "chart"):
            rows = is_chart & keep & np.array([n == name for n in names])
            if rows.any():
                charts.append(
                    Chart(
                        values[rows],
                        reflectance[rows],
                        float(np.median(distance[rows])),
                        sd[rows],
                        float(np.median(zenith[rows])),
                        name,
                        **boards(rows),
                    )
                )
        rows = ~is_chart & keep
        backgrounds = [Background(values[rows], zenith[rows], sd[rows])] if rows.any() else []
        name = sheet.header.get("camera", "generic") if camera is None else camera
        response = _response(name)
        photo = Photo(
            charts,
            backgrounds,
            pixels,
            depth=depth,
            depth_sd=depth_sd,
            response=response,
            response_shift=response_shift,
            solar_zenith=header_number(sheet, "solar_zenith", solar_zenith, 40.0),
            azimuth=header_number(sheet, "azimuth", azimuth, None),
            exposure=header_number(sheet, "relative_exposure", None, None),
            source=str(path),
            lamp=lamp,
        )
    except ValueError as error:
        raise ValueError(f"{sheet.path}: {error}") from None
    return photo, int((~keep).sum())


def _response(name: str) -> "oi.spectrum.Response | None":
    """The response of a camera, None for "generic"; ValueError that mentions it for others."""
    if name.strip().lower() == "generic":
        return None
    try:
        return oi.spectrum.camera_response(name)
    except ValueError as error:
        raise ValueError(f"{error} Write generic for a camera that is not among them.") from None


def _spectra(sheet: Sheet) -> np.ndarray:
    """(row,) neutral reflectances, or (row, wl) where some row names its target and patch."""
    from fitting.images.chart_targets import target

    neutral = sheet.numbers("reflectance")
    if "target" not in sheet.columns or not any(names := sheet.texts("target")):
        return neutral
    sheet.require("patch")
    numbers = sheet.numbers("patch")
    charts = {name: target(name) for name in set(names) if name}
    rows = []
    for line, (name, number, grey) in enumerate(zip(names, numbers, neutral, strict=True), start=1):
        if not name:
            rows.append(np.full(len(WAVELENGTH), grey))
        elif 1 <= number <= len(charts[name].reflectance):
            rows.append(charts[name].reflectance[int(number) - 1])
        else:
            raise ValueError(
                f"{sheet.path}: data row {line}: {name} has patches 1 to "
                f"{len(charts[name].reflectance)}, not {number:g}."
            )
    return np.stack(rows)


def _boards(sheet: Sheet, size: float | None) -> Callable[[Bool[np.ndarray, " row"]], dict]:
    """The arguments `board` and `place` of a chart made of these rows."""
    from fitting.images.chart_targets import target

    named = sheet.texts("target") if "target" in sheet.columns else [""] * len(sheet.texts("kind"))
    width, height = (header_number(sheet, f"board_{k}", None, None) for k in ("width", "height"))
    if size is not None:
        width = height = size
    elif (width is None) != (height is None):
        raise ValueError(
            f"{sheet.path}: give both '# board_width' and '# board_height', in metres."
        )
    try:
        plain = None if width is None or height is None else Board(width, height)
    except ValueError as error:
        raise ValueError(f"{sheet.path}: {error}") from None

    def board(rows) -> dict:
        names = {name for name, row in zip(named, rows, strict=True) if row}
        chart = target(names.pop()) if len(names) == 1 and "" not in names else None
        if chart is None or chart.board is None:
            return {"board": plain}
        if size is not None:
            chart = chart.of_size(size)
        return {"board": chart.board, "place": sheet.numbers("patch")[rows].astype(int) - 1}

    return board


def patches_of(sheet: Sheet) -> tuple[Bool[np.ndarray, " row"], Float[np.ndarray, "row channel"]]:
    """Which rows are grey, and what the camera would see of each row in white light.

    Rows that name no target are grey.  The camera is that of the header, else the generic one.
    """
    from fitting.images.chart_targets import target

    neutral = np.ones(len(sheet.texts("kind")), dtype=bool)
    spectra = _spectra(sheet)
    if spectra.ndim == 1:
        spectra = np.repeat(spectra[:, None], len(WAVELENGTH), axis=1)
    else:
        pairs = zip(sheet.texts("target"), sheet.numbers("patch"), strict=True)
        neutral = np.array([not n or bool(target(n).neutral[int(p) - 1]) for n, p in pairs])
    name = sheet.header.get("camera", "generic")
    try:
        camera = oi.spectrum.camera_response(name)
    except ValueError:
        camera = oi.spectrum.generic_camera()
    return neutral, spectra @ np.asarray(camera.weights(WAVELENGTH)).T
