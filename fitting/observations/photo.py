"""What was read from photographs, checked once on the way in."""

import copy
import dataclasses
from typing import Any

import numpy as np

import oceaninv as oi
from fitting.observations.array_checks import as_array
from oceaninv.foundation.argument_names import names_checked
from oceaninv.foundation.spectrum import Response


@dataclasses.dataclass(eq=False, init=False)
class Board:
    """The board that carries a chart's patches: what lies around a patch, out to open water.

    A patch is seen in its own light and in light of its surroundings that water scatters into the
    line of sight, and the board hides open water, see `oceaninv.target_transmission`.

    **Arguments:**

    - `width`, `height`: metres across and down.
    - `size_sd`: standard deviation of ln of a factor on all lengths here; 0 takes them as exact.
    - `patches`: (part, 4) rectangles on the board, each (across, down, half-width, half-height) in
      metres, from the middle of the board; none by default.
    - `reflectance`: (part, wl) or (part,) of the rectangles.
    - `ground`: reflectance of the rest of the board.

    **Raises:** ValueError where a length is not positive or above 20 m, or a patch lies outside the
    board.
    """

    width: float
    height: float
    size_sd: float
    patches: np.ndarray
    reflectance: np.ndarray
    ground: float

    def __init__(
        self,
        width: float,
        height: float,
        size_sd: float = 0.05,
        patches: Any = (),
        reflectance: Any = (),
        ground: float = 0.04,
    ):
        for name, value in (("width", width), ("height", height)):
            if not 0 < value <= 20.0:
                raise ValueError(
                    f"{name} of a board is {value:g} m; between 0 and 20 m wanted (a length in mm "
                    "is a thousand times too large)."
                )
        if not 0 <= size_sd < 2:
            raise ValueError(f"size_sd of a board must lie in [0, 2), not {size_sd:g}.")
        patches = np.asarray(patches, dtype=np.float64).reshape(-1, 4)
        reflectance = np.asarray(reflectance, dtype=np.float64)
        if len(reflectance) != len(patches):
            raise ValueError(
                f"a board needs one reflectance per patch: {len(reflectance)} for {len(patches)}."
            )
        reach = np.abs(patches[:, :2]) + patches[:, 2:]
        outside = np.any(reach > np.array([width, height]) / 2 * (1 + 1e-6), axis=1)
        if outside.any() or np.any(patches[:, 2:] <= 0):
            raise ValueError(
                f"{int(outside.sum())} of {len(patches)} patches have no size or lie outside the "
                f"board of {width:g} x {height:g} m: give lengths in metres from its middle."
            )
        self.width, self.height, self.size_sd = float(width), float(height), float(size_sd)
        self.patches, self.reflectance, self.ground = patches, reflectance, float(ground)


@dataclasses.dataclass(eq=False, init=False)
class Chart:
    """Readings of the patches of one chart in a photograph.

    **Arguments:**

    - `values`: (patch, channel) mean linear camera values.
    - `reflectance`: (patch, wl) on the wavelengths of the `Photo`, or (patch,) for neutral ones.
    - `distance`: metres from camera to chart, > 0.
    - `sigma`: (patch, channel) standard deviations; `None` takes 1 % of the value.
    - `zenith`: direction of the line of sight, degrees; 90 (default) is horizontal, 180 down.
    - `name`: for reports.
    - `distance_sd`: relative standard deviation of `distance`; 0 (default) takes it as exact.
    - `board`: what the patches are on; `None`: unknown, a square of 0.2 m within a factor of 1.6,
      as reflecting as the patches in the mean, with all patches in its middle.
    - `place`: (patch,) which of the board's patches each reading is of; unless given, a board with
      as many patches as readings has them in the order of the readings.
    """

    values: np.ndarray
    reflectance: np.ndarray
    distance: float
    sigma: np.ndarray
    zenith: float
    name: str
    distance_sd: float
    board: Board | None
    place: np.ndarray | None

    @names_checked
    def __init__(
        self,
        values,
        reflectance,
        distance,
        sigma=None,
        zenith=90.0,
        name="chart",
        distance_sd: Any = 0.0,
        board: Board | None = None,
        place: Any = None,
    ):
        values = as_array("values", values, 2)
        reflectance = np.asarray(reflectance, dtype=np.float64)
        if reflectance.ndim not in (1, 2) or len(reflectance) != len(values):
            raise ValueError(
                f"reflectance of chart {name!r} must have one row per patch ({len(values)}), not "
                f"shape {reflectance.shape}."
            )
        if np.any(~np.isfinite(reflectance)) or np.any((reflectance < 0) | (reflectance > 1.5)):
            raise ValueError(f"reflectance of chart {name!r} must lie between 0 and 1.5.")
        if not (np.isfinite(distance) and distance > 0):
            raise ValueError(f"distance of chart {name!r} must be positive, not {distance}.")
        if not 0 <= distance_sd < 1:
            raise ValueError(f"distance_sd of {name!r} must lie in [0, 1), not {distance_sd}.")
        _set_readings(self, values, sigma, zenith, name)
        self.reflectance = reflectance
        self.distance = float(distance)
        self.distance_sd = float(distance_sd)
        self.board, self.place = board, _places(board, place, len(values), name)
        if board is not None and distance < max(board.width, board.height) / 2:
            raise ValueError(
                f"the board of {name!r} is {board.width:g} x {board.height:g} m and {distance:g} m "
                "away: nearer than its half-size, a patch's surroundings are not seen at small "
                "angles; check the unit of the size and of the range."
            )

    def only(self, keep: np.ndarray) -> "Chart":
        """The chart with these readings alone, on the same board."""
        kept = copy.copy(self)
        for key in ("values", "reflectance", "sigma"):
            setattr(kept, key, getattr(self, key)[keep])
        kept.place = None if self.place is None else self.place[keep]
        return kept


def _places(board: Board | None, place, readings: int, name: str) -> np.ndarray | None:
    """The board's patch of each reading, or None where the board has none."""
    if board is None or not len(board.patches):
        return None
    place = np.arange(readings) if place is None else np.asarray(place)
    if place.shape != (readings,) or np.any((place < 0) | (place >= len(board.patches))):
        raise ValueError(
            f"place of chart {name!r} must name one of the board's {len(board.patches)} patches, "
            f"from 0, for each of {readings} readings."
        )
    return place.astype(int)


@dataclasses.dataclass(eq=False, init=False)
class Background:
    """Readings of open water: the light scattered into lines of sight that end at nothing.

    **Arguments:**

    - `values`: (direction, channel) mean linear camera values.
    - `zenith`: (direction,) degrees, 90 horizontal, 180 straight down.
    - `sigma`: (direction, channel); `None` takes 1 % of the value.
    """

    values: np.ndarray
    zenith: np.ndarray
    sigma: np.ndarray
    name: str

    @names_checked
    def __init__(self, values, zenith: Any = 90.0, sigma=None, name="background"):
        values = as_array("values", np.atleast_2d(np.asarray(values, dtype=np.float64)), 2)
        zenith = np.broadcast_to(np.asarray(zenith, dtype=np.float64), (len(values),))
        _set_readings(self, values, sigma, zenith, name)


def _set_readings(readings, values, sigma, zenith, name):
    sigma = 0.01 * np.abs(values) if sigma is None else as_array("sigma", sigma, 2)
    if sigma.shape != values.shape:
        raise ValueError(f"sigma of {name!r} must have the shape of values, {values.shape}.")
    if not np.all((np.asarray(zenith) >= 0) & (np.asarray(zenith) <= 180)):
        raise ValueError(f"zenith of {name!r} must lie between 0 and 180 degrees.")
    for key, value in (("values", values), ("sigma", sigma), ("zenith", zenith), ("name", name)):
        setattr(readings, key, value)


@dataclasses.dataclass(eq=False, init=False)
class Pixels:
    """Pixels of things of unknown reflectance at known ranges: reef, sand, rubble.

    **Arguments:**

    - `values`: (pixel, channel) linear camera values.
    - `distance`: (pixel,) metres from the camera.
    - `surfaces`: how many differently coloured surfaces they show.  Neighbouring pixels are of one
      surface: a hundred thousand pixels of a reef are some hundreds of measurements.
    - `zenith`: mean direction of the lines of sight, degrees.
    - `sigma`: (pixel, channel); `None` takes 3 % of the value.

    Missing and non-positive pixels are left out and counted in `masked`.
    """

    values: np.ndarray
    distance: np.ndarray
    surfaces: float
    zenith: float
    sigma: np.ndarray
    masked: int

    @names_checked
    def __init__(self, values, distance, surfaces: Any = 200.0, zenith: Any = 90.0, sigma=None):
        values, distance = as_array("values", values, 2), as_array("distance", distance, 1)
        sigma = 0.03 * np.abs(values) if sigma is None else as_array("sigma", sigma, 2)
        if values.shape != (len(distance), 3) or sigma.shape != values.shape:
            raise ValueError(
                f"values and sigma of pixels must have shape ({len(distance)}, 3), one row per "
                f"distance, not {values.shape} and {sigma.shape}."
            )
        if not surfaces >= 1:
            raise ValueError(f"surfaces must be at least 1, not {surfaces}.")
        if not 0 <= zenith <= 180:
            raise ValueError(f"zenith of pixels must lie between 0 and 180 degrees, not {zenith}.")
        usable = np.isfinite(distance) & (distance > 0)
        usable &= np.all(np.isfinite(values) & (values > 0) & (sigma > 0), axis=1)
        if usable.sum() < 16:
            raise ValueError(
                f"{int(usable.sum())} of {len(distance)} pixels have a range and three positive "
                "values; at least 16 are needed."
            )
        for key, value in (
            ("values", values[usable]),
            ("distance", distance[usable]),
            ("surfaces", float(min(surfaces, usable.sum()))),
            ("zenith", float(zenith)),
            ("sigma", sigma[usable]),
            ("masked", int((~usable).sum())),
        ):
            setattr(self, key, value)


@dataclasses.dataclass(eq=False, init=False)
class Photo:
    """One photograph: readings of charts and of open water by one camera at one depth.

    **Arguments:**

    - `charts`: sequence of `Chart`.
    - `backgrounds`: sequence of `Background`.
    - `pixels`: `Pixels` of unknown reflectance, or None.
    - `exposure`: relative exposure (time x ISO / f-number^2, see `fitting.Photograph.exposure`).
      Photographs that state it share the camera's gains, to `exposure_sd`; None leaves the gains
      of the frame free.
    - `response`: the camera's spectral response (`oceaninv.spectrum.camera_response(name)`), or
      `None` for an unknown camera: the mean of 50 cameras with three free components.
    - `response_shift`: standard deviation, nm, of an unknown shift of `response` (another body of
      the model, a filter, a port); 0 (default) takes it as measured.
    - `depth`: metres of the camera below the surface; charts are taken to hang at its depth plus
      what their line of sight descends.
    - `depth_sd`: relative standard deviation of `depth`.
    - `solar_zenith`: degrees in air.
    - `lamp`: whether a lamp at the camera, and no daylight, lit what is seen: its light falls off
      with the square of the distance and returns by single scattering.
    - `azimuth`: degrees clockwise from the sun's heading to the camera's: 0 looking at the sun,
      90 with the sun to the left, -90 or 270 with the sun to the right.  `None` takes 90 and open
      water that is equally bright to both sides of a chart.
    - `source`: for reports.

    NaN, zero and negative readings are masked, with the count in `masked`; ValueError when fewer
    than 3 readings remain.  Leave clipped patches out: they look like data.
    """

    charts: tuple[Chart, ...]
    backgrounds: tuple[Background, ...]
    response: Response | None
    depth: float
    depth_sd: float
    solar_zenith: float
    azimuth: float
    sun_side_known: bool
    source: str
    masked: int
    pixels: Pixels | None
    exposure: float | None
    exposure_sd: float
    response_shift: float
    lamp: bool

    @names_checked
    def __init__(
        self,
        charts=(),
        backgrounds=(),
        pixels=None,
        *,
        depth,
        exposure: Any = None,
        exposure_sd: Any = 0.03,
        response=None,
        response_shift: Any = 0.0,
        depth_sd=0.02,
        solar_zenith: Any = 40.0,
        azimuth: Any = None,
        source="memory",
        lamp=False,
    ):
        charts, backgrounds = tuple(charts), tuple(backgrounds)
        channels = 3
        if response is not None and response.values.shape[0] != channels:
            raise ValueError(f"response must have 3 channels, not {response.values.shape[0]}.")
        for item in charts + backgrounds:
            if item.values.shape[1] != channels:
                raise ValueError(
                    f"{item.name!r} has {item.values.shape[1]} channels, the camera {channels}."
                )
        if not (np.isfinite(depth) and depth > 0):
            raise ValueError(f"depth must be positive metres, not {depth}.")
        if not 0 <= solar_zenith < 90:
            raise ValueError(f"solar_zenith must lie in [0, 90) degrees, not {solar_zenith:g}.")
        if not 0 <= response_shift < 50:
            raise ValueError(f"response_shift must lie in [0, 50) nm, not {response_shift}.")
        readings = [item.values for item in charts + backgrounds]
        usable = sum(int(np.sum(np.isfinite(v) & (v > 0))) for v in readings)
        total = sum(v.size for v in readings)
        if exposure is not None and not (exposure > 0 and exposure_sd > 0):
            raise ValueError(
                f"exposure and exposure_sd must be positive, not {exposure} and {exposure_sd}."
            )
        if lamp and pixels is not None:
            raise ValueError("pixels of unknown reflectance are for daylight; leave them out.")
        if usable < 3 and pixels is None:
            raise ValueError(
                f"{usable} of {total} readings are usable (finite and positive); at least 3 are "
                "needed: give charts, background water, or both."
            )
        for key, value in (
            ("charts", charts),
            ("backgrounds", backgrounds),
            ("response", response),
            ("depth", float(depth)),
            ("depth_sd", float(depth_sd)),
            ("solar_zenith", float(solar_zenith)),
            ("azimuth", 90.0 if azimuth is None else float(azimuth)),
            ("sun_side_known", azimuth is not None),
            ("source", source),
            ("masked", total - usable + (0 if pixels is None else pixels.masked)),
            ("pixels", pixels),
            ("exposure", None if exposure is None else float(exposure)),
            ("exposure_sd", float(exposure_sd)),
            ("response_shift", float(response_shift)),
            ("lamp", bool(lamp)),
        ):
            setattr(self, key, value)


WAVELENGTH = oi.spectrum.bands(16)
