"""What upward light and the light above add to Kd: Ku, KLu, R, Rrs, nLw at the surface."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from fitting.core.result import Quantity
from fitting.observations.array_checks import Profile
from fitting.observations.profile_sensor import MIN_DEPTHS
from fitting.profile.constituents.batched_search import Spectra, nodes_and_basis
from fitting.profile.kd.band_fit import BandFit, thickness
from fitting.profile.kd.batching import Job, light_of, padded, window
from fitting.profile.kd.layer_selection import choose_interfaces, worth

_INDEX = 1.34
# Sky light as a share of the light above, its reflectance, and that of upward light from below;
# Eu/Lu where only Lu was measured; all within `_CROSSING`, relative, in Ed.
_SKY, _SKY_REFLECTED, _BACK, _Q = 0.3, 0.066, 0.48, 4.0
_CROSSING = 0.02
_HALF_BAND = 5.0
# What readings of AC-9 and AC-S are worth: calibration, scattered light; relative, and 1/m.
_BEAM_RELATIVE, _BEAM_FLOOR = 0.03, 0.005
# Relative errors of R by closed forms (their docstrings); of exact models, those of the scene.
_REFLECTANCE_ERROR = {"TwoStream": 0.1, "FourStream": 0.05}


@dataclasses.dataclass(frozen=True)
class Cast:
    """What is fitted of one profile: "Ed" and, where there are any, "Eu" and "Lu".

    `bands`: which of the profile's bands a kind holds; `definition`: which mean Kd this is;
    `notes`: sentences on upward light that could not be used.
    """

    jobs: Mapping[str, Job]
    bands: Mapping[str, np.ndarray]
    definition: str
    notes: Mapping[str, str]

    @property
    def job(self) -> Job:
        """That of Ed."""
        return self.jobs["Ed"]


def cast_of(profile: Profile, depth_range, layers: int | None) -> Cast:
    """The samples to use and where layers meet.  Eu and Lu have windows and layers of their own.

    Raises ValueError where Ed cannot be used; upward light that cannot be is left out and noted.
    """
    if layers is not None and layers < 1:
        raise ValueError(f"layers is {layers}; give 1 or more, or None to let the data choose.")
    job, definition = _job(profile, depth_range, layers)
    jobs, bands = {"Ed": job}, {"Ed": np.ones(len(profile.wavelength), bool)}
    notes = {}
    for kind in ("Eu", "Lu"):
        try:
            found = profile.upward(kind, depth_range or (0.0, np.inf))
            if found is not None:
                jobs[kind] = _job(found[0], depth_range, layers)[0]
                bands[kind] = found[1]
        except ValueError as error:
            notes[kind] = str(error)
    return Cast(jobs, bands, definition, notes)


def spectra_of(cast: Cast, fits: Mapping[str, BandFit], transport) -> Spectra:
    """What a fit of constituents sees of a cast: readings of Ed, and R where Eu was measured."""
    job, fit = cast.job, fits["Ed"]
    profile, n = job.profile, job.rows
    depth = profile.depth[:n]
    reference = 1.0 if profile.reference is None else profile.reference[:n]
    path = thickness(depth, job.interfaces)
    start = np.exp(np.clip(fit.x[None, :, 0] - path @ np.exp(fit.x[:, 1:]).T, -300.0, 300.0))
    if profile.sigma is None:
        sd = np.hypot(fit.noise * start, profile.floor / reference)
    else:
        sd = profile.sigma[:n] / reference
    used = fit.used[:, :n].T & job.mask[:n] & (np.asarray(fit.code) == 0)[None, :]
    sd = sd * worth(depth, used, np.asarray(fit.length))
    nodes, basis = nodes_and_basis(depth, float(depth.max()))

    def pad(array, fill):
        widths = [(0, padded(n) - n)] + [(0, 0)] * (array.ndim - 1)
        return np.pad(array, widths, constant_values=fill)

    ln_r, weight = reflected(
        cast_quantities(cast, fits).get("R"), len(profile.wavelength), transport
    )
    light = np.where(used, light_of(profile)[:n], 1.0)
    beam, beam_weight = beam_of(profile, used)
    return Spectra(
        nodes,
        pad(basis, 0.0),
        pad(light, 1.0),
        pad(np.where(used, sd, 1.0), 1.0),
        pad(used, False),
        pad(np.where(used, start, 1.0), 1.0),
        ln_r,
        weight,
        beam,
        beam_weight,
    )


def beam_of(profile: Profile, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2, beam) a and c without pure water's, means over the water whose light is used, and one
    over their deviations: what readings are worth, and the error of a mean over depth."""
    inside = profile.depth <= profile.depth[: len(used)][used.any(axis=1)].max(initial=0.0)
    values, weights = [], []
    for table in (profile.a, profile.c):
        if table is None:
            table = np.full((len(profile.depth), len(profile.beam_wavelength)), np.nan)
        seen = np.isfinite(table) & inside[:, None]
        count = seen.sum(axis=0)
        number = np.maximum(count, 1)
        mean = np.where(seen, table, 0.0).sum(axis=0) / number
        apart = np.where(seen, (table - mean) ** 2, 0.0).sum(axis=0)
        variance = apart / np.maximum(count - 1, 1) / number
        sd = np.sqrt(variance + (_BEAM_RELATIVE * mean) ** 2 + _BEAM_FLOOR**2)
        values.append(mean)
        weights.append(np.where(count > 0, 1.0 / sd, 0.0))
    return np.stack(values), np.stack(weights)


def reflected(R: Quantity | None, bands: int, transport) -> tuple[np.ndarray, np.ndarray]:
    """(wl,) ln R and one over its deviation, which holds what the transport gets wrong."""
    if R is None:
        return np.zeros(bands), np.zeros(bands)
    known = np.isfinite(R.value) & np.isfinite(R.sd) & (R.value > 0)
    error = _REFLECTANCE_ERROR.get(type(transport).__name__, 0.02)
    sd = np.where(known, np.hypot(R.sd, error), 1.0)
    return np.log(np.where(known, R.value, 1.0)), np.where(known, 1.0 / sd, 0.0)


def upward_notes(cast: Cast) -> dict:
    """Metadata on upward light; none without."""
    profile, notes = cast.job.profile, {}
    for kind, job in cast.jobs.items():
        if kind != "Ed":
            notes[f"{kind}_interfaces_m"] = job.interfaces.tolist()
            notes[f"{kind}_deepest_used_m"] = [
                float(job.profile.depth[m].max()) for m in job.mask.T
            ]
    if len(cast.jobs) > 1:
        notes["upward_sensors_below_m"] = profile.upward_below
        notes["light_above"] = (
            "from Ed(0-) through a flat surface" if profile.Es is None else "measured"
        )
    return notes | {f"{kind}_left_out": sentence for kind, sentence in cast.notes.items()}


def _job(profile: Profile, depth_range, layers) -> tuple[Job, str]:
    mask, definition = window(profile, depth_range)
    interfaces = np.zeros(0)
    if layers != 1:
        interfaces = choose_interfaces(
            profile.depth, light_of(profile), profile.floor, mask, layers
        )
    return Job(profile, mask, interfaces), definition


def mean_attenuation(job: Job, fit: BandFit, text: str) -> Quantity:
    """K from the shallowest to the deepest sample used, the mean over layers by thickness."""
    x, cov = np.asarray(fit.x), np.asarray(fit.covariance)
    kd = np.exp(x[:, 1:])
    if kd.shape[1] == 1:
        mean, share = kd[:, 0], np.ones_like(kd)
    else:
        path = thickness(job.profile.depth, job.interfaces)
        reach = np.array([path[m][-1] - path[m][0] for m in job.mask.T])
        parts = reach * kd
        mean = parts.sum(axis=1) / reach.sum(axis=1)
        share = parts / parts.sum(axis=1, keepdims=True)
    variance = np.einsum("wi,wij,wj->w", share, cov[:, 1:, 1:], share)
    return Quantity(mean, np.sqrt(variance), "m-1", text, dof=_dof(job, fit))


def lit(job: Job) -> np.ndarray:
    """(wl,) whether the window holds light that stands out of the noise in darkness."""
    light = np.where(job.mask, light_of(job.profile), -np.inf)
    return np.partition(light, -MIN_DEPTHS, axis=0)[-MIN_DEPTHS] > 5.0 * job.profile.floor


def _dof(job: Job, fit: BandFit) -> np.ndarray | None:
    return None if job.profile.sigma is not None else np.asarray(fit.dof)


def _surface(job: Job, fit: BandFit, unit: str, text: str) -> Quantity:
    sd = np.sqrt(np.asarray(fit.covariance)[:, 0, 0])
    return Quantity(np.exp(np.asarray(fit.x)[:, 0]), sd, unit, text, dof=_dof(job, fit))


def cast_quantities(cast: Cast, fits: Mapping[str, BandFit]) -> dict[str, Quantity]:
    """Kd and light just below the surface of each kind, and what follows, on the Ed bands.

    R = Eu(0-)/Ed(0-); Rrs = Lw/Es with Lw = Lu(0-) (1 - F)/n^2, n = 1.34, and Es as measured or,
    without that, from Ed(0-) through a flat surface (2 % more error); nLw = Rrs F0.  The errors
    of Ed and of upward light count as independent, calibrations as exact.
    """
    profile = cast.job.profile
    found = {
        "Kd": mean_attenuation(cast.job, fits["Ed"], "diffuse attenuation coefficient"),
        "Ed_0": _surface(
            cast.job, fits["Ed"], "W m-2 nm-1", "downward irradiance just below the surface"
        ),
    }
    units = {"Eu": ("Ku", "W m-2 nm-1", "upward irradiance"),
             "Lu": ("KLu", "W m-2 nm-1 sr-1", "upward radiance")}  # fmt: skip
    for kind, (name, unit, words) in units.items():
        if kind in cast.jobs:
            job, fit, to = cast.jobs[kind], fits[kind], cast.bands[kind]
            enough = np.asarray(fit.used).sum(axis=1) >= MIN_DEPTHS
            good = lit(job) & enough & (np.asarray(fit.code) == 0)
            text = f"diffuse attenuation coefficient of {words}"
            found[name] = _placed(mean_attenuation(job, fit, text), to, good)
            text = f"{words} just below the surface"
            found[f"{kind}_0"] = _placed(_surface(job, fit, unit, text), to, good)
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
