"""Protocols of photographs whose statistics are counted: what is free, what is known, the bound."""

import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from fitting import Background, Chart, Photo
from fitting.core.least_squares import covariance, curvature, value_and_jacobian
from fitting.core.likelihood_regions import held, whitening
from fitting.core.parameters import Parameter, Parameters, Prior
from fitting.core.profile_likelihood import profile_adjusted_sd, profile_along
from fitting.core.result import amount_bias
from fitting.photo.problem import PhotoProblem, predict_all, prepare, search
from fitting.water_model.quantities import water_quantities
from tests.acceptance.photo_statistics import POINT, WAVELENGTH, patches

CAMERA, SUN, CHUNK = "Nikon D850", 40.0, 25
CONSTITUENTS = ("chlorophyll", "cdom", "detritus")
QUANTITIES = ("a_cdm_440", "Kd_490", "c_550", "bb_550")
NAMES = CONSTITUENTS + QUANTITIES
WATERS = {
    "clear": (0.2, 0.03, 0.01),
    "coastal": (1.5, 0.15, 0.08),
    "turbid": (5.0, 0.5, 0.4),
    "other coastal": (2.0, 0.15, 0.08),
}


class Partly(Parameters):
    """Unknowns beside numbers that are known and take no part in the search."""

    known: tuple[tuple[str, float], ...]

    def __new__(cls, parameters, known=()):
        made = super().__new__(cls, parameters)
        made.known = tuple(known)
        return made

    def values(self, x):
        fixed = {name: jnp.asarray(value, x.dtype) for name, value in self.known}
        return fixed | super().values(x)

    def layout(self):
        return Partly(super().layout(), self.known)

    def __hash__(self):
        return hash((tuple(self), self.known))

    def __eq__(self, other):
        return tuple(self) == tuple(other) and self.known == getattr(other, "known", None)


class Protocol(NamedTuple):
    """What is photographed, the relative sd of one reading, and what is unknown.

    `free`: nuisances by the start of their names, each with the spread of its prior, or None for
    the fit's own; every other nuisance is known.  Of names that fit, the first counts.  `known`:
    nuisances that are known to be elsewhere than at the centres of their priors.
    """

    photos: Callable[[], list[Photo]]
    noise: float
    free: Mapping[str, float | None]
    known: Mapping[str, float] = MappingProxyType({})


def photo(ranges, depth=5.0, zeniths=(90.0,), range_sd=0.0, **kwargs: Any) -> Photo:
    """One frame of ColorCheckers at `ranges` and open water; the readings are to be replaced."""
    ones = np.ones((24, 3))
    charts = [Chart(ones, patches(), r, distance_sd=range_sd, board=POINT) for r in ranges]
    water = [Background(np.ones((len(zeniths), 3)), zeniths)] if zeniths else []
    response = oi.spectrum.camera_response(CAMERA)
    return Photo(charts, water, response=response, depth=depth, solar_zenith=SUN, **kwargs)


SCATTERING_RATIO = float(np.log(2.0))
_FIELD = {
    "gain": None,
    "detritus_scattering_ratio": SCATTERING_RATIO,
    "range": 0.05,
    "chart": 0.2,
    "exposure": 0.03,
}
_ALGAE = ("phytoplankton_exponent", "phytoplankton_absorption", "phytoplankton_scattering")
_SHAPES = ("cdom_slope", "detritus_slope", "detritus_exponent", *_ALGAE, "backscatter")


# Spectra of scattering as Gordon & Morel 1983 and Stramski et al. 2001, and bb/b of algae and other
# particles further apart than by default (0.005 and 0.025, not 0.010 and 0.018).
_OTHER = {
    "phytoplankton_exponent": 1.0,
    "detritus_exponent": 0.9,
    "assumed_backscatter_split": 1.0,
}


def _three_depths():
    return [photo((1.0,), d, range_sd=0.05, exposure=1.0) for d in (2.0, 8.0, 15.0)]


PROTOCOLS = {
    "ideal": Protocol(lambda: [photo((0.5, 1.0, 2.0))], 0.01, {"gain": None}),
    "ideal, other reading": Protocol(
        lambda: [photo((0.5, 3.0, 8.0), 8.0)], 0.01, {"gain": None}, _OTHER
    ),
    "three depths, other reading": Protocol(_three_depths, 0.03, _FIELD, _OTHER),
    "single photo, other reading": Protocol(
        lambda: [photo((1.0, 3.0), range_sd=0.05)], 0.03, _FIELD, _OTHER
    ),
    "scattering ratio unknown": Protocol(
        lambda: [photo((0.5, 1.0, 2.0))],
        0.01,
        {"gain": None, "detritus_scattering_ratio": SCATTERING_RATIO},
    ),
    "scattering ratio and all else unknown": Protocol(
        lambda: [photo((0.5, 1.0, 2.0))], 0.01, {"": None}
    ),
    "three depths": Protocol(_three_depths, 0.03, _FIELD),
    "three depths, shapes": Protocol(_three_depths, 0.03, _FIELD | dict.fromkeys(_SHAPES)),
    "three depths, a_y to 10 %": Protocol(_three_depths, 0.03, _FIELD | {"cdom": 0.1}),
    "three depths, matrix": Protocol(_three_depths, 0.03, _FIELD | {"mix": None}),
    "single photo": Protocol(lambda: [photo((1.0, 3.0), range_sd=0.05)], 0.03, _FIELD),
    "background": Protocol(
        lambda: [photo((), exposure=1.0, exposure_sd=1.0)], 0.03, {"exposure": None}
    ),
    "background, white balance known": Protocol(
        lambda: [photo((), exposure=1.0, exposure_sd=1.0)], 0.03, {"gain": 1e-4, "": None}
    ),
    "background, everything unknown": Protocol(
        lambda: [photo((), exposure=1.0, exposure_sd=1.0)], 0.03, {"": None}
    ),
    "JPEG without chart": Protocol(lambda: [photo((), zeniths=(90.0, 120.0))], 0.05, {"": None}),
}  # fmt: skip


class Setup(NamedTuple):
    """A protocol's unknowns and its compiled programs, batched over draws.

    - `forward` (x) -> (readings (reading, channel), ln quantities); readings of all photographs
      one below the other.
    - `fit` (readings, start, prior) -> a dictionary of numbers; `derive` (x) -> ln quantities.
    - `problem` (readings, prior) -> the posterior of one draw; `profile_along` (readings, prior, x,
      i, by) -> the profile along the unknown i in steps of `by`; `held` (readings, prior, x,
      target, root) -> its optimum and sum of squares with ln of NAMES held.
    """

    parameters: Partly
    noise: float
    problem: Callable
    profile_along: Callable
    held: Callable
    forward: Callable
    fit: Callable
    derive: Callable


def _means(name: str, parameter: Parameter) -> bool:
    nuisance = parameter.nuisance and name not in CONSTITUENTS
    return parameter.name.startswith(name) if nuisance else parameter.name == name


def _unknowns(protocol: Protocol, water: tuple[float, ...]):
    matrix = "mix" in protocol.free
    parameters, readings, sunlight = prepare(protocol.photos(), oi.TwoStream(), matrix=matrix)
    free, known = [], []
    for p in parameters:
        match = [name for name in protocol.free if _means(name, p)]
        spread = protocol.free[match[0]] if match else None
        spread = p.spread if spread is None else spread
        if match and not p.nuisance:
            # Known from a sample to so much: the prior is about the truth.
            p = Parameter(p.name, water[CONSTITUENTS.index(p.name)])
        if match or not p.nuisance:
            free.append(Parameter(p.name, p.centre, spread, p.transform, p.unit, p.nuisance))
        else:
            known.append((p.name, protocol.known.get(p.name, p.centre)))
    known += [(n, v) for n, v in protocol.known.items() if n not in parameters.names]
    return Partly(free, known), readings, sunlight


@functools.cache
def setup(name: str, water: tuple[float, ...] = WATERS["coastal"]) -> Setup:
    """The programs of a protocol."""
    protocol = PROTOCOLS[name]
    parameters, readings, sunlight = _unknowns(protocol, water)
    layout, transport = parameters.layout(), oi.TwoStream()
    own = np.array([parameters.names.index(name) for name in CONSTITUENTS])
    edges = np.cumsum([one.values.shape[0] for one in readings])[:-1]

    def quantities(x):
        found = water_quantities(layout.values(x), WAVELENGTH, transport)
        return jnp.log(jnp.stack([found[q] for q in QUANTITIES]))

    def forward(x):
        seen = predict_all(layout, readings, transport, sunlight, x)
        return jnp.concatenate([values for values, _ in seen]), quantities(x)

    def problem(seen, prior):
        here = []
        for one, values in zip(readings, jnp.split(seen, edges), strict=True):
            mask = values > 0
            sigma = jnp.where(mask, protocol.noise * values, 1.0)
            new = (jnp.where(mask, values, 1.0), sigma, mask)
            here.append(eqx.tree_at(lambda r: (r.values, r.sigma, r.mask), one, new))
        return PhotoProblem(layout, prior, tuple(here), transport, sunlight)

    def fit(seen, start, prior):
        posed = problem(seen, prior)
        optimum = search(posed, start)
        cov = covariance(optimum.jacobian)
        logs, slope = value_and_jacobian(quantities, optimum.x)

        def curved(x):
            return posed.residual(x), quantities(x)

        second_order = curvature(curved, optimum.x, cov, optimum.jacobian, slope)
        sd = jnp.sqrt(jnp.diagonal(cov))
        of_logs = jnp.sqrt(jnp.einsum("qi,ij,qj->q", slope, cov, slope))
        asked = jnp.concatenate([jnp.eye(len(parameters), dtype=cov.dtype)[own], slope])
        # Bounded as in `fit_photo`.
        return {
            "x": optimum.x,
            "code": optimum.code,
            "cov": cov,
            "joint": asked @ cov @ asked.T,
            "square": jnp.sum(optimum.residual**2),
            "chi2": jnp.sum(optimum.residual**2) / seen.size,
            "bias": amount_bias(sd),
            "spread": jnp.minimum(second_order.sd, sd),
            "logs": logs,
            "of_logs": of_logs,
            "derived": jnp.minimum(second_order.derived, of_logs),
        }

    derive = jax.jit(lambda x: jax.lax.map(quantities, x, batch_size=100))
    # Fits one after the other: side by side, all would take as many steps as the longest.
    fits = jax.jit(lambda *all_: jax.lax.map(lambda one: fit(*one), all_))
    programs = (jax.jit(jax.vmap(forward)), fits, derive)
    along = jax.jit(lambda seen, prior, x, i, by: profile_along(problem(seen, prior), x, i, by))
    scale = np.array([1.0 if p.spread is None else p.spread for p in parameters])

    def hold(seen, prior, x, target, root):
        return held(problem(seen, prior), NAMES, x, jnp.asarray(scale), target, root)

    return Setup(parameters, protocol.noise, problem, along, jax.jit(hold), *programs)


def by_chunks(program, *trees, chunk: int = CHUNK):
    """A batched program over draws in chunks of one size, so that it compiles once."""
    count, chunks = len(jax.tree.leaves(trees)[0]), []
    size = min(chunk, count)
    for first in range(0, count, size):
        index = np.arange(first, first + size) % count
        part = jax.tree.map(lambda a, i=index: jnp.asarray(a)[i], trees)
        out = jax.tree.map(np.asarray, program(*part))
        chunks.append(jax.tree.map(lambda a, n=count - first: a[:n], out))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)


def truths(made: Setup, water: tuple[float, ...], count: int, seed: int) -> np.ndarray:
    """(draw, unknown): the water as given, nuisances from their priors, arbitrary gains."""
    rng = np.random.default_rng(seed)
    x = np.tile(np.asarray(made.parameters.prior().centre), (count, 1))
    for i, p in enumerate(made.parameters):
        if not p.nuisance:
            x[:, i] = np.log(water[CONSTITUENTS.index(p.name)])
        elif p.spread is None:
            x[:, i] = rng.normal(0.0, 0.5, count)
        else:
            x[:, i] += p.spread * rng.standard_normal(count)
    return x


def observe(made: Setup, x: np.ndarray, seed: int):
    """Noisy readings and the true ln quantities of every draw."""
    exact, logs = by_chunks(made.forward, x)
    noise = np.random.default_rng(seed).standard_normal(exact.shape)
    return exact * (1 + made.noise * noise), logs


def priors(made: Setup, count: int) -> Prior:
    """The protocol's priors, one row a draw."""
    prior = made.parameters.prior()
    return jax.tree.map(lambda row: np.tile(np.asarray(row), (count, 1)), prior)


def fit_all(made: Setup, seen: np.ndarray, prior: Prior | None = None) -> dict[str, np.ndarray]:
    """Fits of (draw, reading, channel) by the search of `fit_photo`, from the priors' centres."""
    prior = priors(made, len(seen)) if prior is None else prior
    start = np.array(prior.centre)
    at_centre = np.asarray(made.forward(start[:1])[0])
    level = np.log(np.median(seen / at_centre, axis=1))
    for i, name in enumerate(made.parameters.names):
        if name.startswith("gain"):
            start[:, i] += level[:, "RGB".index(name[-1])]
    found = by_chunks(made.fit, seen, start, prior)
    return found | {"sd": _stated(made, seen, prior, found)}


def _stated(made: Setup, seen, prior: Prior, found) -> np.ndarray:
    """(draw, unknown) standard deviations as `fit_photo` states them."""
    sds = np.sqrt(np.einsum("dii->di", found["cov"]))
    for d, sd in enumerate(sds):
        own = jax.tree.map(lambda row, d=d: row[d], prior)

        def along(i, length, d=d, own=own):
            return made.profile_along(seen[d], own, found["x"][d], i, np.asarray(length))

        sds[d] = profile_adjusted_sd(along, made.parameters, found["x"][d], sd.copy())
    return sds


def bound(made: Setup, x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """(draw, NAMES) least sd of the logarithms at truths x, by central finite differences.

    Bayesian for what has a prior (nuisances, and the constituents' decades): the information of
    the readings plus that of the priors.
    """
    count, unknown = x.shape
    moves = step * np.concatenate([np.eye(unknown), -np.eye(unknown)])
    seen, logs = by_chunks(made.forward, (x[:, None] + moves).reshape(-1, unknown))

    def slope(values):
        up, down = np.split(values.reshape(count, 2 * unknown, -1), 2, axis=1)
        return np.swapaxes(up - down, 1, 2) / (2 * step)

    # The noise is relative, so the slopes that count are those of the logarithm.
    readings, quantities = slope(np.log(seen)), slope(logs)
    weight = np.asarray(made.parameters.prior().weight)
    information = np.einsum("dri,drj->dij", readings, readings) / made.noise**2
    best = np.linalg.inv(information + np.diag(weight**2))
    own = [made.parameters.names.index(name) for name in CONSTITUENTS]
    variance = np.concatenate(
        [
            np.einsum("dii->di", best)[:, own],
            np.einsum("dqi,dij,dqj->dq", quantities, best, quantities),
        ],
        axis=1,
    )
    return np.sqrt(variance)


def losses(made: Setup, seen, prior: Prior, found, target, picks) -> np.ndarray:
    """(draw, pick) losses of `fitting.core.likelihood_regions.LikelihoodRegion` with the picked of
    NAMES held at
    `target` (draw, NAMES)."""
    out = np.zeros((len(seen), len(picks)))
    for d in range(len(seen)):
        own = jax.tree.map(lambda row, d=d: row[d], prior)
        for p, pick in enumerate(picks):
            root = whitening(found["joint"][d], pick)
            out[d, p] = made.held(seen[d], own, found["x"][d], target[d], root)[1]
    return np.where(np.isfinite(out), out, np.inf) - found["square"][:, None]
