"""Photographs of charts, open water and reefs to constituents."""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import oceaninv as oi
from fitting.core.least_squares import (
    Bend,
    Optimum,
    covariance,
    curvature,
    sentence,
    value_and_jacobian,
)
from fitting.core.multifidelity import EXACT, Demand, fit_within, scene_at
from fitting.core.parameters import Log, Parameter
from fitting.core.profile_likelihood import widened
from fitting.core.program_cache import kept
from fitting.core.result import Fit, Predictive, amount_bias
from fitting.observations.photo import Photo
from fitting.photo.exact_correction import approached, uncorrected
from fitting.photo.forward_model import WAVELENGTH, predict
from fitting.photo.problem import PhotoProblem, photo_residual, predict_all, prepare, search
from fitting.water_model.quantities import UNITS, nearest_jerlov, quantities_of
from oceaninv.fidelity.planning import rung
from oceaninv.transport.base import AbstractTransport

__all__ = [
    "WAVELENGTH",
    "PhotoProblem",
    "design",
    "fit_photo",
    "fit_photos",
    "photo_residual",
    "predict",
    "prepare",
    "search",
]

# Ancillary values: (value, standard deviation) by the name of a parameter or scalar quantity.
Known = Mapping[str, tuple[float, float]]


def _derived(problem: PhotoProblem, optimum: Optimum):
    """Optimum, covariance, quantities, their slopes, and what curvature does to all of them."""
    quantities, slopes = value_and_jacobian(problem.quantities, optimum.x)
    cov = covariance(optimum.jacobian)

    def curved(x):
        return problem.residual(x), jax.tree.map(jnp.log, problem.quantities(x))

    relative = jax.tree.map(lambda slope, q: slope / q[..., None], slopes, quantities)
    bend = curvature(curved, optimum.x, cov, optimum.jacobian, relative)
    return optimum, cov, quantities, slopes, bend


# What a photograph's model may err by to be corrected instead of exchanged.
_CORRIGIBLE = 0.5

# How often the noise is estimated anew, each time with a search from the last optimum.
_ROUNDS = 2


def _excess(problem: PhotoProblem, optimum: Optimum, cov) -> tuple[float, float]:
    """By what factor readings scatter more about the model than their noise says, 1 where chance
    explains it (three standard deviations of chi2); and chi2 per reading, priors included.

    What the model lacks (patches that are not what the table says, light that a chart's neighbours
    colour, a camera that is not linear) shows in the residuals alone: the scatter about the
    optimum, per degree of freedom, takes the place of the stated noise (Birge 1932, Physical
    Review 40:207).  Never smaller than stated; with a robust loss, stray readings are seen to.
    """
    size = sum(one.values.size for one in problem.readings)
    residual = np.asarray(optimum.residual)
    count = int(sum(int(one.mask.sum()) for one in problem.readings))
    # Residuals of pixels hold the determinant of their covariance: no misfit to be counted.
    plain = all(one.pixels is None for one in problem.readings)
    chi2 = float(np.sum(residual[: None if plain else size] ** 2)) / max(count, 1)
    slope = np.asarray(optimum.jacobian)[:size]
    spent = float(np.einsum("ri,ij,rj->", slope, np.asarray(cov), slope))
    free = count - spent
    if problem.robust is not None or not free > 1.0:
        return 1.0, chi2
    square = float(np.sum(residual[:size] ** 2)) / free
    return (float(np.sqrt(square)) if square > 1.0 + 3.0 * np.sqrt(2.0 / free) else 1.0), chi2


def _noisier(problem: PhotoProblem, factor) -> PhotoProblem:
    """The same posterior with the noise of every reading taken `factor` times as large."""
    return eqx.tree_at(
        lambda p: [one.sigma for one in p.readings],
        problem,
        [factor * one.sigma for one in problem.readings],
    )


@kept
def _solve(problem: PhotoProblem, starts: Float[Array, "start unknown"]):
    """The best of the optima from several starts, found together."""
    if starts.shape[0] == 1:
        optimum = search(problem, starts[0])
    else:
        optima = jax.vmap(lambda start: search(problem, start))(starts)
        sums = jnp.sum(optima.residual**2, axis=1)
        # An optimum beats a search that stopped short, whatever their sums.
        order = jnp.where(optima.code == 0, sums, sums + 1e30)
        best = jnp.argmin(jnp.where(jnp.isfinite(sums), order, jnp.inf))
        optimum = jax.tree.map(lambda leaf: leaf[best], optima)
    return _derived(problem, optimum)


@kept
def _solve_batch(problems: PhotoProblem):
    # One after the other in one program: side by side, every search would take as many steps as
    # the longest and both sides of every branch, which is slower than a loop of fits (measured).
    return jax.lax.map(lambda p: _derived(p, search(p, p.prior.centre)), problems)


@kept
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


def _lanes(stacked: PhotoProblem) -> list:
    """`_derived` of every photograph of a batch."""
    found = jax.tree.map(np.asarray, _solve_batch(stacked))
    count = len(found[0].code)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(count)]


def _problem(photos, transport, priors, matrix, sunlight, know, robust):
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
    - `tolerance`: instead of a transport, the largest relative error of a photograph that it may
      bring: what the closed form gets wrong in readings of charts and open water is corrected by
      looks at the exact light where it errs by less than half, else the cheapest rung is taken
      that does, see `oceaninv.plan`; what was done, and the error that is left, stand in
      `metadata["plan"]`.

    **Returns** a `Fit`.  Exposure, white balance, the light on each chart, the shape of the
    water's optical properties and the error of the closed form are free nuisances with priors, so
    that the intervals of the quantities (Kd, c, bb, a_cdm) and constituents hold what is known.

    Constituents are corrected for the curvature of the model: readings are nearly linear in
    amounts, and the mode of a logarithm is then low by half its variance (Box 1971).  That bias,
    bounded by half a standard deviation, is taken off their values (`Fit.bias`); quantities
    hardly have one and are those of the mode, as are `Fit.x`, the predictions and the middles of
    intervals, which curvature widens (`Fit.bend`).

    Standard deviations of unknowns beside a constituent that may as well be absent are those of
    their profiles along it (`Fit.covariance` is scaled): at such an optimum the ellipsoid takes it
    for known to be absent.  That of a constituent known to 0.15 or worse is of the longer side of
    its own profile: the ellipsoid is too small where it came out high.

    Readings that scatter more about the model than their noise allows have their noise estimated
    from that scatter, and the fit done again: `metadata["noise_factor"]` says by how much the
    stated noise was multiplied (1: not at all), `metadata["reduced_chi2"]` is by the stated noise.
    """
    photos = [photos] if isinstance(photos, Photo) else list(photos)
    if not photos:
        raise ValueError("no photograph was given.")
    if starts < 1:
        raise ValueError(f"starts is {starts}; give 1 or more.")

    def solve(model, start, correction=None):
        parameters, problem = _problem(photos, model, priors, matrix, sunlight, know, robust)
        if tolerance is not None:
            # A fit and those that correct it share a program.
            correction = correction or uncorrected(problem)
            problem = dataclasses.replace(problem, correction=correction)
        begin = _starts(parameters, problem, starts) if start is None else jnp.asarray(start)[None]
        found, stated, factor = _solve(problem, begin), None, 1.0
        for _ in range(_ROUNDS):
            excess, chi2 = _excess(problem, found[0], found[1])
            stated = chi2 if stated is None else stated
            if excess == 1.0:
                break
            factor *= excess
            problem = _noisier(problem, excess)
            found = _solve(problem, jnp.broadcast_to(found[0].x, begin.shape))
        return _result(photos, parameters, problem, *found, stated=stated, factor=factor)

    if tolerance is not None and any(photo.lamp for photo in photos):
        raise ValueError("tolerance chooses a model of daylight; lamplight has one model only.")
    if tolerance is None:
        return solve(oi.TwoStream() if transport is None else transport, None)
    sun = oi.spectrum.daylight(WAVELENGTH) if sunlight is None else sunlight

    def scene(fit):
        return scene_at(fit.parameters, fit.x, WAVELENGTH, sun)

    demands = [Demand("photograph", photo.depth, photo.response) for photo in photos]
    # Through a dearer rung a search would take as long as through the exact light.
    fit, chosen = fit_within(tolerance, transport, solve, scene, demands, _CORRIGIBLE)
    if rung(chosen) == rung(EXACT):
        return fit

    def search_again(problem, x):
        optimum, cov, *_ = _solve(problem, jnp.asarray(x)[None])
        return np.asarray(optimum.x), np.sqrt(np.diag(np.asarray(cov)))

    stated = _noisier(fit.problem, 1.0 / fit.metadata["noise_factor"])
    return approached(fit, stated, EXACT, search_again, lambda x, c: solve(chosen, x, c))


def _starts(parameters, problem: PhotoProblem, count: int) -> Float[Array, "start unknown"]:
    """Where searches begin: the priors' centres, then draws of the constituents."""
    begin = np.tile(np.asarray(problem.prior.centre), (count, 1))
    rng = np.random.default_rng(0)
    for i, parameter in enumerate(parameters):
        if not parameter.nuisance:
            begin[1:, i] += 0.5 * (parameter.spread or 1.0) * rng.standard_normal(count - 1)
    return jnp.asarray(begin)


def fit_photos(
    photos: Sequence[Photo],
    *,
    transport: AbstractTransport | None = None,
    priors: dict[str, Parameter] | None = None,
    matrix: bool = False,
) -> list[Fit]:
    """Fit many photographs, each of its own water, in one batched program.

    The photographs must be alike: as many charts, patches and backgrounds each, in one order.
    Arguments as in `fit_photo`; a search that fails says so in its own `result`.
    """
    transport = oi.TwoStream() if transport is None else transport
    made = [_problem([p], transport, priors, matrix, None, None, None) for p in photos]
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
    lanes, stated, factors = _lanes(stacked), np.zeros(0), np.ones(len(made))
    for _ in range(_ROUNDS):
        seen = [_excess(p, lane[0], lane[1]) for (_, p), lane in zip(made, lanes, strict=True)]
        excess, chi2 = np.array(seen).T
        stated = stated if len(stated) else chi2
        if np.all(excess == 1.0):
            break
        factors *= excess
        made = [(q, _noisier(p, e)) for (q, p), e in zip(made, excess, strict=True)]
        lanes = _lanes(jax.tree.map(lambda *leaves: jnp.stack(leaves), *(p for _, p in made)))
    return [
        _result([photo], parameters, problem, *lane, stated=float(chi2), factor=float(factor))
        for photo, (parameters, problem), lane, chi2, factor in zip(
            photos, made, lanes, stated, factors, strict=True
        )
    ]


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
    """What a planned protocol would tell about a water, before the dive.

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
    parameters, problem = _problem(photos, transport, priors, matrix, None, know, None)
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
    return _result(photos, parameters, problem, *_at(problem, x))


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


def _bent(bend: Bend | None, parameters, cov) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Bias and second-order spread, bounded: second order is not to be trusted further."""
    if bend is None:
        return None, None
    sd = np.sqrt(np.diag(cov))
    amounts = np.array([isinstance(p.transform, Log) and not p.nuisance for p in parameters])
    return np.where(amounts, amount_bias(sd), 0.0), np.minimum(np.asarray(bend.spread), sd)


def _result(
    photos,
    parameters,
    problem: PhotoProblem,
    optimum,
    cov,
    values,
    slopes,
    bend,
    *,
    stated: float | None = None,
    factor: float = 1.0,
) -> Fit:
    readings, cov = problem.readings, np.asarray(cov)
    observed = [np.where(np.asarray(r.mask), np.asarray(r.values), np.nan) for r in readings]
    predictive = Predictive(
        np.concatenate(observed),
        _fitted(readings, np.asarray(optimum.residual), problem.robust),
        np.concatenate([np.asarray(one.sigma) for one in readings]),
        ("reading", "channel"),
        "1",
    )
    quantities, sensitivity = quantities_of(values, slopes, parameters, cov, bend)
    bias, spread = _bent(bend, parameters, cov)
    if bend is not None:
        cov = widened(problem, parameters, optimum.x, cov)
    jerlov, away = nearest_jerlov(WAVELENGTH, quantities["Kd"])
    count = int(sum(int(one.mask.sum()) for one in readings))
    if stated is None:
        stated = float(np.sum(np.asarray(optimum.residual) ** 2)) / max(count, 1)
    return Fit(
        parameters,
        np.asarray(optimum.x),
        cov,
        quantities,
        WAVELENGTH,
        sentence(optimum.code),
        predictive,
        {
            "source": "; ".join(photo.source for photo in photos),
            "transport": type(problem.transport).__name__,
            "kd_definition": "mean from the surface to the depth of 10 % light",
            "nearest_jerlov_type": jerlov,
            "nearest_jerlov_rms_ln_kd": away,
            "values": "mode" if bend is None else "constituents corrected for curvature (Box 1971)",
            "masked_values": sum(photo.masked for photo in photos),
            "readings": count,
            "reduced_chi2": stated,
            "noise_factor": factor,
        },
        sensitivity=sensitivity,
        problem=problem,
        bias=bias,
        bend=spread,
    )
