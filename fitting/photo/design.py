"""Expected uncertainties of a planned set of photographs."""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp

import oceaninv as oi
from fitting.core.least_squares import (
    Optimum,
    covariance,
    value_and_jacobian,
)
from fitting.core.parameters import Parameter
from fitting.core.program_cache import cached_jit
from fitting.core.result import Fit
from fitting.observations.photo import Photo
from fitting.photo.fit_photo import Known, posterior_of
from fitting.photo.problem import PhotoProblem, predict_all
from fitting.photo.result import photo_result
from oceaninv.foundation.double_precision import in_double_precision
from oceaninv.transport.base import AbstractTransport


@cached_jit
def _at(problem: PhotoProblem, x):
    residual, jacobian = value_and_jacobian(problem.residual, x)
    quantities, slopes = value_and_jacobian(problem.quantities, x)
    return (
        Optimum(x, residual, jacobian, jnp.zeros((), jnp.int32)),
        covariance(jacobian),
        quantities,
        slopes,
        None,
    )


@in_double_precision
def design(
    photos: Photo | Sequence[Photo],
    water: Mapping[str, float],
    *,
    transport: AbstractTransport | None = None,
    priors: dict[str, Parameter] | None = None,
    matrix: bool = False,
    know: Known | None = None,
    noise: float = 0.03,
) -> Fit:
    """Expected uncertainties of a planned protocol, before the dive.

    **Arguments:** as in `fit_photo`, but the readings of `photos` may be any positive numbers;
    `water`: the supposed truth by parameter name (`{"chlorophyll": 1.0, ...}`); `noise`: relative
    standard deviation of a reading.

    **Returns** a `Fit` at that truth: its `sd`, intervals and quantities are those expected,
    linearised, from readings with that noise.
    """
    photos = [photos] if isinstance(photos, Photo) else list(photos)
    if any(photo.pixels is not None for photo in photos):
        raise ValueError("design plans charts and open water; leave pixels out.")
    transport = oi.TwoStream() if transport is None else transport
    parameters, problem = posterior_of(photos, transport, priors, matrix, None, know, None)
    known = {p.name: p for p in parameters}
    for name in water:
        if name not in known:
            from oceaninv.foundation.tables import unknown

            raise unknown("parameter", name, sorted(known))
    x = jnp.asarray([
        p.transform.coordinate(water.get(p.name, p.centre)) for p in parameters
    ])  # fmt: skip
    seen = predict_all(problem.layout, problem.readings, transport, problem.sunlight, x)
    planned = tuple(
        eqx.tree_at(
            lambda r: (r.values, r.sigma, r.mask),
            one,
            (values, noise * values, jnp.ones_like(one.mask)),
        )
        for one, (values, _) in zip(problem.readings, seen, strict=True)
    )
    problem = dataclasses.replace(problem, readings=planned)
    return photo_result(photos, parameters, problem, *_at(problem, x))
