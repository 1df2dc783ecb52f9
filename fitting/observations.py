"""What was measured, checked once on the way in."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fitting._sensor import MIN_DEPTHS, darkness, noise_floor, smooth_reference, thinned
from oceaninv.spectrum import Response
from oceaninv.tables import check_wavelength


def _array(name: str, value, ndim: int) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != ndim:
        raise ValueError(f"{name} must have {ndim} dimension(s), not shape {array.shape}.")
    return array


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """Irradiance at depths.

    **Arguments:**

    - `depth`: (depth,) metres, positive down, in the order of measurement; at least 5.
    - `wavelength`: (wl,) nm, strictly increasing.
    - `Ed`: (depth, wl) downward irradiance, W m-2 nm-1 (any unit: Kd does not depend on it).
      NaN, zero and negative values beyond the noise in darkness are masked, counted in `masked`.
    - `sigma`: (depth, wl) standard deviations of Ed; `None` estimates a relative noise per band
      from the residuals, which then holds what an uncertain depth adds as well.
    - `floor`: (wl,) standard deviation of the noise in darkness, in the unit of Ed, used when
      `sigma` is None; `None` estimates it from the deepest tenth of the cast.
    - `solar_zenith`: degrees in air, or None if unknown.
    - `source`: where the numbers come from, for reports.
    - `Eu`, `Lu`: (depth, wl) upward irradiance and radiance of the same bands; NaN where absent.
    - `surface`: (depth, wl) irradiance above the water at the same moments.  Its slow changes are
      divided out of Ed; quick ones and dips that end, such as those of a shadow band, are not.
    - `PAR`: (depth,) photosynthetically available radiation, any unit.
    - `tilt`: (depth,) degrees, for reports.
    - `counts`: what was left out before, by reason, for reports.

    Casts of more than 2,048 samples are reduced to medians of neighbours in depth.  `dark`,
    `dark_sd` (wl,): the reading in darkness, where the cast reaches it, else 0; `reference`
    (depth, wl): the light above relative to its median.

    Raises ValueError, naming band and count, when a band keeps fewer than 5 depths.
    """

    depth: Float[np.ndarray, " depth"]
    wavelength: Float[np.ndarray, " wl"]
    Ed: Float[np.ndarray, "depth wl"]
    sigma: Float[np.ndarray, "depth wl"] | None
    floor: Float[np.ndarray, " wl"]
    mask: Bool[np.ndarray, "depth wl"]
    solar_zenith: float | None
    source: str
    Eu: Float[np.ndarray, "depth wl"] | None
    Lu: Float[np.ndarray, "depth wl"] | None
    reference: Float[np.ndarray, "depth wl"] | None
    PAR: Float[np.ndarray, " depth"] | None
    tilt: Float[np.ndarray, " depth"] | None
    dark: Float[np.ndarray, " wl"]
    dark_sd: Float[np.ndarray, " wl"]
    counts: Mapping[str, int]

    def __init__(
        self,
        depth,
        wavelength,
        Ed,
        sigma=None,
        floor=None,
        solar_zenith=None,
        source="memory",
        *,
        Eu=None,
        Lu=None,
        surface=None,
        PAR=None,
        tilt=None,
        counts: Mapping[str, int] | None = None,
    ):
        depth, wavelength = _array("depth", depth, 1), check_wavelength(wavelength)
        Ed = _array("Ed", Ed, 2)
        if Ed.shape != (len(depth), len(wavelength)):
            raise ValueError(
                f"Ed must have shape (depth, wl) = ({len(depth)}, {len(wavelength)}), "
                f"not {Ed.shape}."
            )
        if not np.all(np.isfinite(depth)):
            raise ValueError(f"depth holds {int(np.sum(~np.isfinite(depth)))} missing values.")
        tables = {"Ed": Ed, "sigma": sigma, "Eu": Eu, "Lu": Lu, "reference": surface}
        lines = {"PAR": PAR, "tilt": tilt}
        for name, value in {**tables, **lines}.items():
            if value is not None:
                array = _array(name, value, 2 if name in tables else 1)
                if array.shape != (Ed.shape if name in tables else depth.shape):
                    raise ValueError(
                        f"{name if name != 'reference' else 'surface'} must have the shape of "
                        f"{'Ed' if name in tables else 'depth'}, "
                        f"{Ed.shape if name in tables else depth.shape}."
                    )
                (tables if name in tables else lines)[name] = array
        if surface is not None:
            tables["reference"] = smooth_reference(tables["reference"])
        order = np.argsort(depth, kind="stable")
        data = {"depth": depth, **tables, **lines}
        data = {k: None if v is None else v[order] for k, v in data.items()}
        data, merged = thinned(data)
        depth, Ed, sigma = data["depth"], data["Ed"], data["sigma"]
        dark, dark_sd, scatter = darkness(Ed)
        # Zero is what a digital sensor writes for nothing; negative noise around darkness is data.
        least = np.where(dark_sd > 0, dark - 5.0 * scatter, 0.0)
        mask = np.isfinite(Ed) & (Ed != 0) & (Ed > least) & (depth >= 0)[:, None]
        if sigma is not None:
            mask &= np.isfinite(sigma) & (sigma > 0)
        if data["reference"] is not None:
            mask &= np.isfinite(data["reference"]) & (data["reference"] > 0)
        for band, kept in zip(wavelength, mask.sum(axis=0), strict=True):
            if kept < MIN_DEPTHS:
                raise ValueError(
                    f"the band at {band:g} nm keeps {kept} of {len(depth)} depths after masking "
                    f"missing and non-positive irradiance; at least {MIN_DEPTHS} are needed."
                )
        if solar_zenith is not None and not 0 <= solar_zenith < 90:
            raise ValueError(f"solar_zenith must lie in [0, 90) degrees, not {solar_zenith:g}.")
        if floor is None:
            floor = np.where(dark_sd > 0, scatter, noise_floor(Ed, mask))
        floor = np.broadcast_to(np.asarray(floor, dtype=np.float64), wavelength.shape)
        counts = dict(counts or {})
        if merged > 1:
            counts["samples merged into each median"] = merged
        for name, value in {
            **data,
            "wavelength": wavelength,
            "floor": floor,
            "mask": mask,
            "solar_zenith": solar_zenith,
            "source": source,
            "dark": dark,
            "dark_sd": dark_sd,
            "counts": counts,
        }.items():
            object.__setattr__(self, name, value)

    @property
    def masked(self) -> int:
        """How many values were missing, zero, negative or above the surface."""
        return int((~self.mask).sum())


@dataclasses.dataclass(frozen=True, eq=False)
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
    """

    values: np.ndarray
    reflectance: np.ndarray
    distance: float
    sigma: np.ndarray
    zenith: float
    name: str
    distance_sd: float

    def __init__(
        self,
        values,
        reflectance,
        distance,
        sigma=None,
        zenith=90.0,
        name="chart",
        distance_sd: Any = 0.0,
    ):
        values = _array("values", values, 2)
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
        object.__setattr__(self, "reflectance", reflectance)
        object.__setattr__(self, "distance", float(distance))
        object.__setattr__(self, "distance_sd", float(distance_sd))


@dataclasses.dataclass(frozen=True, eq=False)
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

    def __init__(self, values, zenith: Any = 90.0, sigma=None, name="background"):
        values = _array("values", np.atleast_2d(np.asarray(values, dtype=np.float64)), 2)
        zenith = np.broadcast_to(np.asarray(zenith, dtype=np.float64), (len(values),))
        _set_readings(self, values, sigma, zenith, name)


def _set_readings(readings, values, sigma, zenith, name):
    sigma = 0.01 * np.abs(values) if sigma is None else _array("sigma", sigma, 2)
    if sigma.shape != values.shape:
        raise ValueError(f"sigma of {name!r} must have the shape of values, {values.shape}.")
    if np.any(np.asarray(zenith) < 0) or np.any(np.asarray(zenith) > 180):
        raise ValueError(f"zenith of {name!r} must lie between 0 and 180 degrees.")
    for key, value in (("values", values), ("sigma", sigma), ("zenith", zenith), ("name", name)):
        object.__setattr__(readings, key, value)


@dataclasses.dataclass(frozen=True, eq=False)
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

    def __init__(self, values, distance, surfaces: Any = 200.0, zenith: Any = 90.0, sigma=None):
        values, distance = _array("values", values, 2), _array("distance", distance, 1)
        sigma = 0.03 * np.abs(values) if sigma is None else _array("sigma", sigma, 2)
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
            object.__setattr__(self, key, value)


@dataclasses.dataclass(frozen=True, eq=False)
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
    - `depth`: metres of the camera below the surface; charts are taken to hang at its depth plus
      what their line of sight descends.
    - `depth_sd`: relative standard deviation of `depth`.
    - `solar_zenith`: degrees in air.
    - `azimuth`: degrees between the camera's heading and the sun's, 0 looking towards the sun.
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
    source: str
    masked: int
    pixels: Pixels | None
    exposure: float | None
    exposure_sd: float

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
        depth_sd=0.02,
        solar_zenith: Any = 40.0,
        azimuth: Any = 90.0,
        source="memory",
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
        readings = [item.values for item in charts + backgrounds]
        usable = sum(int(np.sum(np.isfinite(v) & (v > 0))) for v in readings)
        total = sum(v.size for v in readings)
        if exposure is not None and not (exposure > 0 and exposure_sd > 0):
            raise ValueError(
                f"exposure and exposure_sd must be positive, not {exposure} and {exposure_sd}."
            )
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
            ("azimuth", float(azimuth)),
            ("source", source),
            ("masked", total - usable + (0 if pixels is None else pixels.masked)),
            ("pixels", pixels),
            ("exposure", None if exposure is None else float(exposure)),
            ("exposure_sd", float(exposure_sd)),
        ):
            object.__setattr__(self, key, value)


_COEFFICIENTS = ("a", "b", "c")


@dataclasses.dataclass(frozen=True, eq=False)
class Bulk:
    """Measured absorption, scattering and beam attenuation of a medium, any of the three.

    **Arguments:**

    - `wavelength`: (wl,) nm, strictly increasing.
    - `a`, `b`, `c`: (wl,) 1/m, or `None`.  NaN, zero and negative values are masked and counted in
      `masked`.  Three that satisfy c = a + b are two measurements: c is then left out.
    - `sigma`: standard deviation in 1/m: a number, (wl,) for all, or a mapping by name; `None`
      estimates one relative noise for all from the residuals of the fit, which then also holds
      what the model does not describe.
    - `floor`: 1/m, absolute noise beside the relative one, used when `sigma` is None.
    - `source`: where the numbers come from, for reports.

    `values`, `mask`: (coefficient, wl), one row per name in `names`.
    """

    wavelength: Float[np.ndarray, " wl"]
    names: tuple[str, ...]
    values: Float[np.ndarray, "coefficient wl"]
    sigma: Float[np.ndarray, "coefficient wl"] | None
    floor: float
    mask: Bool[np.ndarray, "coefficient wl"]
    source: str

    def __init__(
        self, wavelength, a=None, b=None, c=None, sigma=None, floor: Any = 0.0, source="memory"
    ):
        wavelength = check_wavelength(wavelength)
        given = {k: v for k, v in zip(_COEFFICIENTS, (a, b, c), strict=True) if v is not None}
        if not given:
            raise ValueError("Bulk needs at least one of a, b and c.")
        rows = {name: _array(name, value, 1) for name, value in given.items()}
        for name, row in rows.items():
            if row.shape != wavelength.shape:
                raise ValueError(
                    f"{name} must have one value per wavelength, {len(wavelength)}, not {len(row)}."
                )
        if len(rows) == 3 and np.allclose(
            rows["c"], rows["a"] + rows["b"], rtol=1e-9, atol=0.0, equal_nan=True
        ):
            del rows["c"]
        values = np.stack(list(rows.values()))
        mask = np.isfinite(values) & (values > 0)
        if sigma is not None:
            sigma = _bulk_sigma(sigma, tuple(rows), values.shape)
        for name, kept in zip(rows, mask.sum(axis=1), strict=True):
            if kept == 0:
                raise ValueError(f"{name} holds no finite positive value.")
        if not (np.isfinite(floor) and floor >= 0):
            raise ValueError(f"floor must be at least 0 1/m, not {floor}.")
        for key, value in (
            ("wavelength", wavelength),
            ("names", tuple(rows)),
            ("values", values),
            ("sigma", sigma),
            ("floor", float(floor)),
            ("mask", mask),
            ("source", source),
        ):
            object.__setattr__(self, key, value)

    @property
    def masked(self) -> int:
        """How many values were missing, zero or negative."""
        return int((~self.mask).sum())


def _bulk_sigma(sigma, names: tuple[str, ...], shape: tuple[int, int]) -> np.ndarray:
    """(coefficient, wl) standard deviations."""
    if isinstance(sigma, Mapping):
        missing = [name for name in names if name not in sigma]
        if missing:
            raise ValueError(f"sigma lacks {', '.join(missing)}; it must name every coefficient.")
        rows = [np.asarray(sigma[name], dtype=np.float64) for name in names]
    else:
        rows = [np.asarray(sigma, dtype=np.float64)] * len(names)
    for row in rows:
        if row.shape not in ((), shape[1:]):
            raise ValueError(
                f"sigma must be a number or have one value per wavelength, {shape[1]}, not shape "
                f"{row.shape}."
            )
        if not np.all(np.isfinite(row) & (row > 0)):
            raise ValueError("sigma must be positive and finite, in 1/m.")
    return np.stack([np.broadcast_to(row, shape[1:]) for row in rows])
