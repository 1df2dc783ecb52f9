"""The `Fit` of photographs: values, intervals, what was fitted."""

import numpy as np

from fitting.core.diagnostics import Status
from fitting.core.least_squares import SecondOrderError
from fitting.core.parameters import Log
from fitting.core.profile_likelihood import profile_adjusted_covariance
from fitting.core.result import Fit, Predictive, amount_bias
from fitting.observations.photo import WAVELENGTH
from fitting.photo.problem import PhotoProblem
from fitting.water_model.quantities import nearest_jerlov, quantities_of


def _fitted(readings, residual: np.ndarray, robust) -> np.ndarray:
    """(reading, channel) fitted values of all photographs, NaN where the reading is masked."""
    parts, at = [], 0
    for one in readings:
        size = one.values.size
        misfit = residual[at : at + size].reshape(one.values.shape)
        if robust is not None:
            # Inverse of `_robust`: loss / (2 limit^2) = sqrt(1 + e^2) - 1.
            loss = misfit**2 / (2.0 * float(robust) ** 2) + 1.0
            misfit = np.sign(misfit) * float(robust) * np.sqrt(np.maximum(loss**2 - 1.0, 0.0))
        fitted = np.asarray(one.values) - misfit * np.asarray(one.sigma)
        parts.append(np.where(np.asarray(one.mask), fitted, np.nan))
        at += size
    return np.concatenate(parts)


def _bias_and_second_order_sd(
    second_order: SecondOrderError | None, parameters, cov
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Bias and second-order standard deviation, bounded: second order is not valid further."""
    if second_order is None:
        return None, None
    sd = np.sqrt(np.diag(cov))
    amounts = np.array([isinstance(p.transform, Log) and not p.nuisance for p in parameters])
    return np.where(amounts, amount_bias(sd), 0.0), np.minimum(np.asarray(second_order.sd), sd)


def photo_result(
    photos,
    parameters,
    problem: PhotoProblem,
    optimum,
    cov,
    values,
    slopes,
    second_order,
    *,
    stated: float | None = None,
    factor: float = 1.0,
) -> Fit:
    """A search that has ended as a `Fit`.

    `stated`: chi-square per reading by the stated noise, from the residuals where None; `factor`:
    on that noise.
    """
    readings, cov = problem.readings, np.asarray(cov)
    observed = [np.where(np.asarray(r.mask), np.asarray(r.values), np.nan) for r in readings]
    predictive = Predictive(
        np.concatenate(observed),
        _fitted(readings, np.asarray(optimum.residual), problem.robust),
        np.concatenate([np.asarray(one.sigma) for one in readings]),
        ("reading", "channel"),
        "1",
    )
    quantities, sensitivity = quantities_of(values, slopes, parameters, cov, second_order)
    bias, second_order_sd = _bias_and_second_order_sd(second_order, parameters, cov)
    if second_order is not None:
        cov = profile_adjusted_covariance(problem, parameters, optimum.x, cov)
    jerlov, difference = nearest_jerlov(WAVELENGTH, quantities["Kd"])
    count = int(sum(int(one.mask.sum()) for one in readings))
    if stated is None:
        stated = float(np.sum(np.asarray(optimum.residual) ** 2)) / max(count, 1)
    return Fit(
        parameters,
        np.asarray(optimum.x),
        cov,
        quantities,
        WAVELENGTH,
        Status(int(optimum.code)),
        predictive,
        {
            "source": "; ".join(photo.source for photo in photos),
            "transport": type(problem.transport).__name__,
            "kd_definition": "mean from the surface to the depth of 10 % light",
            "nearest_jerlov_type": jerlov,
            "nearest_jerlov_rms_ln_kd": difference,
            "values": "mode"
            if second_order is None
            else "constituents corrected for curvature (Box 1971)",
            "masked_values": sum(photo.masked for photo in photos),
            "readings": count,
            "reduced_chi2": stated,
        },
        sensitivity=sensitivity,
        problem=problem,
        bias=bias,
        second_order_sd=second_order_sd,
        noise_factor=factor,
    )
