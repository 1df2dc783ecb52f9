"""Joint regions of several numbers of a fit, and the intervals that they contain."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.core.least_squares import covariance, least_squares, value_and_jacobian
from fitting.core.parameters import Log, Parameters
from fitting.core.problem import AbstractProblem
from fitting.core.program_cache import cached_jit
from fitting.core.result import Fit
from oceaninv.foundation.double_precision import in_double_precision

# Weights that hold numbers at their values, in units of one over their standard deviations, in
# successive searches.  With the last, the sum of squares is short of the exact one by a part in
# ten thousand.
_PULL = (1.0, 10.0, 100.0)
# Largest expected change of a coordinate, the scale of the searches.
_FAR = 2.5


@dataclasses.dataclass(frozen=True)
class Region:
    """A joint region: an ellipsoid in logarithms.

    - `names`; `centre`: ln of their values; `precision`: (name, name) inverse of their covariance;
      `radius2`: the squared distance from the centre, in it, of what lies on the edge.
    """

    names: tuple[str, ...]
    centre: np.ndarray
    precision: np.ndarray
    radius2: float

    def holds(self, values: Mapping[str, float]) -> bool:
        """Whether the physical values lie inside."""
        difference = np.log([values[name] for name in self.names]) - self.centre
        return bool(difference @ self.precision @ difference <= self.radius2)

    def interval(self, name: str) -> tuple[float, float]:
        """(low, high) physical values of one number that occur in the region."""
        i = self.names.index(name)
        half = np.sqrt(self.radius2 * np.linalg.inv(self.precision)[i, i])
        return float(np.exp(self.centre[i] - half)), float(np.exp(self.centre[i] + half))


@dataclasses.dataclass(frozen=True)
class LikelihoodRegion:
    """A joint region by the likelihood ratio: the values that explain readings and priors nearly
    as well as the best ones do, with every other unknown optimised.

    Twice the loss of log posterior, with all unknowns that are not named optimised, is chi-squared
    with as many degrees of freedom as there are names (Wilks 1938, Annals of Mathematical
    Statistics 9:60), wherever on a curved ridge of the posterior the optimum lies.  The region
    needs no ellipsoid.  Unlike a region of posterior probability, it contains one given water at
    the stated rate even where only the priors separate constituents.

    - `names`; `centre`: ln of their values at the optimum; `covariance`: (name, name) linearised,
      an ellipsoid to draw; `radius2`: the loss that is allowed; `least`: the sum of squares at
      the optimum `x`.
    """

    names: tuple[str, ...]
    centre: np.ndarray
    covariance: np.ndarray
    radius2: float
    problem: AbstractProblem = dataclasses.field(repr=False)
    x: np.ndarray = dataclasses.field(repr=False)
    scale: np.ndarray = dataclasses.field(repr=False)
    least: float

    @in_double_precision
    def loss(self, values: Mapping[str, float]) -> float:
        """Twice the log posterior lost by holding some or all of the numbers at these values.

        Chi-squared in the number of values if they are the truth.
        """
        for name in values:
            if name not in self.names:
                raise ValueError(f"{name!r} is none of this region's {', '.join(self.names)}.")
            if not (np.isfinite(values[name]) and values[name] > 0):
                raise ValueError(f"{name} is {values[name]}; it must be positive.")
        pick = [i for i, name in enumerate(self.names) if name in values]
        target = self.centre.copy()
        target[pick] = np.log([values[self.names[i]] for i in pick])
        root = whitening(self.covariance, pick)
        given = map(jnp.asarray, (self.x, self.scale, target, root))
        least = float(_held(self.problem, self.names, *given)[1])
        return (least if np.isfinite(least) else np.inf) - self.least

    def holds(self, values: Mapping[str, float]) -> bool:
        """Whether the physical values lie inside.  Values of all names are asked for."""
        for name in self.names:
            if name not in values:
                raise ValueError(f"holds needs a value of {name}, too.")
        return self.loss({name: values[name] for name in self.names}) <= self.radius2

    def interval(self, name: str) -> tuple[float, float]:
        """(low, high) physical values of one number that occur in the region.

        Of a region of one name this is its interval by profile likelihood.  An end beyond twenty
        times the linearised half-width, or as many e-foldings, is given as 0 or infinity.
        """
        from scipy.optimize import brentq

        i = self.names.index(name)
        sd = float(np.sqrt(self.covariance[i, i]))
        unit = min(sd, 1.0) * np.sqrt(self.radius2)

        def beyond(t):
            return self.loss({name: np.exp(self.centre[i] + t * unit)}) - self.radius2

        ends = []
        for sign, missing in ((-1.0, -np.inf), (1.0, np.inf)):
            inner, outer = 0.0, sign
            while beyond(outer) < 0 and abs(outer) < 20:
                inner, outer = outer, 1.5 * outer
            if abs(outer) >= 20:
                ends.append(missing)
                continue
            root = brentq(beyond, inner, outer, xtol=2e-3)
            ends.append(self.centre[i] + unit * root)
        return float(np.exp(ends[0])), float(np.exp(ends[1]))


def whitening(joint: np.ndarray, pick) -> np.ndarray:
    """(name, name) matrix that turns the picked numbers' deviations into standard ones, others
    into nothing."""
    root = np.zeros_like(joint)
    pick = np.asarray(pick)
    inside = np.linalg.cholesky(joint[np.ix_(pick, pick)])
    root[np.ix_(pick, pick)] = np.linalg.inv(inside)
    return root


def logs_of(problem: AbstractProblem, names: tuple[str, ...], x) -> Float[Array, " name"]:
    """ln of positive parameters and scalar quantities at coordinates `x`."""
    known = problem.layout.names
    derived = {} if all(name in known for name in names) else problem.quantities(x)
    return jnp.stack([
        x[known.index(name)] if name in known else jnp.log(derived[name]) for name in names
    ])  # fmt: skip


def held(
    problem: AbstractProblem,
    names: tuple[str, ...],
    start: Float[Array, " unknown"],
    scale: Float[Array, " unknown"],
    target: Float[Array, " name"],
    root: Float[Array, "name name"],
):
    """The optimum with ln of the named numbers held at `target`, and its sum of squares.

    `root`: what to hold, see `whitening`; nothing where 0.  Pure: jit and vmap it.
    """

    def residual(x, pull):
        off = root @ (logs_of(problem, names, x) - target)
        return jnp.concatenate([problem.residual(x), pull * off])

    def stage(x, pull):
        optimum = least_squares(residual, x, pull, scale)
        return optimum.x, jnp.sum(optimum.residual**2)

    x, sums = jax.lax.scan(stage, start, jnp.asarray(_PULL, start.dtype))
    return x, sums[-1]


@cached_jit
def _held(problem: AbstractProblem, names, start, scale, target, root):
    return held(problem, names, start, scale, target, root)


@cached_jit
def _linear(problem: AbstractProblem, names, x):
    """ln of the named numbers and their linearised covariance."""
    logs, slope = value_and_jacobian(lambda x: logs_of(problem, names, x), x)
    cov = covariance(value_and_jacobian(problem.residual, x)[1])
    return logs, slope @ cov @ slope.T


def _positive(parameters: Parameters) -> dict[str, int]:
    return {p.name: i for i, p in enumerate(parameters) if isinstance(p.transform, Log)}


@in_double_precision
def joint_region(
    fit: Fit, names: tuple[str, ...], level: float = 0.95
) -> Region | LikelihoodRegion:
    """The joint region of some parameters and scalar quantities on a log scale.

    **Arguments:** `names`: of positive parameters and, of a fit that keeps its posterior
    (photographs, a cast's constituents), scalar quantities; `level`: the share of such regions
    that hold the truth.

    **Returns** of a fit that keeps its posterior a `LikelihoodRegion`, of any other the ellipsoid
    of its covariance.  `holds` tells whether given values lie inside, and `interval` the range
    of one number in it; of a region of one name this is that number's own interval.
    """
    from scipy.stats import chi2, f

    names, known = tuple(names), _positive(fit.parameters)
    if not 0 < level < 1:
        raise ValueError(f"level is {level}; it must lie between 0 and 1.")
    if not names or len(set(names)) < len(names):
        raise ValueError(f"a region needs names that differ, not {names}.")
    count = len(names)
    freedom = np.inf if fit.dof is None else float(np.min(fit.dof))
    radius2 = float(
        chi2.ppf(level, count) if np.isinf(freedom) else count * f.ppf(level, count, freedom)
    )
    scalars = {n: q for n, q in fit.quantities.items() if q.value.ndim == 0}
    if fit.problem is None:
        missing = [n for n in names if n not in known]
        if missing:
            raise ValueError(
                f"{missing[0]!r} is no positive parameter of this fit, which keeps no posterior to "
                "find the region of a derived quantity in."
            )
        index = [known[n] for n in names]
        return Region(names, fit.x[index], np.linalg.inv(fit.covariance[np.ix_(index, index)]),
                      radius2)  # fmt: skip
    for name in names:
        if name not in known and name not in scalars:
            from oceaninv.foundation.tables import unknown

            raise unknown("positive parameter or quantity", name, sorted([*known, *scalars]))
    scale = np.minimum(np.sqrt(np.diag(fit.covariance)), _FAR)
    free = (np.zeros(count), np.zeros((count, count)))
    x, least = _held(fit.problem, names, *map(jnp.asarray, (fit.x, scale, *free)))
    centre, joint = map(np.asarray, _linear(fit.problem, names, x))
    return LikelihoodRegion(
        names, centre, joint, radius2, fit.problem, np.asarray(x), scale, float(least)
    )
