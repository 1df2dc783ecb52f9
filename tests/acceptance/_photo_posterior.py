"""The posterior of a simulated photograph: importance sampling, then Metropolis steps.

A posterior of C, a_y, a_d and the tie is a long curved valley, but given these four everything else
(gains, exposures, ranges, light on charts) is nearly Gaussian.  So the four are drawn from a
Student-t about the optimum, the rest from the Gaussian about its conditional optimum, which
Gauss-Newton finds; weights put right what either lacks.  Where few draws hold the weight, weights
are flattened until LEAST do.  Every draw then takes ROUNDS times STEPS Metropolis steps in the
exact posterior (resample and move: Gilks & Berzuini 2001, Journal of the Royal Statistical Society
B 63:127), which forget where they began:
`settled` says whether spreads still change.  How heavy the tail of the weights is, by the shape k
of a generalised Pareto (Vehtari et al. 2024, Journal of Machine Learning Research 25:72): below 0.7
they could be trusted by themselves.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fitting.solve import value_and_jacobian
from tests.acceptance._photo_protocols import Setup, by_chunks

# Draws in a block, blocks, draws kept; effective ones at the start; steps a round, rounds.
BLOCK, BLOCKS, KEPT = 400, 3, 500
LEAST, STEPS, ROUNDS = 200, 50, 3
_FREEDOM, _WIDER = 6.0, 1.3


class Posterior(NamedTuple):
    """Draws (seed, draw, unknown) and of ln quantities (seed, draw, quantity), equally weighted;
    effective number of draws and Pareto k of the weights by seed; by how much (ln) spreads changed
    in the last round of steps, (seed, hard unknown); share of steps accepted."""

    x: np.ndarray
    logs: np.ndarray
    effective: np.ndarray
    shape: np.ndarray
    settled: np.ndarray
    accepted: np.ndarray


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


def _student(rng, centre, root, count):
    """(count, d) draws of a multivariate t, and the ln of its density up to a constant."""
    d = len(centre)
    scale = np.sqrt(_FREEDOM / rng.chisquare(_FREEDOM, (count, 1)))
    u = rng.standard_normal((count, d)) * scale
    log_q = -0.5 * (_FREEDOM + d) * np.log1p(np.sum(u**2, axis=1) / _FREEDOM)
    return centre + u @ root.T, log_q


def sample(made: Setup, seen, prior, found, hard: int, seed: int = 3) -> Posterior:
    """Posteriors of (seed, reading, channel) readings, about the optima `found` by `fit_all`.

    `prior`: rows of the priors by seed; `hard`: how many unknowns, the first, are drawn about the
    optimum.
    """
    seeds, unknown = found["x"].shape
    rng, run = np.random.default_rng(seed), _program(made, hard)
    covs = found["cov"][:, :hard, :hard]
    along = found["cov"][:, hard:, :hard] @ np.linalg.inv(covs)
    drawn = [
        _student(rng, centre, _WIDER * np.linalg.cholesky(cov), BLOCKS * BLOCK)
        for centre, cov in zip(found["x"][:, :hard], covs, strict=True)
    ]
    z, log_q = (np.stack(part) for part in zip(*drawn, strict=True))
    noise = rng.standard_normal((*z.shape[:2], unknown - hard))
    parts = [
        by_chunks(run, seen, prior, found["x"], along, some, other)
        for some, other in zip(
            np.split(z, BLOCKS, axis=1), np.split(noise, BLOCKS, axis=1), strict=True
        )
    ]
    w, ratio = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    log_weight = np.where(np.isfinite(ratio), ratio - log_q, -np.inf)
    weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    x = np.concatenate([z, w], axis=2)
    picks = np.stack([rng.choice(x.shape[1], KEPT, p=_annealed(row)) for row in log_weight])
    x = np.take_along_axis(x, picks[:, :, None], axis=1)
    walk, visited, accepted = _walk(made), [], 0.0
    for _ in range(ROUNDS):
        roots = np.stack([_spread(*pair) for pair in zip(x, found["cov"], strict=True)])
        keys = rng.integers(0, 2**31, seeds)
        x, accepted = by_chunks(walk, seen, prior, x, roots, keys)
        visited.append(x[:, :, :hard].std(axis=1))
    logs = by_chunks(made.derive, x.reshape(-1, unknown), chunk=KEPT).reshape(seeds, KEPT, -1)
    settled = np.log(visited[-1] / visited[-2])
    shapes = np.array([pareto_shape(row) for row in log_weight])
    return Posterior(x, logs, 1 / np.sum(weight**2, axis=1), shapes, settled, accepted)


def _annealed(log_weight: np.ndarray) -> np.ndarray:
    """Probabilities by weights to the largest power, 1 at most, that leaves LEAST draws."""

    def at(power):
        weight = np.exp(power * (log_weight - log_weight.max()))
        return weight / weight.sum()

    low, high = 0.0, 1.0
    if 1 / np.sum(at(high) ** 2) >= LEAST:
        return at(high)
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if 1 / np.sum(at(middle) ** 2) >= LEAST else (low, middle)
    return at(low)


def _spread(draws, covariance) -> np.ndarray:
    """A root of the covariance of draws, with a tenth of the ellipsoid's."""
    return np.linalg.cholesky(0.9 * np.cov(draws.T) + 0.1 * covariance)


def _walk(made: Setup):
    """A program of Metropolis steps of many walkers, (draw, unknown) each; share accepted."""

    def run(seen, prior, x, root, seed):
        residual = made.problem(seen, prior).residual

        def density(x):
            return jax.lax.map(lambda x: -0.5 * jnp.sum(residual(x) ** 2), x, batch_size=250)

        def step(carry, key):
            x, here = carry
            push, size, chance = jax.random.split(key, 3)
            # Steps of many sizes about the best for a Gaussian (Roberts et al. 1997).
            scale = 2.38 / np.sqrt(x.shape[1]) * jnp.exp(jax.random.normal(size, (len(x), 1)) - 0.5)
            new = x + scale * (jax.random.normal(push, x.shape) @ root.T)
            there = density(new)
            there = jnp.where(jnp.isfinite(there), there, -jnp.inf)
            taken = jnp.log(jax.random.uniform(chance, here.shape)) < there - here
            x = jnp.where(taken[:, None], new, x)
            return (x, jnp.where(taken, there, here)), jnp.mean(taken.astype(x.dtype))

        keys = jax.random.split(jax.random.key(seed), STEPS)
        (x, _), accepted = jax.lax.scan(step, (x, density(x)), keys)
        return x, jnp.mean(accepted)

    return jax.jit(lambda *arguments: jax.lax.map(lambda a: run(*a), arguments))
