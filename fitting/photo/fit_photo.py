"""Photographs of charts, open water and reefs to constituents."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import oceaninv as oi
from fitting.core.diagnostics import Status
from fitting.core.least_squares import (
    Optimum,
    check_solver,
    covariance,
    curvature,
    value_and_jacobian,
)
from fitting.core.multifidelity import EXACT, AccuracyTarget, multifidelity_fit
from fitting.core.parameters import Parameter
from fitting.core.program_cache import cached_jit
from fitting.core.result import Fit
from fitting.observations.photo import WAVELENGTH, Photo
from fitting.photo.exact_correction import refine_with_exact_model, uncorrected
from fitting.photo.problem import PhotoProblem, prepare, search
from fitting.photo.result import photo_result
from fitting.water_model.quantities import UNITS
from fitting.water_model.scene_of_fit import scene_at
from oceaninv.fidelity.planning import model_label
from oceaninv.foundation.argument_names import names_checked
from oceaninv.foundation.double_precision import in_double_precision
from oceaninv.transport.base import AbstractTransport, check_transport

# Ancillary values: (value, standard deviation) by the name of a parameter or scalar quantity.
Known = Mapping[str, tuple[float, float]]


def _derived(problem: PhotoProblem, optimum: Optimum):
    """Optimum, covariance, quantities, their derivatives, and second-order errors of all."""
    quantities, slopes = value_and_jacobian(problem.quantities, optimum.x)
    cov = covariance(optimum.jacobian)

    def curved(x):
        return problem.residual(x), jax.tree.map(jnp.log, problem.quantities(x))

    relative = jax.tree.map(lambda slope, q: slope / q[..., None], slopes, quantities)
    second_order = curvature(curved, optimum.x, cov, optimum.jacobian, relative)
    return optimum, cov, quantities, slopes, second_order


# Largest error of a photograph's model that is corrected; above it, the model is replaced.
_CORRECTABLE = 0.5

# How often the noise is re-estimated, each time with a search from the last optimum.
_ROUNDS = 2


def birge_ratio(problem: PhotoProblem, optimum: Optimum, cov) -> tuple[float, float]:
    """Scatter of the readings about the model over their stated noise, and chi2 per reading.

    The ratio is 1 where chance explains the scatter (within three standard deviations of chi2) and
    is never below 1.  What the model lacks (patches that differ from their table, light coloured by
    a chart's neighbours, a camera that is not linear) shows in the residuals alone: the scatter
    about the optimum, per degree of freedom, replaces the stated noise (Birge 1932, Physical Review
    40:207).  With a robust loss the ratio is 1, as that loss deals with stray readings.  chi2 is
    that of readings and priors.
    """
    size = sum(one.values.size for one in problem.readings)
    residual = np.asarray(optimum.residual)
    count = int(sum(int(one.mask.sum()) for one in problem.readings))
    # Residuals of pixels contain the determinant of their covariance, which is no misfit.
    plain = all(one.pixels is None for one in problem.readings)
    chi2 = float(np.sum(residual[: None if plain else size] ** 2)) / max(count, 1)
    slope = np.asarray(optimum.jacobian)[:size]
    spent = float(np.einsum("ri,ij,rj->", slope, np.asarray(cov), slope))
    free = count - spent
    if problem.robust is not None or not free > 1.0:
        return 1.0, chi2
    square = float(np.sum(residual[:size] ** 2)) / free
    return (float(np.sqrt(square)) if square > 1.0 + 3.0 * np.sqrt(2.0 / free) else 1.0), chi2


def scale_noise(problem: PhotoProblem, factor) -> PhotoProblem:
    """The same posterior with `factor` times the noise of every reading."""
    return eqx.tree_at(
        lambda p: [one.sigma for one in p.readings],
        problem,
        [factor * one.sigma for one in problem.readings],
    )


def _solve(problem: PhotoProblem, starts: Float[Array, "start unknown"], solver: Any = None):
    """`_derived` of the best of the optima from several starts."""
    if solver is None:
        return _solve_starts(problem, starts, None)
    # A solver may hold functions that cannot be stored with the program.
    return _solve_starts.jitted(problem, starts, solver)


@cached_jit
def _solve_starts(problem: PhotoProblem, starts: Float[Array, "start unknown"], solver):
    """The best of the optima from several starts, found together."""
    if starts.shape[0] == 1:
        optimum = search(problem, starts[0], solver)
    else:
        optima = jax.vmap(lambda start: search(problem, start, solver))(starts)
        sums = jnp.sum(optima.residual**2, axis=1)
        # An optimum beats a search that stopped short, whatever their sums.
        order = jnp.where(optima.code == Status.CONVERGED, sums, sums + 1e30)
        best = jnp.argmin(jnp.where(jnp.isfinite(sums), order, jnp.inf))
        optimum = jax.tree.map(lambda leaf: leaf[best], optima)
    return _derived(problem, optimum)


@cached_jit
def _solve_batch(problems: PhotoProblem):
    # One after another in one program: in a vmapped batch, every search would take as many steps
    # as the longest and both sides of every branch, which is slower than a loop (measured).
    return jax.lax.map(lambda p: _derived(p, search(p, p.prior.centre)), problems)


def _solved_photographs(stacked: PhotoProblem) -> list:
    """`_derived` of every photograph of a batch."""
    found = jax.tree.map(np.asarray, _solve_batch(stacked))
    count = len(found[0].code)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(count)]


def posterior_of(photos, transport, priors, matrix, sunlight, know, robust):
    """(parameters, problem) of photographs of one water; arguments as for `fit_photo`.

    Raises ValueError where a value in `know` has no such name or is not positive.
    """
    parameters, readings, spectrum = prepare(photos, transport, priors, matrix, sunlight)
    names = [*parameters.names, *(n for n in UNITS if n not in ("Kd", "c"))]
    rows = []
    for name, (value, sd) in (know or {}).items():
        if name not in names:
            from oceaninv.foundation.tables import unknown

            raise unknown("known value", name, sorted(names))
        if not (np.isfinite(value) and value > 0 and np.isfinite(sd) and sd > 0):
            raise ValueError(f"{name} is known as {value} +- {sd}; both must be positive.")
        rows.append((np.log(value), sd / value))
    problem = PhotoProblem(
        parameters.layout(),
        parameters.prior(),
        readings,
        transport,
        spectrum,
        tuple(know or ()),
        jnp.asarray(rows, dtype=float) if rows else None,
        None if robust is None else jnp.asarray(robust, dtype=float),
    )
    return parameters, problem


@names_checked
@in_double_precision
def fit_photo(
    photos: Photo | Sequence[Photo],
    *,
    transport: AbstractTransport | None = None,
    priors: dict[str, Parameter] | None = None,
    matrix: bool = False,
    sunlight: Float[np.ndarray, " wl"] | None = None,
    know: Known | None = None,
    robust: float | None = None,
    starts: int = 1,
    tolerance: float | None = None,
    solver: Any = None,
) -> Fit:
    """Fit one or many photographs of one water.

    **Arguments:**

    - `photos`: readings of charts, of open water and of things of unknown reflectance, see `Photo`.
    - `transport`: `oceaninv.TwoStream()` unless given.
    - `priors`: parameters to exchange by name, for instance a known CDOM.
    - `matrix`: whether the camera's channels may be mixed by an unknown 3 x 3 matrix (frames from
      a raw developer) instead of unknown gains alone.
    - `sunlight`: (16,) relative spectrum above the surface at
      `fitting.photo.fit_photo.WAVELENGTH`; CIE D65 unless given.
    - `know`: ancillary values as observations, (value, standard deviation) by the name of a
      parameter or scalar quantity: `{"cdom": (0.12, 0.01), "Kd_490": (0.09, 0.005)}`.
    - `robust`: readings further off than this many standard deviations count linearly instead of
      squared (pseudo-Huber), for stray patches; None squares all.
    - `starts`: searches from so many points, the first at the priors' centres, the others drawn
      from the priors of the constituents; the best is taken.
    - `tolerance`: instead of a transport, the largest relative error that the model of the light
      may bring to a reading.  Where the closed form errs by less than half, evaluations of the
      exact model correct it; elsewhere the cheapest transport within the tolerance is taken, see
      `oceaninv.plan`.  `Fit.plan` says what was done, and what error remains.
    - `solver`: of the search: an `optimistix.AbstractLeastSquaresSolver` or
      `optimistix.AbstractMinimiser`, as `optimistix.BFGS(rtol=1e-6, atol=1e-6)`, or
      `fitting.core.jaxopt_solver.BoundedSolver()`; Levenberg-Marquardt unless given.  Compiled
      programs of other solvers are not stored between processes.

    **Returns** a `Fit`.  Exposure, white balance, the light on each chart, the shape of the
    water's optical properties and the error of the closed form are free nuisances with priors, so
    that the intervals of the quantities (Kd, c, bb, a_cdm) and constituents include their
    uncertainty.

    Constituents are corrected for the curvature of the model: readings are nearly linear in
    amounts, and the mode of a logarithm is then low by half its variance (Box 1971).  That bias,
    limited to half a standard deviation, is subtracted from their values (`Fit.bias`); quantities
    have hardly any and are those of the mode, as are `Fit.x`, the predictions and the middles of
    intervals, which second-order errors widen (`Fit.second_order_sd`).

    Where a constituent may be absent, standard deviations of the other unknowns are those of the
    profile likelihood along it (`Fit.covariance` is scaled): the ellipsoid at such an optimum
    treats the constituent as known to be absent.  The standard deviation of a constituent that is
    uncertain by 0.15 or more is that of the wider side of its own profile: the ellipsoid is too
    small where the constituent came out high.

    Readings that scatter more about the model than their noise allows have their noise estimated
    from that scatter, and the fit done again: `Fit.noise_factor` says by how much the stated noise
    was multiplied (1: not at all), `metadata["reduced_chi2"]` is by the stated noise.
    """
    photos = [photos] if isinstance(photos, Photo) else list(photos)
    if not photos:
        raise ValueError("no photograph was given.")
    if starts < 1:
        raise ValueError(f"starts is {starts}; give 1 or more.")
    check_solver(solver)
    if transport is not None:
        check_transport(transport)

    def solve(model, start, correction=None):
        parameters, problem = posterior_of(photos, model, priors, matrix, sunlight, know, robust)
        if tolerance is not None:
            # A fit and those that correct it share a program.
            correction = correction or uncorrected(problem)
            problem = dataclasses.replace(problem, correction=correction)
        begin = _starts(parameters, problem, starts) if start is None else jnp.asarray(start)[None]
        found, stated, factor = _solve(problem, begin, solver), None, 1.0
        for _ in range(_ROUNDS):
            ratio, chi2 = birge_ratio(problem, found[0], found[1])
            stated = chi2 if stated is None else stated
            if ratio == 1.0:
                break
            factor *= ratio
            problem = scale_noise(problem, ratio)
            found = _solve(problem, jnp.broadcast_to(found[0].x, begin.shape), solver)
        return photo_result(photos, parameters, problem, *found, stated=stated, factor=factor)

    if tolerance is not None and any(photo.lamp for photo in photos):
        raise ValueError("tolerance chooses a model of daylight; lamplight has one model only.")
    if tolerance is None:
        return solve(oi.TwoStream() if transport is None else transport, None)
    sun = oi.spectrum.daylight(WAVELENGTH) if sunlight is None else sunlight

    def scene(fit):
        return scene_at(fit.parameters, fit.x, WAVELENGTH, sun)

    targets = [AccuracyTarget("photograph", photo.depth, photo.response) for photo in photos]
    # A search through a model between the two would take as long as one through the exact model.
    fit, chosen = multifidelity_fit(tolerance, transport, solve, scene, targets, _CORRECTABLE)
    if model_label(chosen) == model_label(EXACT):
        return fit

    def search_again(problem, x):
        optimum, cov, *_ = _solve(problem, jnp.asarray(x)[None], solver)
        return np.asarray(optimum.x), np.sqrt(np.diag(np.asarray(cov)))

    stated = scale_noise(fit.problem, 1.0 / (fit.noise_factor or 1.0))
    return refine_with_exact_model(
        fit, stated, EXACT, search_again, lambda x, c: solve(chosen, x, c)
    )


def _starts(parameters, problem: PhotoProblem, count: int) -> Float[Array, "start unknown"]:
    """Where searches begin: the priors' centres, then draws of the constituents."""
    begin = np.tile(np.asarray(problem.prior.centre), (count, 1))
    rng = np.random.default_rng(0)
    for i, parameter in enumerate(parameters):
        if not parameter.nuisance:
            begin[1:, i] += 0.5 * (parameter.spread or 1.0) * rng.standard_normal(count - 1)
    return jnp.asarray(begin)


@names_checked
@in_double_precision
def fit_photos(
    photos: Sequence[Photo],
    *,
    transport: AbstractTransport | None = None,
    priors: dict[str, Parameter] | None = None,
    matrix: bool = False,
) -> list[Fit]:
    """Fit many photographs, each of its own water, in one program.

    The photographs must be alike: as many charts, patches and backgrounds each, in one order.
    Arguments as in `fit_photo`; a search that fails says so in the `status` of its `Fit`.
    """
    transport = oi.TwoStream() if transport is None else transport
    made = [posterior_of([p], transport, priors, matrix, None, None, None) for p in photos]
    first = jax.tree.structure(made[0][1]) if made else None
    shapes = [[leaf.shape for leaf in jax.tree.leaves(problem)] for _, problem in made]
    for p, (_, problem) in enumerate(made):
        if jax.tree.structure(problem) != first or shapes[p] != shapes[0]:
            raise ValueError(
                f"photograph {p} differs from the first in its charts, patches or camera; batches "
                "take photographs that are alike."
            )
    if not made:
        return []
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(problem for _, problem in made))
    found, stated, factors = _solved_photographs(stacked), np.zeros(0), np.ones(len(made))
    for _ in range(_ROUNDS):
        seen = [birge_ratio(p, one[0], one[1]) for (_, p), one in zip(made, found, strict=True)]
        ratio, chi2 = np.array(seen).T
        stated = stated if len(stated) else chi2
        if np.all(ratio == 1.0):
            break
        factors *= ratio
        made = [(q, scale_noise(p, e)) for (q, p), e in zip(made, ratio, strict=True)]
        found = _solved_photographs(
            jax.tree.map(lambda *leaves: jnp.stack(leaves), *(p for _, p in made))
        )
    return [
        photo_result([photo], parameters, problem, *one, stated=float(chi2), factor=float(factor))
        for photo, (parameters, problem), one, chi2, factor in zip(
            photos, made, found, stated, factors, strict=True
        )
    ]
