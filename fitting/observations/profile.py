"""Casts of irradiance, and of absorption and attenuation with them."""

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.observations.array_checks import as_array
from fitting.observations.profile_sensor import (
    MIN_DEPTHS,
    darkness,
    isolated_values,
    noise_floor,
    segments,
    shaded,
    smooth_reference,
    thinned,
)
from oceaninv.foundation.argument_names import names_checked
from oceaninv.foundation.tables import check_wavelength


@dataclasses.dataclass(eq=False, init=False)
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
    - `Eu`, `Lu`: (depth, wl) upward irradiance and radiance (per sr) of the same bands, in the unit
      of Ed; NaN where absent.
    - `surface`: (depth, wl) irradiance above the water at the same moments.  Its slow changes are
      divided out of all light below; quick ones and dips that end, such as those of a shadow band,
      are not.
    - `PAR`: (depth,) photosynthetically available radiation in `PAR_unit`, None where that is not
      known: then its depths are found, and no amount.
    - `a`, `c`: (depth, beam) absorption and beam attenuation without pure water's, 1/m, at
      `beam_wavelength` (beam,) nm, strictly increasing, as AC-9 and AC-S give them; NaN where
      absent.  Fits of constituents use their means over the water whose light they use.
    - `upward_below`: metres from the sensor of Ed down to those of Eu and Lu.
    - `calibrated`: whether `surface` is in the unit of Ed; if not, only its changes are used.
    - `tilt`: (depth,) degrees, for reports.
    - `counts`: what was left out before, by reason, for reports.
    - `station`: where, when and by what the cast was measured, as far as it is known, for reports:
      latitude (degrees north), longitude (degrees east), time (UTC, ISO 8601), platform, cycle.

    Casts of more than 2,048 samples, and casts that stay at one depth for long, are reduced to
    medians over bins of depth.  Samples in shade and values beyond all others are masked and
    counted.  `dark`, `dark_sd` (wl,): the reading in darkness, where the cast reaches it, else 0;
    `reference` (depth, wl): the light above relative to its median; `Es` (wl,): that median in the
    unit of Ed, None if it is not known; `segment` (depth,): which way down or up a sample belongs
    to, in the order of measurement; `shade` (depth,): which samples are left out as shaded.

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
    Es: Float[np.ndarray, " wl"] | None
    upward_below: float
    PAR: Float[np.ndarray, " depth"] | None
    beam_wavelength: Float[np.ndarray, " beam"]
    a: Float[np.ndarray, "depth beam"] | None
    c: Float[np.ndarray, "depth beam"] | None
    tilt: Float[np.ndarray, " depth"] | None
    dark: Float[np.ndarray, " wl"]
    dark_sd: Float[np.ndarray, " wl"]
    counts: dict[str, int]
    PAR_unit: str | None
    station: dict[str, float | str | int]
    segment: Int[np.ndarray, " depth"]
    shade: Bool[np.ndarray, " depth"]

    @names_checked
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
        PAR_unit: str | None = "umol m-2 s-1",
        tilt=None,
        beam_wavelength=None,
        a=None,
        c=None,
        upward_below: float = 0.0,
        calibrated: bool = True,
        counts: Mapping[str, int] | None = None,
        station: Mapping[str, float | str | int] | None = None,
    ):
        if solar_zenith is not None and not 0 <= solar_zenith < 90:
            raise ValueError(f"solar_zenith must lie in [0, 90) degrees, not {solar_zenith:g}.")
        self.wavelength, self.solar_zenith = check_wavelength(wavelength), solar_zenith
        self.source, self.upward_below = source, float(upward_below)
        self.counts, self.PAR_unit = dict(counts or {}), PAR_unit
        self.station = dict(station or {})
        data = _checked(depth, self.wavelength, Ed, sigma, Eu, Lu, surface, PAR, tilt)
        self.beam_wavelength, beams = _beams(len(data["depth"]), beam_wavelength, {"a": a, "c": c})
        self.Es = None
        if surface is not None:
            data["reference"], level = smooth_reference(data["reference"])
            self.Es = level if calibrated else None
        data |= beams
        data["segment"] = segments(data["depth"])
        order = np.argsort(data["depth"], kind="stable")
        data, notes = thinned({k: None if v is None else v[order] for k, v in data.items()})
        self.counts |= notes
        for name, value in data.items():
            setattr(self, name, value)
        self.segment = data["segment"].astype(int)
        self._mask_what_is_no_light()
        if floor is None:
            noisy = noise_floor(self.Ed - self.dark, self.mask)
            floor = np.where(self.dark_sd > 0, self.floor, noisy)
        self.floor = np.broadcast_to(np.asarray(floor, np.float64), self.wavelength.shape).copy()

    def _mask_what_is_no_light(self) -> None:
        """Find the reading in darkness, then what is missing, absurd or shaded."""
        isolated = isolated_values(self.Ed)
        self.Ed = np.where(isolated, np.nan, self.Ed)
        self.dark, self.dark_sd, self.floor = darkness(self.Ed)
        # Zero is what a digital sensor writes for nothing; negative noise around darkness is data.
        least = np.where(self.dark_sd > 0, self.dark - 5.0 * self.floor, 0.0)
        mask = np.isfinite(self.Ed) & (self.Ed != 0) & (self.Ed > least)
        mask &= (self.depth >= 0)[:, None]
        if self.sigma is not None:
            mask &= np.isfinite(self.sigma) & (self.sigma > 0)
        light = self.Ed - self.dark
        if self.reference is not None:
            mask &= np.isfinite(self.reference) & (self.reference > 0)
            light = light / np.where(mask, self.reference, 1.0)
        self.shade = shade = shaded(self.depth, light, mask, self.segment)
        self.mask = mask & ~shade[:, None]
        self.counts |= {
            reason: int(count)
            for reason, count in (
                ("values above 1,000 times their neighbours", isolated.sum()),
                ("samples darker than light further down (shade, a covered sensor)", shade.sum()),
            )
            if count
        }
        for band, kept in zip(self.wavelength, self.mask.sum(axis=0), strict=True):
            if kept < MIN_DEPTHS:
                shaded_too = f", {int(shade.sum())} of which lie in shade" if shade.any() else ""
                raise ValueError(
                    f"the band at {band:g} nm keeps {kept} of {len(self.depth)} depths after "
                    f"masking missing and non-positive irradiance{shaded_too}; at least "
                    f"{MIN_DEPTHS} are needed."
                )

    @property
    def masked(self) -> int:
        """How many values were missing, zero, negative or above the surface."""
        return int((~self.mask).sum())

    def of_bands(self, bands: Bool[np.ndarray, " wl"]) -> "Profile":
        """The same cast with some of its bands alone."""
        made = copy.copy(self)
        for name in ("wavelength", "floor", "dark", "dark_sd", "Es"):
            value = getattr(self, name)
            setattr(made, name, None if value is None else value[bands])
        for name in ("Ed", "sigma", "mask", "Eu", "Lu", "reference"):
            value = getattr(self, name)
            setattr(made, name, None if value is None else value[:, bands])
        return made

    def upward(self, kind: str, depth_range=(0.0, np.inf)) -> "tuple[Profile, np.ndarray] | None":
        """A profile with "Eu" or "Lu" in the place of Ed, and which bands (wl,) it holds.

        Those with at least 5 positive samples in the range of depths; None if there are none.
        """
        values = getattr(self, kind)
        if values is None:
            return None
        depth = self.depth + self.upward_below
        inside = (depth >= max(depth_range[0], 0.0)) & (depth <= depth_range[1])
        seen = np.isfinite(values) & (values > 0) & inside[:, None]
        if self.reference is not None:
            seen &= np.isfinite(self.reference) & (self.reference > 0)
        bands = seen.sum(axis=0) >= MIN_DEPTHS
        if not bands.any():
            return None
        made = Profile(
            depth,
            self.wavelength[bands],
            values[:, bands],
            solar_zenith=self.solar_zenith,
            source=f"{self.source}, {kind}",
        )
        if self.reference is not None:
            made.reference = self.reference[:, bands]
            made.mask = made.mask & (made.reference > 0)
        made.segment = self.segment
        return made, bands


def _checked(depth, wavelength, Ed, sigma, Eu, Lu, surface, PAR, tilt) -> dict[str, Any]:
    """The arrays along depth as float64, by name; ValueError where a shape does not fit."""
    depth, Ed = as_array("depth", depth, 1), as_array("Ed", Ed, 2)
    if Ed.shape != (len(depth), len(wavelength)):
        raise ValueError(
            f"Ed must have shape (depth, wl) = ({len(depth)}, {len(wavelength)}), not {Ed.shape}."
        )
    if not np.all(np.isfinite(depth)):
        raise ValueError(f"depth holds {int(np.sum(~np.isfinite(depth)))} missing values.")
    data: dict[str, Any] = {"depth": depth, "Ed": Ed}
    tables = {"sigma": sigma, "Eu": Eu, "Lu": Lu, "surface": surface}
    for given, like, shape in ((tables, "Ed", Ed.shape), ({"PAR": PAR, "tilt": tilt}, "depth",
                                                           depth.shape)):  # fmt: skip
        for name, value in given.items():
            array = None if value is None else as_array(name, value, len(shape))
            if array is not None and array.shape != shape:
                raise ValueError(f"{name} must have the shape of {like}, {shape}.")
            data["reference" if name == "surface" else name] = array
    return data


def _beams(count: int, wavelength, given: dict) -> tuple[np.ndarray, dict]:
    """Wavelengths of a and c, none if they are absent, and both, checked."""
    if wavelength is None:
        if any(value is not None for value in given.values()):
            raise ValueError("a and c need beam_wavelength, the wavelengths of their columns, nm.")
        return np.zeros(0), dict.fromkeys(given)
    wavelength = check_wavelength(wavelength)
    beams = {k: None if v is None else as_array(k, v, 2) for k, v in given.items()}
    for name, array in beams.items():
        if array is not None and array.shape != (count, len(wavelength)):
            raise ValueError(
                f"{name} must have shape (depth, beam) = ({count}, {len(wavelength)}), "
                f"not {array.shape}."
            )
    return wavelength, beams
