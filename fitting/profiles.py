"""Many depth profiles at once: one compiled program, results as arrays or one `Fit` each."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting._bands import BandFit
from fitting._lanes import Job, fit_lanes
from fitting.observations import Profile
from fitting.posterior import Fit
from fitting.profile import kd_fit, mean_kd, prepare
from fitting.solve import RESULTS

if TYPE_CHECKING:
    import xarray


class ProfileFits:
    """Fits of many casts.  `fits[i]` is the `Fit` of cast i, made when it is asked for.

    `failures`: sentences by index, of casts that could not be used; asking for their `Fit` raises
    that sentence.
    """

    failures: Mapping[int, str]

    def __init__(
        self,
        sources: Sequence[str],
        jobs: Mapping[int, tuple[Job, str]],
        bands: Mapping[int, BandFit],
        failures: Mapping[int, str],
    ):
        self._sources, self._jobs, self._bands = list(sources), jobs, bands
        self.failures = failures

    def __len__(self) -> int:
        return len(self._sources)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = range(len(self))[index]
        if i in self.failures:
            raise ValueError(self.failures[i])
        job, definition = self._jobs[i]
        return kd_fit(job, self._bands[i], definition)

    def __iter__(self) -> Iterator[Fit]:
        return (self[i] for i in range(len(self)))

    def part(self, indices: Sequence[int]) -> "ProfileFits":
        """The fits of some casts."""
        sources = [self._sources[i] for i in indices]

        def chosen(by_index):
            return {new: by_index[i] for new, i in enumerate(indices) if i in by_index}

        return ProfileFits(sources, chosen(self._jobs), chosen(self._bands), chosen(self.failures))

    def to_xarray(self) -> "xarray.Dataset":
        """Kd (cast, wavelength) with 95 % intervals, NaN where a cast lacks a band or failed."""
        import xarray as xr
        from scipy.special import stdtrit

        grids = [self._jobs[i][0].profile.wavelength for i in self._jobs]
        wavelength = np.unique(np.concatenate([*grids, np.zeros(0)]))
        shape = (len(self), len(wavelength))
        kd, reach, code = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1)
        for i, (job, _) in self._jobs.items():
            fit, profile = self._bands[i], job.profile
            at = np.searchsorted(wavelength, profile.wavelength)
            mean = mean_kd(job, np.asarray(fit.x), np.asarray(fit.covariance))
            dof = np.inf if profile.sigma is not None else np.asarray(fit.dof)
            kd[i, at], reach[i, at] = mean.value, stdtrit(dof, 0.975) * mean.sd
            code[i, at] = fit.code
        unit = {"units": "m-1"}
        name = "volume_attenuation_coefficient_of_downwelling_radiative_flux_in_sea_water"
        dims = ("cast", "wavelength")
        definitions = sorted({definition for _, definition in self._jobs.values()})
        text = "diffuse attenuation coefficient"
        return xr.Dataset(
            {
                "Kd": (dims, kd, {**unit, "standard_name": name, "long_name": text}),
                "Kd_low": (dims, kd * np.exp(-reach), {**unit, "long_name": f"{text}, 2.5 %"}),
                "Kd_high": (dims, kd * np.exp(reach), {**unit, "long_name": f"{text}, 97.5 %"}),
                "search": (
                    dims,
                    code.astype(np.int8),
                    {
                        "long_name": "how the search ended",
                        "flag_values": np.array([-1, *RESULTS], dtype=np.int8),
                        "flag_meanings": "absent converged step_limit not_finite",
                    },
                ),
                "source": ("cast", np.array(self._sources, dtype=str), {"long_name": "source"}),
                "failure": (
                    "cast",
                    np.array([self.failures.get(i, "") for i in range(len(self))], dtype=str),
                    {"long_name": "why the cast could not be used"},
                ),
            },
            {
                "wavelength": (
                    "wavelength",
                    wavelength,
                    {"units": "nm", "standard_name": "radiation_wavelength"},
                )
            },
            {
                "Conventions": "CF-1.11",
                "title": "Kd of many casts by oceaninv",
                "kd_definition": "; ".join(definitions),
            },
        )


def fit_profiles(
    profiles: Sequence[Profile],
    *,
    depth_range: tuple[float, float] | None = None,
    layers: int | None = 1,
) -> ProfileFits:
    """Kd of many casts, as `fit_profile` without a transport gives it for each.

    Casts of any lengths and bands: they are padded to few shapes and go through one compiled
    program per shape in chunks, shared out over the local devices.  A cast's result does not
    depend on the others.  `depth_range`, `layers`: as for `fit_profile`; finding layers (None or
    above 1) costs some hundredths of a second per cast.
    """
    jobs: dict[int, tuple[Job, str]] = {}
    failures: dict[int, str] = {}
    for i, profile in enumerate(profiles):
        try:
            jobs[i] = prepare(profile, depth_range, layers)
        except ValueError as error:
            failures[i] = f"{profile.source}: {error}"
    fits = fit_lanes([job for job, _ in jobs.values()]) if jobs else []
    bands = dict(zip(jobs, fits, strict=True))
    return ProfileFits([p.source for p in profiles], jobs, bands, failures)
