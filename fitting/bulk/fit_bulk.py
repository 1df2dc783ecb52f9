"""Measured spectra of absorption and scattering to the constituents of a medium."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from fitting.bulk.media import AbstractMedium, Populations
from fitting.core.diagnostics import Status
from fitting.core.least_squares import check_solver, covariance, least_squares
from fitting.core.parameters import Parameter, Parameters, Prior
from fitting.core.result import Fit, Predictive, derived_quantity
from fitting.observations.bulk import Bulk
from oceaninv.foundation.argument_names import names_checked
from oceaninv.foundation.double_precision import in_double_precision
from oceaninv.mie.particles import Population

_NAMES = {
    "a": "absorption coefficient",
    "b": "scattering coefficient",
    "c": "beam attenuation coefficient",
}
_FIRST_NOISE = 0.05
_ROUNDS = 6
_LEAST_NOISE = 1e-4


class _Readings(eqx.Module):
    """What the compiled program sees: a row each for a, b and c, measured or not.

    `sigma` is None where the noise is estimated.  What was not measured has the standard deviation
    `unmeasured_sd`, so large that it has no weight: the solver then computes its model and
    derivatives along with the others.
    """

    values: Float[Array, "coefficient wl"]
    mask: Bool[Array, "coefficient wl"]
    sigma: Float[Array, "coefficient wl"] | None
    floor: Float[Array, ""]
    unmeasured_sd: Float[Array, ""]

    def spread(self, model: Float[Array, "coefficient wl"], noise: Float[Array, ""]):
        """Standard deviations at the model, not at the datum, which would favour low readings."""
        sd = self.sigma
        if sd is None:
            sd = jnp.sqrt((noise * model) ** 2 + self.floor**2)
        return jnp.where(self.mask, sd, self.unmeasured_sd)


@eqx.filter_jit
def _solve(medium, layout: Parameters, prior: Prior, grid, readings: _Readings, solver):
    """Optimum, relative noise, degrees of freedom; one program for any subset of a, b and c."""
    shape, size = readings.values.shape, readings.values.size

    def residual(x, sd):
        a, b = medium.coefficients(layout.values(x), np.asarray(grid))
        data = (readings.values - jnp.stack([a, b, a + b])) / sd
        return jnp.concatenate([data.reshape(-1), prior.residual(x)])

    def search(x, model, noise):
        """A round with its model, noise and degrees of freedom."""
        sd = readings.spread(model, noise)
        optimum = least_squares(residual, x, sd, prior.scale, solver=solver)
        data, slope = optimum.residual[:size].reshape(shape), optimum.jacobian[:size]
        # Readings less the number of unknowns that they, rather than the priors, determine.
        fitted = jnp.sum((slope @ covariance(optimum.jacobian)) * slope)
        degrees = jnp.sum(readings.mask).astype(fitted.dtype) - fitted
        birge_ratio = jnp.sqrt(jnp.sum(data**2) / jnp.maximum(degrees, 1.0))
        better = jnp.maximum(noise * birge_ratio, _LEAST_NOISE)
        slopes = -(slope.reshape(*shape, -1) * sd[:, :, None])
        return optimum, readings.values - data * sd, slopes, noise, better, degrees

    noise = jnp.asarray(_FIRST_NOISE, prior.centre.dtype)
    if readings.sigma is not None:
        optimum, model, slopes, *_, degrees = search(prior.centre, readings.values, noise)
        return optimum, model, slopes, noise, degrees

    def refine(carry, _):
        optimum, model, slopes, noise, better, degrees = search(*carry)
        return (optimum.x, model, better), (optimum, model, slopes, noise, degrees)

    start = (prior.centre, readings.values, noise)
    rounds = jax.lax.scan(refine, start, None, length=_ROUNDS)[1]
    return jax.tree.map(lambda leaf: leaf[-1], rounds)


@names_checked
@in_double_precision
def fit_bulk(
    bulk: Bulk,
    medium: AbstractMedium | Mapping[str, Population] | Sequence[Population],
    host_index: Num[ArrayLike, "..."] | None = None,
    *,
    priors: Mapping[str, Parameter] | None = None,
    solver: Any = None,
) -> Fit:
    """Fit the constituents of a medium to its measured absorption, scattering or attenuation.

    **Arguments:**

    - `bulk`: the measured spectra.
    - `medium`: a model (`Milk()`, `NaturalWater()`, `Populations(...)`), or populations of
      spheres whose volume fractions and sizes are unknown.
    - `host_index`: n + ik, a number or (wl,), needed for populations.
    - `priors`: parameters to exchange by name, for instance a known exponent:
      `{"algae_exponent": Parameter("algae_exponent", 4.0, 0.01, Identity())}`.
    - `solver`: of the search: an `optimistix.AbstractLeastSquaresSolver` or
      `optimistix.AbstractMinimiser`, as `optimistix.BFGS(rtol=1e-6, atol=1e-6)`, or
      `fitting.core.jaxopt_solver.BoundedSolver()`; Levenberg-Marquardt unless given.

    **Returns** a `Fit` with the quantities "a", "b" and "c" of the model at the wavelengths of the
    readings.  `metadata["misfit"]` is the rms residual in standard deviations: well above 1 with a
    given sigma, the model does not describe the readings and intervals are too narrow (sigma None
    counts that as noise).

    The model is compiled once per set of wavelengths; time grows with the largest sphere.
    """
    check_solver(solver)
    if not isinstance(medium, AbstractMedium):
        if host_index is None:
            raise ValueError("host_index is needed where the medium is given as populations.")
        medium = Populations(medium, host_index)
    elif host_index is not None:
        raise ValueError("host_index belongs to populations; a model knows its own.")
    parameters = Parameters(medium.unknowns()).replace(priors or {})
    if bulk.sigma is None and bulk.mask.sum() < 3:
        raise ValueError(
            f"{int(bulk.mask.sum())} readings cannot show their own noise: give sigma."
        )
    optimum, *numbers = _solve(
        medium,
        parameters.layout(),
        parameters.prior(),
        tuple(bulk.wavelength.tolist()),
        _readings(bulk),
        solver,
    )
    return _result(bulk, medium, parameters, optimum, *map(np.asarray, numbers))


def _readings(bulk: Bulk) -> _Readings:
    rows = [list(_NAMES).index(name) for name in bulk.names]

    def every(values, fill):
        whole = np.full((len(_NAMES), len(bulk.wavelength)), fill)
        whole[rows] = values
        return jnp.asarray(whole)

    usable = np.where(bulk.mask, bulk.values, 0.0)
    return _Readings(
        every(usable, 0.0),
        every(bulk.mask, False),
        None if bulk.sigma is None else every(bulk.sigma, 1.0),
        jnp.asarray(bulk.floor),
        jnp.asarray(1e8 * usable.max()),
    )


def _result(bulk: Bulk, medium, parameters, optimum, spectra, slopes, noise, degrees) -> Fit:
    cov = np.asarray(covariance(optimum.jacobian))
    predicted = spectra[[list(_NAMES).index(name) for name in bulk.names]]
    sd = bulk.sigma
    if sd is None:
        sd = np.sqrt((noise * predicted) ** 2 + bulk.floor**2)
    residual = np.where(bulk.mask, (bulk.values - predicted) / sd, np.nan)
    metadata = {
        "source": bulk.source,
        "medium": type(medium).__name__,
        "masked_values": bulk.masked,
        "relative_noise": "given" if bulk.sigma is not None else float(noise),
        "misfit": float(np.sqrt(np.nanmean(residual**2))),
    }
    return Fit(
        parameters,
        np.asarray(optimum.x),
        cov,
        {
            name: derived_quantity(spectra[i], slopes[i], cov, "m-1", text)
            for i, (name, text) in enumerate(_NAMES.items())
        },
        bulk.wavelength,
        Status(int(optimum.code)),
        Predictive(
            np.where(bulk.mask, bulk.values, np.nan),
            predicted,
            sd,
            ("coefficient", "wavelength"),
            "m-1",
            {"coefficient": np.array(bulk.names)},
        ),
        metadata,
        None if bulk.sigma is not None else max(float(degrees), 1.0),
        sensitivity=_sensitivity(parameters, cov),
    )


def _sensitivity(parameters: Parameters, cov: np.ndarray) -> dict[str, dict[str, float]]:
    """By unknown and nuisance: its change if the nuisance's prior were centred a spread higher."""
    return {
        p.name: {
            q.name: float(cov[i, j] / q.spread)
            for j, q in enumerate(parameters)
            if q.nuisance and q.spread is not None
        }
        for i, p in enumerate(parameters)
        if not p.nuisance
    }
