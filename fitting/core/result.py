"""The result of a fit: values, intervals, correlations, identifiability."""

import dataclasses
import html
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.core.diagnostics import ModelChoice, SamplerDiagnostics, Status
from fitting.core.parameters import Log, Parameter, Parameters
from oceaninv.foundation.figure_file import save_figure
from oceaninv.foundation.provenance import without_folders

if TYPE_CHECKING:
    import xarray

Vector = Float[np.ndarray, " unknown"]

LEVEL = 0.95  # of the intervals in tables, pictures and files

# Standard deviation of the logarithm beyond which a value would mislead: only its interval is
# given.  Share of the prior's width above which the prior, not the data, determines a number.
_UNKNOWN_SD = 0.5
# Reduced chi-square above which a model does not describe its data.
_DOUBTFUL = 3.0
_PRIOR_SHARE = 0.8


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A derived quantity with its standard deviation, scalar or (wl,).

    `sd` is of the natural logarithm (relative, whatever `unit` is): optical coefficients are
    positive; `absolute_sd` is in `unit`.  `samples`: (draw, ...) values of a sampled posterior,
    whose quantiles are then the intervals.  `dof`: degrees of freedom of its own, of the shape of
    `value`, where it has such.  `second_order_sd`: standard deviation of the second-order error,
    which widens intervals (see `half_width`).  `kind`: what it is without where ("Kd" of Kd_490), a
    key of `STANDARD_NAMES` where that has it.
    """

    value: np.ndarray
    sd: np.ndarray
    unit: str
    long_name: str
    samples: np.ndarray | None = None
    dof: np.ndarray | None = None
    second_order_sd: np.ndarray | float = 0.0
    kind: str = ""

    @property
    def relative_sd(self) -> np.ndarray:
        """Standard deviation of the natural logarithm, the same number as `sd`."""
        return self.sd

    @property
    def absolute_sd(self) -> np.ndarray:
        """Standard deviation in `unit`: `value` times `sd`; to first order, so for small ones."""
        return self.value * self.sd

    def interval(self, level: float = 0.95, dof: float | Vector | None = None):
        """(low, high) that holds the truth with probability `level`."""
        if self.samples is not None:
            return tuple(np.quantile(self.samples, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0))
        half = half_width(
            level, self.sd, self.second_order_sd, dof if self.dof is None else self.dof
        )
        return self.value * np.exp(-half), self.value * np.exp(half)


def quantile(level: float, dof: float | np.ndarray | None = None) -> Any:
    """Half-width of a central interval in standard deviations: normal, or Student's t."""
    from scipy.special import ndtri, stdtrit

    tail = 0.5 + 0.5 * level
    return ndtri(tail) if dof is None else stdtrit(dof, tail)


def half_width(level: float, sd: Any, second_order_sd: Any = 0.0, dof: Any = None):
    """Half-width of a central interval of an error with a second-order part.

    `second_order_sd`: standard deviation of that part.  z + c (z^2 - 1), with c =
    second_order_sd / 2^(1/2), has variance 1 + 2 c^2 and quantiles that differ from those of z by
    c (z^2 - 1): nothing at one standard deviation, 2.84 c at 95 %.  The sign of c is not known well
    enough to shift the interval, so the difference is added in squares.
    """
    z = quantile(level, dof)
    return np.hypot(z * sd, (z * z - 1.0) * second_order_sd / np.sqrt(2.0))


def amount_bias(sd: Any):
    """Mean error of the mode of an amount's logarithm, from its standard deviation.

    Readings are nearly linear in amounts, and the mode of x in (e^x - 1)/s has the bias -s^2/2 (Box
    1971, Journal of the Royal Statistical Society B 33:171).  The bias is limited to half a
    standard deviation, beyond which second order is not valid.  Where the unknowns are well
    determined, this equals Box's sum over all of them; where they are not, that sum is too small at
    optima that came out low, which err most.
    """
    return -0.5 * sd * sd.clip(max=1.0)


class Description(NamedTuple):
    """What a quantity is: unit, long name, and its kind ("Kd" of Kd_490)."""

    unit: str
    long_name: str
    kind: str = ""


@dataclasses.dataclass(frozen=True)
class Number:
    """One number of a fit, as tables, pictures and files show it.

    `low`, `high`: ends of its 95 % interval; `identifiable`: whether the data determine it, so that
    `value` may be quoted; `wavelength`: of the band it belongs to (nm), if it does.
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    identifiable: bool
    wavelength: float | None = None

    @property
    def value_text(self) -> str:
        """The value, or that it is not identifiable."""
        return f"{self.value:.3g}" if self.identifiable else "not identifiable"

    @property
    def interval_text(self) -> str:
        """The interval."""
        return f"{self.low:.3g} - {self.high:.3g}"


@dataclasses.dataclass(frozen=True)
class Predictive:
    """Observations beside what the fitted model predicts, all of one shape.

    `sd`: noise of one observation; `axes`: names of the axes; `coords`: values along them.
    """

    observed: np.ndarray
    predicted: np.ndarray
    sd: np.ndarray
    axes: tuple[str, ...]
    unit: str
    coords: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Fit:
    """The result of a fit.

    - `value`: best value by parameter name.  Read it together with `identifiable`.
    - `covariance`: (unknown, unknown) of the parameters' coordinates (the logarithm for positive
      ones), in the order of `parameters`; `correlation` follows from it.
    - `identifiable`: by name, whether the data fix the parameter: sd of the logarithm at most
      0.5, clearly narrower than the prior, and a 95 % interval that is no wider than the prior's.
    - `quantities`: derived quantities (Kd, c, ...) by name.
    - `wavelength`: (wl,) of spectral quantities and observations, nm.
    - `ended`: the `Status` with which the search or sampler ended.  `status` is that, or
      NUMBERS_NOT_FINITE where a number that is asked for is not finite; `result` is its message,
      `converged` whether it is CONVERGED.
    - `posterior_predictive`: observations beside predictions.
    - `metadata`: model, data, counts of masked values, notes; `facts` adds what the fields below
      say of the search.
    - `dof`: degrees of freedom when the noise was estimated from the residuals, (unknown,) where
      the parameters differ; else None.
    - `sensitivity`: by answer and nuisance, the relative change of the answer if the nuisance's
      prior were centred one standard deviation higher (linearised).
    - `noise_factor`: the factor on the stated noise of the observations, 1 or the Birge ratio,
      where the fit checks that noise; else None.
    - `plan`: the choice of the transport of a fit within a tolerance; else None.
    - `sampling`: diagnostics of the sampler that drew `samples`; else None.
    - `problem`: the posterior itself, for `fitting.sample`; None where a fit keeps none.
    - `samples`: (draw, unknown) coordinates drawn from the posterior, or None; intervals are
      then their quantiles.
    - `bias`: (unknown,) mean error of the mode `x` (`amount_bias`); subtracted in `value`.
      `second_order_sd`: (unknown,) standard deviation of its second-order error, which widens the
      intervals (see `half_width`).  None for neither.
    """

    # What `plot` and `to_netcdf` work with: `fitting.report`, a package above this one, sets them.
    draw: ClassVar[Callable[["Fit"], Any] | None] = None
    write: ClassVar[Callable[..., None] | None] = None

    parameters: Parameters
    x: Vector
    covariance: np.ndarray
    quantities: Mapping[str, Quantity]
    wavelength: np.ndarray
    ended: Status
    posterior_predictive: Predictive
    metadata: Mapping[str, Any]
    dof: float | Vector | None = None
    sensitivity: Mapping[str, Mapping[str, float]] = dataclasses.field(default_factory=dict)
    problem: Any = dataclasses.field(default=None, repr=False)
    samples: np.ndarray | None = dataclasses.field(default=None, repr=False)
    bias: np.ndarray | None = dataclasses.field(default=None, repr=False)
    second_order_sd: np.ndarray | None = dataclasses.field(default=None, repr=False)
    noise_factor: float | None = None
    plan: ModelChoice | None = None
    sampling: SamplerDiagnostics | None = None

    @property
    def centre(self) -> Vector:
        """(unknown,) coordinates of the best values: the mode minus its bias."""
        return self.x if self.bias is None else self.x - self.bias

    @property
    def value(self) -> dict[str, float]:
        """Best value by name."""
        return {
            p.name: float(p.transform.physical(np.float64(x)))
            for p, x in zip(self.parameters, self.centre, strict=True)
        }

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviation of each parameter's coordinate (relative, for positive ones)."""
        return dict(zip(self.parameters.names, np.sqrt(np.diag(self.covariance)), strict=True))

    @property
    def correlation(self) -> np.ndarray:
        """(unknown, unknown) correlation matrix."""
        sd = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.outer(sd, sd)

    @property
    def status(self) -> Status:
        """How the fit ended; never CONVERGED where a number that is asked for is not finite, or a
        derived quantity, all of which are positive, is negative.

        A spectral quantity may be NaN in bands without data, but not in all of them.
        """
        if self.ended != Status.CONVERGED:
            return self.ended
        asked = np.array([not p.nuisance for p in self.parameters], dtype=bool)
        finite = np.isfinite(self.centre) & np.isfinite(np.diag(self.covariance))
        good = finite[asked].all() and all(map(_is_finite, self.quantities.values()))
        if not good:
            return Status.NUMBERS_NOT_FINITE
        negative = any(np.any(quantity.value < 0) for quantity in self.quantities.values())
        return Status.OUTSIDE_MODEL if negative else self.ended

    @property
    def result(self) -> str:
        """The message of `status`."""
        message = self.status.message
        if self.status == Status.CHAINS_DISAGREE and self.sampling is not None:
            rhat = self.sampling.largest_split_rhat
            message += f" (split R-hat of {self.sampling.least_agreed}: {rhat:.2f})"
        return message

    @property
    def converged(self) -> bool:
        """Whether the search ended at an optimum, with finite numbers."""
        return self.status == Status.CONVERGED

    @property
    def facts(self) -> dict[str, Any]:
        """`metadata`, with `noise_factor`, `plan` and `sampling` where the fit has them.

        Of the source its name alone: the folders of a machine do not belong into results.
        """
        found = dict(self.metadata)
        if "source" in found:
            found["source"] = without_folders(str(found["source"]))
        if self.noise_factor is not None:
            found["noise_factor"] = self.noise_factor
        if self.plan is not None:
            found["plan"] = self.plan.facts()
        if self.sampling is not None:
            found["sampling"] = dataclasses.asdict(self.sampling)
        return found

    def interval(self, name: str, level: float = LEVEL) -> tuple[float, float]:
        """(low, high) that holds the parameter with probability `level`."""
        i = self.parameters.names.index(name)
        low, high = map(self.parameters[i].transform.physical, self._ends(i, level))
        return float(low), float(high)

    def _ends(self, i: int, level: float) -> tuple[float, float]:
        """Ends of an interval of the coordinate of unknown `i`."""
        if self.samples is not None:
            low, high = np.quantile(self.samples[:, i], [0.5 - 0.5 * level, 0.5 + 0.5 * level])
            return low, high
        dof = self.dof[i] if isinstance(self.dof, np.ndarray) else self.dof
        second_order_sd = 0.0 if self.second_order_sd is None else self.second_order_sd[i]
        half = half_width(level, np.sqrt(self.covariance[i, i]), second_order_sd, dof)
        return self.x[i] - half, self.x[i] + half

    @property
    def identifiable(self) -> dict[str, bool]:
        """Whether the data, rather than the prior, fix each parameter."""
        ends = [self._ends(i, LEVEL) for i in range(len(self.parameters))]
        return {
            p.name: _identifiable(p, sd, 0.5 * (high - low))
            for p, sd, (low, high) in zip(self.parameters, self.sd.values(), ends, strict=True)
        }

    def parameter_numbers(self) -> list[Number]:
        """All unknowns, nuisances included."""
        value, known = self.value, self.identifiable
        return [
            Number(
                p.name, p.unit, value[p.name], *self.interval(p.name), known[p.name], p.wavelength
            )
            for p in self.parameters
        ]

    def numbers(self) -> list[Number]:
        """The numbers of the fit: scalar quantities, then the unknowns that were asked for."""
        found = [
            Number(name, q.unit, float(q.value), *self._quantity_ends(q), bool(q.sd <= _UNKNOWN_SD))
            for name, q in self.quantities.items()
            if q.value.ndim == 0
        ]
        pairs = zip(self.parameters, self.parameter_numbers(), strict=True)
        return found + [number for p, number in pairs if not p.nuisance]

    def _quantity_ends(self, quantity: Quantity) -> tuple[float, float]:
        dof = None if isinstance(self.dof, np.ndarray) else self.dof
        low, high = quantity.interval(LEVEL, dof)
        return float(low), float(high)

    @property
    def wide(self) -> bool:
        """Whether some number that is asked for is so uncertain that the ellipsoid may mislead.

        `fitting.sample` then gives intervals and joint regions that are valid.
        """
        scalars = [float(q.sd) for q in self.quantities.values() if q.value.ndim == 0]
        asked = [sd for p, sd in zip(self.parameters, self.sd.values(), strict=True)
                 if not p.nuisance]  # fmt: skip
        return not all(sd <= _UNKNOWN_SD for sd in [*scalars, *asked])

    def to_xarray(self) -> "xarray.Dataset":
        """Everything as a CF-style dataset; see `dataset`."""

        return dataset(self)

    def to_netcdf(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write everything as netCDF, as the commands do; see `fitting.report.netcdf_file`."""
        if Fit.write is None:
            raise RuntimeError("import fitting.report, which writes fits.")
        Fit.write(path, self, overwrite=overwrite)

    def plot(self) -> Any:
        """The picture of the fit as a matplotlib figure; see `fitting.report.picture`."""
        if Fit.draw is None:
            raise RuntimeError("import fitting.report.picture, which draws fits.")
        return Fit.draw(self)

    def report(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the picture of the fit (PNG) to `path`."""
        save_figure(self.plot(), path, dpi=130, overwrite=overwrite)

    @property
    def reduced_chi2(self) -> float | None:
        """Sum of the squared residuals over their standard deviations, per degree of freedom.

        About 1 where the model describes the data within their noise.  The degrees of freedom are
        the data less the unknowns that they fix.  Where the noise was scaled by the Birge ratio,
        the value before that, `noise_factor` squared.  None where the noise was estimated from the
        residuals themselves (`dof`), or where there are no more data than unknowns.
        """
        if self.noise_factor is not None and self.noise_factor > 1.0:
            return self.noise_factor**2
        seen = self.posterior_predictive
        residual = (seen.observed - seen.predicted) / seen.sd
        residual = residual[np.isfinite(residual)]
        degrees = residual.size - sum(self.identifiable.values())
        if self.dof is not None or degrees < 1:
            return None
        return float(np.sum(residual**2) / degrees)

    @property
    def doubt(self) -> str | None:
        """A sentence where `reduced_chi2` is above 3: the model does not describe the data."""
        found = self.reduced_chi2
        if found is None or found <= _DOUBTFUL:
            return None
        return (
            f"The model does not describe these data: reduced chi-square {found:.1f}; the numbers "
            "below are doubtful."
        )

    def summary(self) -> str:
        """The numbers with their 95 % intervals as a table of text, after how the fit ended."""
        heads = ("quantity", "unit", "value", f"{100 * LEVEL:.0f} % interval")
        rows = [(n.name, n.unit, n.value_text, n.interval_text) for n in self.numbers()]
        widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
        lines = [self.doubt] if self.doubt else []
        lines.append(f"search: {self.result}")
        for name, unit, value, interval in (heads, *rows):
            cells = name.ljust(widths[0]), unit.ljust(widths[1]), value.rjust(widths[2])
            lines.append("  ".join((*cells, interval.rjust(widths[3]))))
        return "\n".join(lines)

    def __repr__(self) -> str:
        numbers = self.numbers()
        named = [
            f"{n.name} {n.value_text} {n.unit} ({n.interval_text})"
            if n.identifiable
            else f"{n.name} {n.value_text}"
            for n in numbers[:3]
        ]
        more = f", and {len(numbers) - 3} more" if len(numbers) > 3 else ""
        return f"Fit({', '.join(named)}{more}; {self.result})"

    def _repr_html_(self) -> str:
        """What notebooks show: `summary` as a table."""
        doubt = f"<p><strong>{html.escape(self.doubt)}</strong></p>" if self.doubt else ""
        heads = "".join(
            f"<th>{head}</th>"
            for head in ("quantity", "unit", "value", f"{100 * LEVEL:.0f} % interval")
        )
        rows = ""
        for n in self.numbers():
            cells = map(html.escape, (n.name, n.unit, n.value_text, n.interval_text))
            rows += f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
        caption = f"<caption>search: {html.escape(self.result)}</caption>"
        return f"{doubt}<table>{caption}<tr>{heads}</tr>{rows}</table>"

    def metadata_json(self) -> str:
        """`facts` as one line of JSON."""
        return json.dumps(self.facts, default=str)


def sensitivity_text(shifts: Mapping[str, float], most: int) -> str:
    """The `most` largest of an answer's sensitivities, as "cdom_slope +12 %, backscatter -5 %"."""
    largest = sorted(shifts.items(), key=lambda item: -abs(item[1]))[:most]
    return ", ".join(f"{name} {100 * shift:+.0f} %" for name, shift in largest)


def _is_finite(quantity: Quantity) -> bool:
    """Whether all numbers of a quantity are finite, apart from bands without a value."""
    given = ~np.isnan(quantity.value)
    finite = np.isfinite(quantity.value) & np.isfinite(quantity.sd)
    return bool(np.any(given) and np.all(finite[given]))


def _identifiable(parameter: Parameter, sd: float, half_width: float = 0.0) -> bool:
    """Whether the data fix a parameter of this standard deviation and 95 % interval, both in its
    coordinate."""
    narrow = sd <= _UNKNOWN_SD or not isinstance(parameter.transform, Log)
    spread = np.inf if parameter.spread is None else parameter.spread
    informed = sd <= _PRIOR_SHARE * spread and half_width <= quantile(LEVEL) * spread
    return bool(np.isfinite(sd) and narrow and informed)


def derived_quantity(
    values: np.ndarray,
    jacobian: np.ndarray,
    covariance: np.ndarray,
    unit: str,
    long_name: str,
    kind: str = "",
) -> Quantity:
    """Delta method for a positive quantity: `values` (...), `jacobian` (..., unknown)."""
    relative = jacobian / values[..., None]
    variance = np.einsum("...i,ij,...j->...", relative, covariance, relative)
    return Quantity(values, np.asarray(np.sqrt(variance)), unit, long_name, kind=kind)


STANDARD_NAMES = {
    "Kd": "volume_attenuation_coefficient_of_downwelling_radiative_flux_in_sea_water",
    "c": "volume_beam_attenuation_coefficient_of_radiative_flux_in_sea_water",
    "bb": "volume_backwards_scattering_coefficient_of_radiative_flux_in_sea_water",
    "Ed": "downwelling_radiative_flux_per_unit_wavelength_in_sea_water",
    "Eu": "upwelling_radiative_flux_per_unit_wavelength_in_sea_water",
    "Lu": "upwelling_radiance_per_unit_wavelength_in_sea_water",
    "Rrs": "surface_ratio_of_upwelling_radiance_emerging_from_sea_water_"
    "to_downwelling_radiative_flux_in_air",
    "chlorophyll": "mass_concentration_of_chlorophyll_a_in_sea_water",
}


# Lists in a fit's metadata with a number per band, as variables: name, unit, long name.
_OF_BANDS = {
    "depths_used": ("depths_used", "1", "number of depths that were used"),
    "deepest_used_m": ("deepest_used", "m", "deepest depth that was used"),
    "dark_level": ("dark_level", "W m-2 nm-1", "reading in darkness, 0 where it is not reached"),
    "relative_noise": ("relative_noise", "1", "standard deviation of a reading over the light"),
    "noise_correlated_over_m": (
        "noise_correlation_length",
        "m",
        "distance over which the noise is correlated",
    ),
    "runs_test_p": (
        "runs_test_p",
        "1",
        "probability of runs of residuals as long as those found if the model is right",
    ),
}


def _of_bands(fit: Fit) -> dict:
    """Variables over wavelength from the fit's metadata."""
    found = {}
    for key, (name, unit, long_name) in _OF_BANDS.items():
        values = fit.metadata.get(key)
        if isinstance(values, list) and len(values) == len(fit.wavelength):
            notes = {"units": unit, "long_name": long_name}
            dtype = np.int32 if key == "depths_used" else float
            found[name] = ("wavelength", np.array(values, dtype), notes)
    return found


STATION = {
    "latitude": {"units": "degrees_north", "standard_name": "latitude"},
    "longitude": {"units": "degrees_east", "standard_name": "longitude"},
    "time": {"units": "days since 1950-01-01T00:00:00Z", "standard_name": "time"},
    "platform": {"long_name": "number of the float"},
    "cycle": {"units": "1", "long_name": "number of the float's cycle"},
}


def days_since_1950(time: str) -> float:
    """Days from 1950-01-01T00:00:00Z to a date and time in ISO 8601."""
    since = np.datetime64(time.removesuffix("Z"), "s") - np.datetime64("1950-01-01", "s")
    return float(since / np.timedelta64(1, "D"))


def _of_profile(fit: Fit) -> dict:
    """Variables without dimensions that say which profile this is, when and where it was taken."""
    station = fit.metadata.get("station", {})
    name = "_".join(str(station[part]) for part in ("platform", "cycle") if part in station)
    name = name or without_folders(str(fit.metadata.get("source", "")))
    found: dict = {"profile": ((), np.array(name, dtype=str), {"cf_role": "profile_id"})}
    for part in ("latitude", "longitude", "time"):
        if part in station:
            value = days_since_1950(station[part]) if part == "time" else float(station[part])
            found[part] = ((), np.array(value), STATION[part])
    return found


def dataset(fit: Fit) -> "xarray.Dataset":
    """Parameters, quantities and observations of a fit with CF attributes.

    95 % intervals carry the suffixes _low and _high; a parameter that the data do not fix has
    `identifiable` 0.
    """
    import xarray as xr

    return xr.Dataset(*dataset_content(fit))


def dataset_content(fit: Fit) -> tuple[dict, dict, dict]:
    """(variables, coordinates, attributes) of `dataset`."""
    numbers = fit.parameter_numbers()

    def column(name: str, dtype: type = float) -> np.ndarray:
        return np.array([getattr(number, name) for number in numbers], dtype=dtype)

    data: dict = {
        "value": ("parameter", column("value"), {"long_name": "best value"}),
        "low": ("parameter", column("low"), {"long_name": "lower end of the 95 % interval"}),
        "high": ("parameter", column("high"), {"long_name": "upper end of the 95 % interval"}),
        "identifiable": (
            "parameter",
            column("identifiable", np.int8),
            {
                "long_name": "whether the data fix the parameter",
                "flag_values": np.array([0, 1], dtype=np.int8),
                "flag_meanings": "prior_dominated fixed_by_data",
            },
        ),
        "parameter_unit": ("parameter", column("unit", str), {"long_name": "unit"}),
        "correlation": (
            ("parameter", "other"),
            fit.correlation,
            {"long_name": "correlation of the coordinates", "units": "1"},
        ),
    }
    for name, quantity in fit.quantities.items():
        dims = () if quantity.value.ndim == 0 else ("wavelength",)
        attributes = {"units": quantity.unit, "long_name": quantity.long_name}
        kind = quantity.kind or name
        if kind in STANDARD_NAMES:
            attributes["standard_name"] = STANDARD_NAMES[kind]
        below, above = quantity.interval(LEVEL, fit.dof)
        data[name] = (dims, quantity.value, attributes)
        for suffix, value in (("low", below), ("high", above)):
            text = f"{suffix} end of the 95 % interval of {name}"
            data[f"{name}_{suffix}"] = (dims, value, {"units": quantity.unit, "long_name": text})
    data |= _of_bands(fit)
    predictive = fit.posterior_predictive
    profile = _of_profile(fit) if "depth" in predictive.axes else {}
    label = "Ed" if "depth" in predictive.axes else "reading"
    for suffix, value in (
        ("observed", predictive.observed),
        ("predicted", predictive.predicted),
        ("sd", predictive.sd),
    ):
        attributes = {"units": predictive.unit, "long_name": f"{suffix} {label}"}
        if label == "Ed" and suffix != "sd":
            attributes["standard_name"] = STANDARD_NAMES["Ed"]
        data[f"{label}_{suffix}"] = (predictive.axes, value, attributes)
    coords: dict = {
        "parameter": column("name", str),
        "wavelength": (
            "wavelength",
            fit.wavelength,
            {"units": "nm", "standard_name": "radiation_wavelength"},
        ),
    }
    if "depth" in predictive.coords:
        coords["depth"] = (
            "depth",
            predictive.coords["depth"],
            {"units": "m", "standard_name": "depth", "positive": "down", "axis": "Z"},
        )
    if "channel" in predictive.axes:
        coords["channel"] = np.array(["R", "G", "B"], dtype=str)
    if "coefficient" in predictive.axes:
        coords["coefficient"] = predictive.coords["coefficient"]
    place = " ".join(name for name in ("time", "latitude", "longitude") if name in profile)
    if place:
        for dims, _, *notes in data.values():
            if notes and "wavelength" in dims:
                notes[0]["coordinates"] = place
    attributes = {
        "Conventions": "CF-1.11",
        **({"featureType": "profile"} if profile else {}),
        **fit.metadata.get("station", {}),
        "title": "Fit of underwater light by oceaninv",
        "source": without_folders(str(fit.metadata.get("source", ""))),
        "result": fit.result,
        "metadata": fit.metadata_json(),
    }
    return data | profile, coords, attributes
