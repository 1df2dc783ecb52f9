"""The posterior of a simulated photograph, by adaptive importance sampling.

Readings say the sums of absorption and scattering to a few per cent but hardly how they split: a
posterior of C, a_y, a_d and the scattering ratio of detritus is a long curved ridge, but given
these four everything else (gains, exposures, ranges, light on charts) is nearly Gaussian.  So the
rest is drawn from the Gaussian about its conditional optimum, which Gauss-Newton finds, and the
four in coordinates v + ln v, v a concentration by its size: linear above that size, where readings
are nearly linear in concentrations, logarithmic below, where priors are all there is.  They are
drawn from a Student-t about the optimum, then, ROUNDS times, from kernels about what the draws so
far, weighted, say (West
1993, Journal of the Royal Statistical Society B 55:409).  Weights are the posterior by the mixture
of all rounds' densities (Owen & Zhou 2000, Journal of the American Statistical Association 95:135).
How heavy their tail is, by the shape k of a generalised Pareto (Vehtari et al. 2024, Journal of
Machine Learning Research 25:72): below 0.7 they can be trusted.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.core.least_squares import value_and_jacobian
from fitting.core.likelihood_regions import Region
from tests.acceptance._photo_protocols import Setup, by_chunks

# Draws a round, rounds after the first, draws kept.
BLOCK, ROUNDS, KEPT = 400, 5, 1000
# Kernels, their width by the spread of all draws, least effective draws they are made from.
_KERNELS, _WIDTH, _LEAST = 100, 0.5, 80
_FREEDOM, _WIDER = 6.0, 1.3
# ln (C^0.65, a_y, a_d, scattering of detritus) from ln (C, a_y, a_d, b_d/a_d): absorption and
# scattering are nearly linear in these.
_LINEAR = np.array([[0.65, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1.0]])
# Below about which each of them matters little beside the others' uncertainty.
_SIZES = np.log([0.4, 0.03, 0.05, 0.1])
_HARD = 4


class Posterior(NamedTuple):
    """Draws (seed, draw, unknown) and of ln quantities (seed, draw, quantity), equally weighted;
    effective number of draws and Pareto k of the weights by seed; by how much spreads (ln) of the
    four differ between the later rounds' draws and all, (seed, 4)."""

    x: np.ndarray
    logs: np.ndarray
    effective: np.ndarray
    shape: np.ndarray
    settled: np.ndarray


def _conditional(made: Setup, hard: int, seen, prior, mode, along, z, noise):
    """Draws of everything but the first `hard` unknowns at z (draw, hard), and ln p - ln q.

    `along`: how the rest moves with z about the mode.
    """
    residual = made.problem(seen, prior).residual
    middle, centre = mode[:hard], mode[hard:]

    def one(z, noise):
        def misfit(w):
            return residual(jnp.concatenate([z, w]))

        # Gauss-Newton twice with the slopes of the first step, which serve the spread too.
        w = centre + along @ (z - middle)
        value, slope = value_and_jacobian(misfit, w)
        root = jnp.linalg.cholesky(slope.T @ slope)

        def solve(value):
            return jax.scipy.linalg.cho_solve((root, True), slope.T @ value)

        def step(w, push):
            value = misfit(w)
            return w - solve(value) + push, (w, jnp.sum(value**2))

        # A loop, so that the model is compiled once for both: the second step, and the draw.
        push = jax.scipy.linalg.solve_triangular(root.T, noise)
        pushes = jnp.stack([push, jnp.zeros_like(push)])
        _, (visited, squares) = jax.lax.scan(step, w - solve(value), pushes)
        of_w = jnp.sum(jnp.log(jnp.diagonal(root))) - 0.5 * jnp.sum(noise**2)
        return visited[1], -0.5 * squares[1] - of_w

    return jax.lax.map(lambda pair: one(*pair), (z, noise), batch_size=100)


def _program(made: Setup, hard: int):
    def run(*arguments):
        return jax.lax.map(lambda a: _conditional(made, hard, *a), arguments)

    return jax.jit(run)


def pareto_shape(log_weights: np.ndarray) -> float:
    """Shape k of the tail of the weights, by Zhang & Stephens 2009 (Technometrics 51:316)."""
    count = len(log_weights)
    tail = int(min(0.2 * count, 3.0 * np.sqrt(count)))
    ordered = np.sort(np.exp(log_weights - log_weights.max()))
    excess = ordered[-tail:] - ordered[-tail - 1]
    excess = excess[excess > 0]
    n = len(excess)
    if n < 5:
        return -np.inf
    grid = 20 + int(np.sqrt(n))
    j = np.arange(1, grid + 1)
    theta = 1 / excess[-1] + (1 - np.sqrt(grid / (j - 0.5))) / 3 / excess[int(n / 4 + 0.5) - 1]
    k = np.mean(np.log1p(-theta[:, None] * excess), axis=1)
    like = n * (np.log(-theta / k) - k - 1)
    weight = 1 / np.exp(like - like[:, None]).sum(axis=1)
    best = np.sum(theta * weight)
    return float(np.mean(np.log1p(-best * excess)))


def _straight(z):
    """Straight coordinates of ln (C, a_y, a_d, b_d/a_d), and ln of how much they stretch them."""
    logs = z @ _LINEAR.T - _SIZES
    return np.exp(logs) + logs, np.sum(np.log1p(np.exp(logs)), axis=-1)


def _back(u):
    # e^y + y = u by Newton from above, whence it cannot overshoot.
    y = np.where(u > 1, np.log(np.maximum(u, 1.0)), u)
    for _ in range(8):
        y = y - (np.exp(y) + y - u) / (np.exp(y) + 1)
    return (y + _SIZES) @ np.linalg.inv(_LINEAR).T


def _log_kernels(u, centres, root):
    """ln density of a mixture of multivariate t about centres (kernel, d), at u (draw, d)."""
    d = u.shape[1]
    inverse = np.linalg.inv(root)
    apart = (u @ inverse.T)[:, None] - (centres @ inverse.T)[None]
    logs = -0.5 * (_FREEDOM + d) * np.log1p(np.sum(apart**2, axis=2) / _FREEDOM)
    return (
        np.logaddexp.reduce(logs, axis=1) - np.log(len(centres)) - np.sum(np.log(np.diagonal(root)))
    )


def _draw(rng, centres, root):
    scale = np.sqrt(_FREEDOM / rng.chisquare(_FREEDOM, (BLOCK, 1)))
    noise = rng.standard_normal((BLOCK, len(root))) * scale
    return centres[rng.integers(0, len(centres), BLOCK)] + noise @ root.T


def _normal(log_weight, power=1.0):
    weight = np.exp(power * (log_weight - log_weight.max()))
    return weight / weight.sum()


def _flattened(log_weight: np.ndarray) -> np.ndarray:
    """Weights to the largest power, 1 at most, that leaves _LEAST effective draws."""
    low, high = 0.0, 1.0
    if 1 / np.sum(_normal(log_weight) ** 2) >= _LEAST:
        return _normal(log_weight)
    for _ in range(30):
        middle = 0.5 * (low + high)
        enough = 1 / np.sum(_normal(log_weight, middle) ** 2) >= _LEAST
        low, high = (middle, high) if enough else (low, middle)
    return _normal(log_weight, low)


class _Search:
    """The densities drawn from so far and the draws, of one seed."""

    def __init__(self, mode, cov):
        u, _ = _straight(mode)
        slope = (1 + np.exp(mode @ _LINEAR.T - _SIZES))[:, None] * _LINEAR
        root = np.linalg.cholesky(slope @ cov @ slope.T)
        self.mixtures = [(u[None], _WIDER * root)]
        self.u, self.log_p = np.zeros((0, len(mode))), np.zeros(0)

    def propose(self, rng):
        if len(self.u):
            weight = _flattened(self.log_weight())
            centres = self.u[rng.choice(len(self.u), _KERNELS, p=weight)]
            root = _WIDTH * np.linalg.cholesky(np.cov(self.u.T, aweights=weight))
            self.mixtures.append((centres, root))
        return _draw(rng, *self.mixtures[-1])

    def learn(self, u, log_p):
        self.u = np.concatenate([self.u, u])
        self.log_p = np.concatenate([self.log_p, np.where(np.isfinite(log_p), log_p, -np.inf)])

    def log_weight(self):
        logs = [_log_kernels(self.u, *one) for one in self.mixtures]
        return self.log_p - np.logaddexp.reduce(np.stack(logs), axis=0)


def _spread(z, log_weight):
    return np.sqrt(np.diagonal(np.cov(z.T, aweights=_normal(log_weight))))


def sample(made: Setup, seen, prior, found, seed: int = 3) -> Posterior:
    """Posteriors of (seed, reading, channel) readings, about the optima `found` by `fit_all`.

    `prior`: rows of the priors by seed.
    """
    if made.parameters.names[:_HARD] != (
        "chlorophyll",
        "cdom",
        "detritus",
        "detritus_scattering_ratio",
    ):
        raise ValueError(f"the unknowns begin with {made.parameters.names[:_HARD]}.")
    seeds, unknown = found["x"].shape
    rng, run = np.random.default_rng(seed), _program(made, _HARD)
    covs = found["cov"][:, :_HARD, :_HARD]
    along = found["cov"][:, _HARD:, :_HARD] @ np.linalg.inv(covs)
    searches = [_Search(*pair) for pair in zip(found["x"][:, :_HARD], covs, strict=True)]
    visited = []
    for _ in range(1 + ROUNDS):
        u = np.stack([search.propose(rng) for search in searches])
        z = _back(u)
        noise = rng.standard_normal((seeds, BLOCK, unknown - _HARD))
        w, ratio = by_chunks(run, seen, prior, found["x"], along, z, noise, chunk=20)
        # The posterior in straight coordinates is that in logarithms less the stretch.
        for search, *news in zip(searches, u, ratio - _straight(z)[1], strict=True):
            search.learn(*news)
        visited.append(np.concatenate([z, w], axis=2))
    x = np.concatenate(visited, axis=1)
    logs = [search.log_weight() for search in searches]
    late = 3 * BLOCK
    settled = [
        np.log(_spread(one[-late:, :_HARD], log[-late:]) / _spread(one[:, :_HARD], log))
        for one, log in zip(x, logs, strict=True)
    ]
    picks = np.stack([rng.choice(x.shape[1], KEPT, p=_normal(log)) for log in logs])
    x = np.take_along_axis(x, picks[:, :, None], axis=1)
    derived = by_chunks(made.derive, x.reshape(-1, unknown), chunk=KEPT).reshape(seeds, KEPT, -1)
    effective = np.array([1 / np.sum(_normal(log) ** 2) for log in logs])
    return Posterior(x, derived, effective, np.array([pareto_shape(log) for log in logs]),
                     np.stack(settled))  # fmt: skip


def region_of(names: tuple[str, ...], draws: Float[np.ndarray, "draw name"], level: float):
    """The ellipsoid that holds a share of draws of logarithms: its axes are their covariance's, its
    size is the distance within which that share of them lies."""
    centre = draws.mean(axis=0)
    precision = np.linalg.inv(np.atleast_2d(np.cov(draws.T)))
    away = draws - centre
    radius2 = np.quantile(np.einsum("di,ij,dj->d", away, precision, away), level)
    return Region(names, centre, precision, float(radius2))
