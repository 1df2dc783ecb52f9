"""Which samples of a cast are fitted, and where layers meet."""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from fitting.observations.profile import Profile
from fitting.observations.profile_sensor import MIN_DEPTHS
from fitting.profile.kd.layer_selection import choose_interfaces
from fitting.profile.kd.noise_statistics import MOST_CORRELATED, forward_fill, running_median

# Samples below which a change of slope cannot be told from noise.
_LEAST_STRAIGHT = 10


def light_of(profile: Profile) -> np.ndarray:
    """(depth, wl) irradiance less darkness, over the light above."""
    light = profile.Ed - profile.dark
    return light if profile.reference is None else light / profile.reference


def light_level_mask(profile: Profile, level: float = 0.1) -> np.ndarray:
    """(depth, wl) mask of the samples above the depth where Ed falls to `level` of its maximum.

    The maximum and the crossing are taken on a running median of nine, which single waves do not
    move.  A band that never falls so far, or does so within 5 samples, is used as it is.
    """
    mask = profile.mask
    smooth = forward_fill(np.where(mask, light_of(profile), 0.0), mask)
    smooth = running_median(smooth) if len(smooth) >= 5 else smooth
    top = np.max(np.where(mask, smooth, -np.inf), axis=0)
    dark = mask & (smooth < level * top) & (np.cumsum(mask, axis=0) > MIN_DEPTHS)
    return mask & ~np.logical_or.accumulate(dark, axis=0)


def selected_samples(profile: Profile, depth_range) -> tuple[np.ndarray, str]:
    """The samples to use, (depth, wl), and which mean Kd they make."""
    if depth_range is None:
        return light_level_mask(profile), "mean from the surface to the depth of 10 % light"
    low, high = depth_range
    mask = profile.mask & ((profile.depth >= low) & (profile.depth <= high))[:, None]
    for band, count in zip(profile.wavelength, mask.sum(axis=0), strict=True):
        if count < MIN_DEPTHS:
            raise ValueError(
                f"depth_range {low:g}-{high:g} m leaves {count} usable depths at {band:g} nm; at "
                f"least {MIN_DEPTHS} are needed."
            )
    return mask, f"mean over {low:g} to {high:g} m"


def padded_length(count: int) -> int:
    """Depths are padded to a power of two, so that casts of many lengths share a program."""
    return max(32, 1 << (count - 1).bit_length())


@dataclasses.dataclass(frozen=True)
class FitWindow:
    """One cast, the samples to use and where its layers meet; `extrapolation` (wl,): relative error
    of the light just below the surface beside that of the fit, None for none."""

    profile: Profile
    mask: np.ndarray
    interfaces: np.ndarray
    extrapolation: np.ndarray | None = None

    @property
    def shape(self) -> tuple[int, bool, int]:
        """What decides which program fits it: depths, whether errors are given, interfaces."""
        return padded_length(self.rows), self.profile.sigma is not None, len(self.interfaces)

    @functools.cached_property
    def rows(self) -> int:
        """Rows down to the deepest sample used."""
        return int(np.flatnonzero(self.mask.any(axis=1))[-1]) + 1


@dataclasses.dataclass(frozen=True)
class Cast:
    """What is fitted of one profile: "Ed" and, where there are any, "Eu" and "Lu".

    `bands`: which of the profile's bands a kind holds; `definition`: which mean Kd this is;
    `notes`: sentences on upward light that could not be used.
    """

    windows: Mapping[str, FitWindow]
    bands: Mapping[str, np.ndarray]
    definition: str
    notes: Mapping[str, str]

    @property
    def window(self) -> FitWindow:
        """That of Ed."""
        return self.windows["Ed"]


def cast_of(profile: Profile, depth_range, layers: int | None) -> Cast:
    """The samples to use and where layers meet.  Eu and Lu have windows and layers of their own.

    Raises ValueError where Ed cannot be used; upward light that cannot be is left out and noted.
    """
    if layers is not None and layers < 1:
        raise ValueError(f"layers is {layers}; give 1 or more, or None to let the data choose.")
    window, definition = _window(profile, depth_range, layers)
    windows, bands = {"Ed": window}, {"Ed": np.ones(len(profile.wavelength), bool)}
    notes = {}
    for kind in ("Eu", "Lu"):
        try:
            found = profile.upward(kind, depth_range or (0.0, np.inf))
            if found is not None:
                upward = _window(found[0], depth_range, layers)[0]
                if layers == 1 and depth_range is None:
                    upward = straight_part(upward)
                windows[kind] = upward
                bands[kind] = found[1]
        except ValueError as error:
            notes[kind] = str(error)
    return Cast(windows, bands, definition, notes)


def _window(profile: Profile, depth_range, layers) -> tuple[FitWindow, str]:
    mask, definition = selected_samples(profile, depth_range)
    interfaces = np.zeros(0)
    if layers != 1:
        interfaces = choose_interfaces(
            profile.depth, light_of(profile), profile.floor, mask, layers
        )
    return FitWindow(profile, mask, interfaces), definition


def straight_part(window: FitWindow) -> FitWindow:
    """The window of each band as deep as ln light is a straight line.

    Upward light is not one exponential near a floor, where Raman scattering and fluorescence make
    it, or across layers: its slope changes, and what is extrapolated to the surface errs.  From
    the deep end a seventh of the window at a time is left out until a quadratic fits no better
    (t below 3, neighbours' correlation allowed for), or a third of it is left.  By how much more
    than noise a quadratic departs from the line at the surface is the error of extrapolation.
    """
    mask, depth, light = window.mask.copy(), window.profile.depth, light_of(window.profile)
    extrapolation = np.zeros(mask.shape[1])
    for band in range(mask.shape[1]):
        rows = np.flatnonzero(mask[:, band] & (light[:, band] > 0))
        if len(rows) == 0:
            continue
        least = max(_LEAST_STRAIGHT, len(rows) // 3)
        bent = _Quadratic(depth[rows], np.log(light[rows, band]))
        while len(rows) * 6 // 7 >= least and abs(bent.curvature) > 3.0 * bent.sd:
            rows = rows[: len(rows) * 6 // 7]
            bent = _Quadratic(depth[rows], np.log(light[rows, band]))
        mask[rows[-1] + 1 :, band] = False
        extrapolation[band] = bent.extrapolation_error
    return FitWindow(window.profile, mask, window.interfaces, extrapolation)


class _Quadratic:
    """A parabola through ln light: its curvature, the standard deviation of that (neighbours'
    correlation allowed for), and by how much more than noise it departs from a line at depth 0.
    """

    def __init__(self, depth: np.ndarray, log_light: np.ndarray):
        scale = max(float(np.ptp(depth)), 1e-12)
        away = (depth - depth.mean()) / scale
        design = np.stack([np.ones_like(away), away, away**2], axis=1)
        inverse = np.linalg.pinv(design.T @ design)
        beta = inverse @ design.T @ log_light
        left = log_light - design @ beta
        square = float(left @ left)
        rho = float(np.clip(left[1:] @ left[:-1] / max(square, 1e-300), 0.0, MOST_CORRELATED))
        variance = max(square / max(len(left) - 3, 1), 1e-20) * (1.0 + rho) / (1.0 - rho)
        self.curvature, self.sd = float(beta[2]), float(np.sqrt(variance * inverse[2, 2]))
        # What leaving the curvature out moves at the surface is proportional to it.
        at = np.array([1.0, -depth.mean() / scale, (depth.mean() / scale) ** 2])
        line = np.linalg.pinv(design[:, :2]) @ design[:, 2]
        lever = at[2] - at[:2] @ line
        excess = max(self.curvature**2 - self.sd**2, 0.0)
        self.extrapolation_error = float(abs(lever) * np.sqrt(excess))


def bands_with_light(window: FitWindow) -> np.ndarray:
    """(wl,) whether the window holds light that stands out of the noise in darkness."""
    light = np.where(window.mask, light_of(window.profile), -np.inf)
    return np.partition(light, -MIN_DEPTHS, axis=0)[-MIN_DEPTHS] > 5.0 * window.profile.floor
