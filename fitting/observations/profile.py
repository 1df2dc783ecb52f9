"""Casts of irradiance, and of absorption and attenuation with them."""

import copy
import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from fitting.observations.array_checks import as_array
from fitting.observations.profile_sensor import (
    MIN_DEPTHS,
    darkness,
    noise_floor,
    smooth_reference,
    thinned,
)
from oceaninv.foundation.tables import check_wavelength


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
    - `Eu`, `Lu`: (depth, wl) upward irradiance and radiance (per sr) of the same bands, in the unit
      of Ed; NaN where absent.
    - `surface`: (depth, wl) irradiance above the water at the same moments.  Its slow changes are
      divided out of all light below; quick ones and dips that end, such as those of a shadow band,
      are not.
    - `PAR`: (depth,) photosynthetically available radiation, any unit.
    - `a`, `c`: (depth, beam) absorption and beam attenuation without pure water's, 1/m, at
      `beam_wavelength` (beam,) nm, strictly increasing, as AC-9 and AC-S give them; NaN where
      absent.  Fits of constituents use their means over the water whose light they use.
    - `upward_below`: metres from the sensor of Ed down to those of Eu and Lu.
    - `calibrated`: whether `surface` is in the unit of Ed; if not, only its changes are used.
    - `tilt`: (depth,) degrees, for reports.
    - `counts`: what was left out before, by reason, for reports.

    Casts of more than 2,048 samples are reduced to medians of neighbours in depth.  `dark`,
    `dark_sd` (wl,): the reading in darkness, where the cast reaches it, else 0; `reference`
    (depth, wl): the light above relative to its median; `Es` (wl,): that median in the unit of Ed,
    None if it is not known.

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
        beam_wavelength=None,
        a=None,
        c=None,
        upward_below: float = 0.0,
        calibrated: bool = True,
        counts: Mapping[str, int] | None = None,
    ):
        depth, wavelength = as_array("depth", depth, 1), check_wavelength(wavelength)
        Ed = as_array("Ed", Ed, 2)
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
                array = as_array(name, value, 2 if name in tables else 1)
                if array.shape != (Ed.shape if name in tables else depth.shape):
                    raise ValueError(
                        f"{name if name != 'reference' else 'surface'} must have the shape of "
                        f"{'Ed' if name in tables else 'depth'}, "
                        f"{Ed.shape if name in tables else depth.shape}."
                    )
                (tables if name in tables else lines)[name] = array
        beam_wavelength, beams = _beams(len(depth), beam_wavelength, {"a": a, "c": c})
        level = None
        if surface is not None:
            tables["reference"], level = smooth_reference(tables["reference"])
        order = np.argsort(depth, kind="stable")
        data = {"depth": depth, **tables, **lines, **beams}
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
            "beam_wavelength": beam_wavelength,
            "floor": floor,
            "mask": mask,
            "solar_zenith": solar_zenith,
            "source": source,
            "Es": level if calibrated else None,
            "upward_below": float(upward_below),
            "dark": dark,
            "dark_sd": dark_sd,
            "counts": counts,
        }.items():
            object.__setattr__(self, name, value)

    @property
    def masked(self) -> int:
        """How many values were missing, zero, negative or above the surface."""
        return int((~self.mask).sum())

    def of_bands(self, bands: Bool[np.ndarray, " wl"]) -> "Profile":
        """The same cast with some of its bands alone."""
        made = copy.copy(self)
        for name in ("wavelength", "floor", "dark", "dark_sd", "Es"):
            value = getattr(self, name)
            object.__setattr__(made, name, None if value is None else value[bands])
        for name in ("Ed", "sigma", "mask", "Eu", "Lu", "reference"):
            value = getattr(self, name)
            object.__setattr__(made, name, None if value is None else value[:, bands])
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
            reference = self.reference[:, bands]
            object.__setattr__(made, "reference", reference)
            object.__setattr__(made, "mask", made.mask & (reference > 0))
        return made, bands


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
