"""Many depth profiles at once: one compiled program, results as arrays or one `Fit` each."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.core.diagnostics import Status
from fitting.core.parameters import Parameter
from fitting.core.result import STANDARD_NAMES, STATION, Fit, Quantity, days_since_1950
from fitting.observations.profile import Profile
from fitting.profile.constituents.fit_waters import WaterFit, fit_waters, water_fit
from fitting.profile.kd.band_fit import BandFit
from fitting.profile.kd.batching import fit_windows
from fitting.profile.kd.cast import Cast, cast_of
from fitting.profile.kd.reflectances import cast_quantities
from fitting.profile.kd.result import check_light_falls, kd_fit, light_depths
from oceaninv.foundation.argument_names import names_checked
from oceaninv.foundation.double_precision import in_double_precision
from oceaninv.foundation.provenance import without_folders
from oceaninv.transport.base import AbstractTransport

if TYPE_CHECKING:
    import xarray

# How the search of a band can have ended.
_ENDED = (Status.CONVERGED, Status.STEP_LIMIT, Status.MODEL_NOT_FINITE)


class ProfileFits:
    """Fits of many casts.  `fits[i]` is the `Fit` of cast i, made when it is asked for.

    `failures`: sentences by index, of casts that could not be used; asking for their `Fit` raises
    that sentence.  `water_failures`: the same of casts whose Kd was found, but no constituents.
    """

    failures: Mapping[int, str]
    water_failures: Mapping[int, str]

    def __init__(
        self,
        sources: Sequence[str],
        casts: Mapping[int, Cast],
        fits: Mapping[int, Mapping[str, BandFit]],
        failures: Mapping[int, str],
        waters: Mapping[int, WaterFit] | None = None,
        water_failures: Mapping[int, str] | None = None,
    ):
        self._waters = waters or {}
        self._sources, self._casts, self._fits = list(sources), casts, fits
        self.failures, self.water_failures = failures, water_failures or {}

    def __len__(self) -> int:
        return len(self._sources)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = range(len(self))[index]
        if i in self.failures:
            raise ValueError(self.failures[i])
        return kd_fit(self._casts[i], self._fits[i])

    def __iter__(self) -> Iterator[Fit]:
        return (self[i] for i in range(len(self)))

    def part(self, indices: Sequence[int]) -> "ProfileFits":
        """The fits of some casts."""
        sources = [self._sources[i] for i in indices]

        def chosen(by_index):
            return {new: by_index[i] for new, i in enumerate(indices) if i in by_index}

        return ProfileFits(
            sources,
            chosen(self._casts),
            chosen(self._fits),
            chosen(self.failures),
            chosen(self._waters),
            chosen(self.water_failures),
        )

    def water(self, index: int) -> Fit:
        """The constituents of one cast; only where a transport was given."""
        i = range(len(self))[index]
        if i in self.failures:
            raise ValueError(self.failures[i])
        if i in self.water_failures:
            raise ValueError(self.water_failures[i])
        if i not in self._waters:
            raise ValueError("no constituents were fitted: give fit_profiles a transport.")
        return water_fit(self._casts[i], self._fits[i]["Ed"], self._waters[i])

    def to_xarray(self) -> "xarray.Dataset":
        """Every quantity (cast, wavelength) or (cast,) with its 95 % interval, by its name.

        NaN where a cast lacks a band or a quantity, or failed.
        """
        import xarray as xr

        return xr.Dataset(*self.content())

    def content(self) -> tuple[dict, dict, dict]:
        """Variables, coordinates and attributes of `to_xarray`."""
        grids = [cast.window.profile.wavelength for cast in self._casts.values()]
        wavelength = np.unique(np.concatenate([*grids, np.zeros(0)]))
        code = np.full((len(self), len(wavelength)), -1, np.int8)
        table = _Table(len(self), wavelength)
        for i, cast in self._casts.items():
            fits = self._fits[i]
            at = np.searchsorted(wavelength, cast.window.profile.wavelength)
            code[i, at] = fits["Ed"].code
            for name, quantity in self._quantities(i).items():
                table.put(name, quantity, i, at)
        definitions = sorted({cast.definition for cast in self._casts.values()})
        notes = {
            "long_name": "how the search ended",
            "flag_values": np.array([-1, *_ENDED], dtype=np.int8),
            "flag_meanings": "absent converged step_limit not_finite",
        }
        every = {**self.water_failures, **self.failures}
        failures = np.array(
            [without_folders(every.get(i, "")) for i in range(len(self))], dtype=str
        )
        sources = [without_folders(source) for source in self._sources]
        spectral = {"units": "nm", "standard_name": "radiation_wavelength"}
        return (
            {
                **table.variables(),
                **self._stations(),
                "search": (("cast", "wavelength"), code, notes),
                "source": ("cast", np.array(sources, dtype=str), {"long_name": "source"}),
                "failure": (
                    "cast",
                    failures,
                    {"long_name": "why Kd or constituents are missing"},
                ),
            },
            {"wavelength": ("wavelength", wavelength, spectral)},
            {
                "Conventions": "CF-1.11",
                "title": "Kd of many casts by oceaninv",
                "kd_definition": "; ".join(definitions),
            },
        )

    def _stations(self) -> dict:
        """Variables over casts that say where, when and by what these were measured."""
        stations = [
            self._casts[i].window.profile.station if i in self._casts else {}
            for i in range(len(self))
        ]
        found = {}
        for name, notes in STATION.items():
            values = [station.get(name) for station in stations]
            if all(value is None for value in values):
                continue
            if name == "time":
                days = [days_since_1950(str(value)) if value else np.nan for value in values]
                found[name] = ("cast", np.array(days), notes)
            elif name == "platform":
                found[name] = ("cast", np.array([str(v or "") for v in values], dtype=str), notes)
            else:
                numbers = [np.nan if value is None else value for value in values]
                found[name] = ("cast", np.array(numbers, dtype=float), notes)
        return found

    def _quantities(self, i: int) -> dict[str, Quantity]:
        cast, fits = self._casts[i], self._fits[i]
        found = cast_quantities(cast, fits) | light_depths(cast, fits["Ed"])[0]
        if i in self._waters:
            fit = self.water(i)
            value, sd = fit.value, fit.sd
            for p in fit.parameters:
                if not p.nuisance:
                    numbers = np.array(value[p.name]), np.array(sd[p.name])
                    found[p.name] = Quantity(*numbers, p.unit, p.name, kind=p.kind)
            found |= {n: q for n, q in fit.quantities.items() if q.value.ndim == 0}
        return found


class _Table:
    """Quantities of casts gathered by name; made as they come."""

    def __init__(self, count: int, wavelength: np.ndarray):
        self.count, self.wavelength = count, wavelength
        self.rows: dict[str, np.ndarray] = {}
        self.kinds: dict[str, Quantity] = {}

    def put(self, name: str, quantity: Quantity, i: int, at: np.ndarray) -> None:
        spectral = quantity.value.ndim == 1
        if name not in self.rows:
            shape = (3, self.count, *([len(self.wavelength)] if spectral else []))
            self.rows[name], self.kinds[name] = np.full(shape, np.nan), quantity
        ends = quantity.interval(0.95)
        for row, value in zip(self.rows[name], (quantity.value, *ends), strict=True):
            row[(i, at) if spectral else i] = value

    def variables(self) -> dict:
        found = {}
        for name, rows in self.rows.items():
            kind = self.kinds[name]
            dims = ("cast", "wavelength")[: rows.ndim - 1]
            notes = {"units": kind.unit, "long_name": kind.long_name}
            standard = STANDARD_NAMES.get(kind.kind or name)
            own = {"standard_name": standard} if standard else {}
            found[name] = (dims, rows[0], notes | own)
            for suffix, row, words in (("low", rows[1], "2.5 %"), ("high", rows[2], "97.5 %")):
                text = f"{kind.long_name}, {words}"
                found[f"{name}_{suffix}"] = (dims, row, notes | {"long_name": text})
        return found


@names_checked
@in_double_precision
def fit_profiles(
    profiles: Sequence[Profile],
    *,
    depth_range: tuple[float, float] | None = None,
    layers: int | None = 1,
    transport: AbstractTransport | None = None,
    priors: dict[str, Parameter] | None = None,
) -> ProfileFits:
    """Kd (and K of upward light) of many casts, as `fit_profile` without a transport gives it.

    Casts of any lengths and bands: they are padded to few shapes and go through one compiled
    program per shape in chunks, shared out over the local devices.  A cast's result does not
    depend on the others.  `depth_range`, `layers`: as for `fit_profile`; finding layers (None or
    above 1) costs some hundredths of a second per cast.

    `transport`: fits the constituents of each cast as well (`ProfileFits.water`), through a model
    of the light such as `oceaninv.TwoStream()`, from Ed and, where Eu was measured, R, as those of
    one water whatever `layers` is; outliers of the fit of Kd are left out.  `priors` as for
    `fit_profile`, for all casts.
    """
    if priors and transport is None:
        raise ValueError("priors apply to a fit through a transport; Kd alone has none.")
    casts: dict[int, Cast] = {}
    failures: dict[int, str] = {}
    for i, profile in enumerate(profiles):
        try:
            casts[i] = cast_of(profile, depth_range, layers)
        except ValueError as error:
            failures[i] = f"{profile.source}: {error}"
    keys = [(i, kind) for i, cast in casts.items() for kind in cast.windows]
    fitted = fit_windows([casts[i].windows[kind] for i, kind in keys]) if keys else []
    fits: dict[int, dict[str, BandFit]] = {i: {} for i in casts}
    for (i, kind), fit in zip(keys, fitted, strict=True):
        fits[i][kind] = fit
    for i in list(casts):
        try:
            check_light_falls(casts[i], fits[i]["Ed"])
        except ValueError as error:
            failures[i] = f"{profiles[i].source}: {error}"
            del casts[i], fits[i]
    waters, dry = ({}, {}) if transport is None else fit_waters(casts, fits, transport, priors)
    return ProfileFits([p.source for p in profiles], casts, fits, failures, waters, dry)


def stream_profiles(
    profiles: Iterable[Profile], *, group: int = 1024, **options
) -> "Iterator[xarray.Dataset]":
    """Tables (`ProfileFits.to_xarray`) of `group` casts at a time, for any number of them.

    Only one group is in memory; `options` as for `fit_profiles`.  A cast's result does not depend
    on `group`.
    """
    for part in _batched(profiles, group):
        yield fit_profiles(part, **options).to_xarray()


def _batched(items: Iterable, size: int) -> Iterator[list]:
    """Lists of `size` items, the last one shorter (`itertools.batched` of Python 3.12)."""
    source = iter(items)
    while part := list(itertools.islice(source, size)):
        yield part
