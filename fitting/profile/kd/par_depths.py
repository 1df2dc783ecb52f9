"""Depths to which a share of the photosynthetically available radiation (PAR) comes.

PAR counts photons, 400-700 nm, umol m-2 s-1.
"""

import dataclasses

import numpy as np

from fitting.core.result import Quantity
from fitting.observations.profile import Profile
from fitting.observations.profile_sensor import MIN_DEPTHS, noise_floor
from fitting.profile.kd.band_fit import BandFit, thickness
from fitting.profile.kd.cast import FitWindow
from fitting.profile.kd.layer_selection import choose_interfaces, line_fit
from fitting.profile.kd.noise_statistics import forward_fill, running_median

# Photons of 1 nm that carry one joule, umol: wavelength/(h c N_A).
_PHOTONS = 1e-3 / 0.119626566
_WIDEST = 80.0
_DARKEST = 0.005  # of the light near the surface, below which PAR sensors see their own darkness
# Times the deepest sample to which light is extrapolated.
_BEYOND = 10.0
SHARES = {"Z_10": (0.1, "10 %"), "Z_eu": (0.01, "1 %")}


@dataclasses.dataclass(frozen=True)
class Light:
    """PAR as a sum of exponentials: `weight` (band,), `x` (band, 1 + layer) as of `BandFit`,
    `covariance`, `dof` (None: noise given), `interfaces` m, `deepest` m that was seen."""

    weight: np.ndarray
    x: np.ndarray
    covariance: np.ndarray
    dof: float | None
    interfaces: np.ndarray
    deepest: float

    def at(self, depth: float) -> tuple[float, np.ndarray, float]:
        """PAR, its slopes by x (band, 1 + layer), and its slope by depth."""
        path = thickness(np.array([depth]), self.interfaces)[0]
        kd = np.exp(self.x[:, 1:])
        part = self.weight * np.exp(self.x[:, 0] - kd @ path)
        slopes = part[:, None] * np.concatenate([np.ones_like(part)[:, None], -kd * path], axis=1)
        here = int(np.searchsorted(self.interfaces, depth, side="right"))
        return float(part.sum()), slopes, float(-part @ kd[:, here])

    def spread(self, slopes: np.ndarray) -> float:
        """Standard deviation of what moves by `slopes`: all bands err together, as waves make
        them, so that their deviations add."""
        variance = np.einsum("wi,wij,wj->w", slopes, self.covariance, slopes)
        return float(np.sqrt(np.maximum(variance, 0.0)).sum())


def photon_weights(wavelength: np.ndarray) -> np.ndarray | None:
    """(wl,) umol m-2 s-1 of PAR per W m-2 nm-1 of each band; None if they do not span it.

    The spectrum is taken as straight between bands and level beyond the outermost, which must lie
    below 430 and above 650 nm; no gap may be wider than 80 nm.
    """
    inside = wavelength[(wavelength >= 400.0) & (wavelength <= 700.0)]
    if len(inside) == 0 or inside[0] > 430.0 or inside[-1] < 650.0:
        return None
    if np.max(np.diff(inside)) > _WIDEST:
        return None
    grid = np.arange(400.0, 700.5, 1.0)
    photons = _PHOTONS * grid * np.where((grid == 400.0) | (grid == 700.0), 0.5, 1.0)
    hats = [np.interp(grid, wavelength, row) for row in np.eye(len(wavelength))]
    return np.array(hats) @ photons


def light_of_bands(window: FitWindow, bands: BandFit, bright: np.ndarray) -> Light | None:
    """PAR from the fits of the bands that hold light."""
    good = bright & (bands.code == 0)
    weight = photon_weights(window.profile.wavelength[good]) if good.any() else None
    if weight is None:
        return None
    dof = None if window.profile.sigma is not None else float(np.min(bands.dof[good]))
    deepest = float(window.profile.depth[window.mask[:, good].any(axis=1)].max())
    x, covariance = np.asarray(bands.x)[good], np.asarray(bands.covariance)[good]
    return Light(weight, x, covariance, dof, window.interfaces, deepest)


def light_of_sensor(profile: Profile) -> Light | None:
    """PAR as measured: one exponential per layer, as many layers as suffice."""
    if profile.PAR is None:
        return None
    value, depth = profile.PAR[:, None], profile.depth
    mask = np.isfinite(value) & (value > 0) & ((depth >= 0) & ~profile.shade)[:, None]
    if mask.sum() < 2 * MIN_DEPTHS:
        return None
    smooth = running_median(forward_fill(np.where(mask, value, 0.0), mask))
    dark = mask & (smooth < _DARKEST * smooth[mask].max())
    mask &= ~np.logical_or.accumulate(dark, axis=0)
    if mask.sum() < 2 * MIN_DEPTHS:
        return None
    floor = noise_floor(value, mask)
    interfaces = choose_interfaces(depth, value, floor, mask, None)
    beta, covariance, dof = line_fit(depth, value, floor, mask, interfaces)
    kd = np.maximum(-beta[1:], 1e-6)
    x = np.concatenate([beta[:1], np.log(kd)])
    turn = np.concatenate([[1.0], -1.0 / kd])
    covariance = covariance * turn[:, None] * turn[None, :]
    deepest = float(depth[mask[:, 0]].max())
    return Light(np.ones(1), x[None], covariance[None], dof, interfaces, deepest)


def light_quantities(
    light: Light, measured: bool, unit: str | None
) -> tuple[dict[str, Quantity], dict]:
    """PAR just below the surface, and the depths of 10 and of 1 % of it, with notes.

    `unit`: of PAR; without one its amount is left out.  Depths beyond ten times the deepest sample
    are, too: they would be those of the model alone.
    """
    dof = None if light.dof is None else np.array(light.dof)
    total, slopes, _ = light.at(0.0)
    relative = np.array(light.spread(slopes) / total)
    text = "photosynthetically available radiation just below the surface"
    found, beyond = {}, {}
    if unit is not None:
        found["PAR_0"] = Quantity(np.array(total), relative, unit, text, dof=dof)
    for name, (share, words) in SHARES.items():
        depth = _depth_of(light, share)
        if depth > _BEYOND * light.deepest:
            beyond[name] = f"below {_BEYOND:g} times the deepest sample"
            continue
        here, moved, steepness = light.at(depth)
        slope = (moved - here / total * slopes) / -steepness
        sd = np.array(light.spread(slope) / depth)
        text = f"depth of {words} of the photosynthetically available radiation at 0-"
        found[name] = Quantity(np.array(depth), sd, "m", text, dof=dof)
        if depth > light.deepest:
            beyond[name] = f"extrapolated below {light.deepest:.3g} m"
    notes = {
        "PAR": "measured, one exponential per layer"
        if measured
        else "from the bands: photons of 400-700 nm, the spectrum straight between bands and level "
        "beyond the outermost; below the depths used each band goes on with the Kd of its lowest "
        "layer; the bands are taken to err together",
        "PAR_interfaces_m": light.interfaces.tolist(),
    }
    return found, notes | ({"PAR_depths": beyond} if beyond else {})


def _depth_of(light: Light, share: float) -> float:
    """Depth of a share of PAR by bisection: PAR falls everywhere.

    `scipy.optimize.brentq` takes 0.1 s to import, 2 % of a command's time, and this 50 steps.
    """
    target = share * light.at(0.0)[0]
    low, high = 0.0, 1.0
    while light.at(high)[0] > target and high < 1e5:
        low, high = high, 2.0 * high
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if light.at(middle)[0] > target else (low, middle)
    return 0.5 * (low + high)
