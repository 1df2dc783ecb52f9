"""What upward light and the light above add to Kd: Ku, KLu, R, Rrs, nLw at the surface."""

from collections.abc import Mapping

import numpy as np

from fitting.core.result import Quantity
from fitting.observations.profile import Profile
from fitting.observations.profile_sensor import MIN_DEPTHS
from fitting.profile.kd.band_fit import BandFit, thickness
from fitting.profile.kd.cast import Cast, FitWindow, bands_with_light

_INDEX = 1.34
# Sky light as a share of the light above, its reflectance, and that of upward light from below;
# Eu/Lu where only Lu was measured; all within `_CROSSING`, relative, in Ed.
_SKY, _SKY_REFLECTED, _BACK, _Q = 0.3, 0.066, 0.48, 4.0
_CROSSING = 0.02
_HALF_BAND = 5.0


def upward_notes(cast: Cast) -> dict:
    """Metadata on upward light; none without."""
    profile, notes = cast.window.profile, {}
    for kind, window in cast.windows.items():
        if kind != "Ed":
            notes[f"{kind}_interfaces_m"] = window.interfaces.tolist()
            notes[f"{kind}_deepest_used_m"] = [
                float(window.profile.depth[m].max()) for m in window.mask.T
            ]
    if len(cast.windows) > 1:
        notes["upward_sensors_below_m"] = profile.upward_below
        notes["light_above"] = (
            "from Ed(0-) through a flat surface" if profile.Es is None else "measured"
        )
    return notes | {f"{kind}_left_out": sentence for kind, sentence in cast.notes.items()}


def mean_attenuation(window: FitWindow, fit: BandFit, text: str) -> Quantity:
    """K from the shallowest to the deepest sample used, the mean over layers by thickness."""
    x, cov = np.asarray(fit.x), np.asarray(fit.covariance)
    kd = np.exp(x[:, 1:])
    if kd.shape[1] == 1:
        mean, share = kd[:, 0], np.ones_like(kd)
    else:
        path = thickness(window.profile.depth, window.interfaces)
        reach = np.array([path[m][-1] - path[m][0] for m in window.mask.T])
        parts = reach * kd
        mean = parts.sum(axis=1) / reach.sum(axis=1)
        share = parts / parts.sum(axis=1, keepdims=True)
    variance = np.einsum("wi,wij,wj->w", share, cov[:, 1:, 1:], share)
    return Quantity(mean, np.sqrt(variance), "m-1", text, dof=_dof(window, fit))


def _dof(window: FitWindow, fit: BandFit) -> np.ndarray | None:
    return None if window.profile.sigma is not None else np.asarray(fit.dof)


def _surface(window: FitWindow, fit: BandFit, unit: str, text: str, kind: str) -> Quantity:
    sd = np.sqrt(np.asarray(fit.covariance)[:, 0, 0])
    if window.extrapolation is not None:
        sd = np.hypot(sd, window.extrapolation)
    value = np.exp(np.asarray(fit.x)[:, 0])
    return Quantity(value, sd, unit, text, dof=_dof(window, fit), kind=kind)


def cast_quantities(cast: Cast, fits: Mapping[str, BandFit]) -> dict[str, Quantity]:
    """Kd and light just below the surface of each kind, and what follows, on the Ed bands.

    R = Eu(0-)/Ed(0-); Rrs = Lw/Es with Lw = Lu(0-) (1 - F)/n^2, n = 1.34, and Es as measured or,
    without that, from Ed(0-) through a flat surface (2 % more error); nLw = Rrs F0.  The errors
    of Ed and of upward light count as independent, calibrations as exact.
    """
    profile = cast.window.profile
    text = "downward irradiance just below the surface"
    found = {
        "Kd": mean_attenuation(cast.window, fits["Ed"], "diffuse attenuation coefficient"),
        "Ed_0": _surface(cast.window, fits["Ed"], "W m-2 nm-1", text, "Ed"),
    }
    units = {"Eu": ("Ku", "W m-2 nm-1", "upward irradiance"),
             "Lu": ("KLu", "W m-2 nm-1 sr-1", "upward radiance")}  # fmt: skip
    for kind, (name, unit, words) in units.items():
        if kind in cast.windows:
            window, fit, to = cast.windows[kind], fits[kind], cast.bands[kind]
            enough = np.asarray(fit.used).sum(axis=1) >= MIN_DEPTHS
            good = bands_with_light(window) & enough & (np.asarray(fit.code) == 0)
            text = f"diffuse attenuation coefficient of {words}"
            found[name] = _placed(mean_attenuation(window, fit, text), to, good)
            text = f"{words} just below the surface"
            found[f"{kind}_0"] = _placed(_surface(window, fit, unit, text, kind), to, good)
    if "Eu_0" in found:
        found["R"] = _ratio(found["Eu_0"], found["Ed_0"], "1", "irradiance reflectance at 0-")
    if "Lu_0" in found:
        found |= _leaving(profile, found)
    return found


def _leaving(profile: Profile, found: Mapping[str, Quantity]) -> dict[str, Quantity]:
    leaving = (1.0 - _reflected(0.0)) / _INDEX**2
    Lu = found["Lu_0"]
    text = "remote sensing reflectance"
    if profile.Es is not None:
        quiet = np.zeros_like(profile.Es)
        above = Quantity(profile.Es, quiet, "W m-2 nm-1", "", dof=None)
    else:
        zenith = 40.0 if profile.solar_zenith is None else profile.solar_zenith
        entering = 1.0 - (1.0 - _SKY) * _reflected(zenith) - _SKY * _SKY_REFLECTED
        up = found["Eu_0"].value if "Eu_0" in found else np.full_like(Lu.value, np.nan)
        up = np.where(np.isfinite(up), up, _Q * Lu.value)
        Ed = found["Ed_0"]
        value = (Ed.value - _BACK * up) / entering
        above = Quantity(value, np.hypot(Ed.sd, _CROSSING), Ed.unit, "", dof=Ed.dof)
    rrs = _ratio(Lu, above, "sr-1", text, leaving)
    out = {"Rrs": rrs}
    sunlight = _sunlight(profile.wavelength)
    if sunlight is not None:
        text = "normalized water-leaving radiance"
        unit = "W m-2 nm-1 sr-1"
        out["nLw"] = Quantity(rrs.value * sunlight, rrs.sd, unit, text, dof=rrs.dof)
    return out


def _reflected(zenith: float) -> float:
    """Fresnel reflectance of the surface from above; degrees in air.

    `oceaninv.optics` has it for JAX, whose first call would cost a compilation.
    """
    outside = np.cos(np.radians(zenith))
    inside = np.sqrt(1.0 - (1.0 - outside**2) / _INDEX**2)
    across = (outside - _INDEX * inside) / (outside + _INDEX * inside)
    along = (_INDEX * outside - inside) / (_INDEX * outside + inside)
    return float(0.5 * (across**2 + along**2))


def _sunlight(wavelength: np.ndarray) -> np.ndarray | None:
    """F0, W m-2 nm-1 at the mean distance of the sun, over 10 nm (ASTM G173-03, from pvlib).

    None without pvlib.
    """
    try:
        from pvlib.spectrum import get_reference_spectra
    except ImportError:
        return None
    table = get_reference_spectra()["extraterrestrial"]
    grid, value = np.asarray(table.index, float), np.asarray(table, float)
    near = [(grid >= wl - _HALF_BAND) & (grid <= wl + _HALF_BAND) for wl in wavelength]
    return np.array([value[n].mean() for n in near])


def _placed(quantity: Quantity, bands: np.ndarray, good: np.ndarray) -> Quantity:
    """On all bands of the profile, NaN where absent or not found."""

    def wide(array: np.ndarray) -> np.ndarray:
        full = np.full(len(bands), np.nan)
        full[bands] = np.where(good, array, np.nan)
        return full

    dof = None if quantity.dof is None else wide(quantity.dof)
    unit, text = quantity.unit, quantity.long_name
    return Quantity(wide(quantity.value), wide(quantity.sd), unit, text, dof=dof)


def _ratio(over: Quantity, under: Quantity, unit: str, text: str, factor: float = 1.0) -> Quantity:
    """A ratio of independent quantities; degrees of freedom by Welch & Satterthwaite."""
    first, second = (np.minimum(q.sd, 1e6) ** 2 for q in (over, under))
    total = first + second
    dof = None
    if over.dof is not None or under.dof is not None:
        rest = [
            np.zeros_like(v) if q.dof is None else v**2 / q.dof
            for v, q in ((first, over), (second, under))
        ]
        dof = total**2 / np.maximum(rest[0] + rest[1], 1e-300)
    return Quantity(factor * over.value / under.value, np.sqrt(total), unit, text, dof=dof)
