"""Mathematics behind `oceaninv.phase`: the Fournier-Forand function and angular quadrature."""

import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from oceaninv.foundation.numerics import gauss_legendre

SMALLEST_ANGLE = 1e-5  # rad; what lies inside is counted as unscattered, error l^2 * 2e-11

# With u = sin^2(theta/2), delta = D u, s = (slope - 3)/2, phi(delta) = (delta^s - 1)/(delta - 1)
# the cumulative function of Fournier & Jonasz reads
#     F(u) = 1 - (1 - u) [phi(D u) - phi(D) u (1 - 2 u)/2],
# the fraction scattered by less than theta, and 4 pi p = dF/du.  phi is smooth through delta = 1.


_T, _W = gauss_legendre(5, 0.0, 1.0)


def _space(x) -> Any:
    """numpy for numbers, jax.numpy for JAX arrays: numbers need no compiled program."""
    return jnp if isinstance(x, jax.Array) else np


def ff_phi(x, s):
    """phi at ln(delta) = x and its derivative with respect to x; numpy in, numpy out."""
    xp = _space(x)
    near = xp.abs(x) < 0.5
    small = xp.where(near, x, 0.0)
    # phi = s h(s x)/h(x) with h(y) = (e^y - 1)/y, whose logarithmic derivative is smooth at 0.
    h, dh = _mean_exponential(small)
    hs, dhs = _mean_exponential(s * small)
    phi_near = s * hs / h
    slope_near = phi_near * (s * dhs / hs - dh / h)
    big = xp.where(near, 1.0, x)
    phi_far = xp.expm1(s * big) / xp.expm1(big)
    slope_far = phi_far * (1 / xp.expm1(-big) - s / xp.expm1(-s * big))
    return xp.where(near, phi_near, phi_far), xp.where(near, slope_near, slope_far)


def _mean_exponential(y):
    """(e^y - 1)/y = integral of e^(y t) over 0 <= t <= 1, and its derivative, for |y| <= 1/2.

    Five Gauss points are exact to 4e-16 there, in every derivative, and quick to compile.
    """
    shape = (1,) * y.ndim + (5,)
    xp = _space(y)
    nodes, weights = (xp.asarray(v.reshape(shape), y.dtype) for v in (_T, _W))
    terms = weights * xp.exp(y[..., None] * nodes)
    return terms.sum(-1), (nodes * terms).sum(-1)


def ff_density(u, inner: float, log_d, s):
    """(4 pi p at u, fraction F scattered inside u = inner); D = e^log_d."""
    xp = _space(u)
    # The three scalar values of phi together, which halves the program to compile.
    edge = log_d + math.log(inner)
    phi, _ = ff_phi(xp.stack([log_d, edge, edge]), xp.stack([s, s, 1 - s]))
    back, at_edge, complement = phi
    # 1 - phi(s) = delta^s phi(1 - s): no cancellation where little is scattered inside.
    inside = xp.exp(s * edge) * complement + inner * at_edge
    inside = inside + (1 - inner) * back * inner * (1 - 2 * inner) / 2
    phi, slope = ff_phi(log_d + xp.log(u), s)
    return phi - (1 - u) * slope / u + back * (0.5 - 3 * u * (1 - u)), inside


def ff_backscatter(log_d, s):
    return ff_phi(log_d - math.log(2), s)[0] / 2


def index_from_slope(slope):
    return 1.01 + 0.1542 * (slope - 3)


@jax.jit
def slope_from_backscatter(ratio):
    """Junge slope of the one-parameter family whose bb/b is `ratio`."""

    def excess(slope, ratio):
        log_d = math.log(4 / 3) - 2 * jnp.log(index_from_slope(slope) - 1)
        return ff_backscatter(log_d, (slope - 3) / 2) - ratio

    def halve(_, bracket):
        low, high = bracket
        middle = (low + high) / 2
        above = excess(middle, fixed) > 0
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    fixed = jax.lax.stop_gradient(ratio)
    ends = (jnp.full_like(fixed, 3.0), jnp.full_like(fixed, 5.0))
    root = sum(jax.lax.fori_loop(0, 60, halve, ends)) / 2
    root = jax.lax.stop_gradient(root)
    # One Newton step from the root carries the derivative of the implicit function.
    return root - excess(root, ratio) / jax.grad(excess)(root, fixed)


def concrete_slope(ratio) -> float:
    """`slope_from_backscatter` of a number, without compiling."""
    low, high, ratio = 3.0, 5.0, float(ratio)
    for _ in range(60):
        middle = (low + high) / 2
        log_d = math.log(4 / 3) - 2 * math.log(index_from_slope(middle) - 1)
        above = ff_backscatter(log_d, (middle - 3) / 2) > ratio
        low, high = (low, middle) if above else (middle, high)
    return (low + high) / 2


def concrete_moments(half, weights, index, slope, order: int) -> np.ndarray:
    """Moments 0 ... order for numbers, without compiling."""
    log_d, s = math.log(4 / 3) - 2 * math.log(float(index) - 1), (float(slope) - 3) / 2
    smallest = math.sin(SMALLEST_ANGLE / 2) ** 2
    with np.errstate(all="ignore"):
        density, forward = ff_density(half, smallest, log_d, s)
    sums = np.empty(order + 1)
    value, difference = np.ones_like(half), np.zeros_like(half)
    for l in range(order + 1):
        sums[l] = np.sum(weights * density * value)
        difference = (l * difference - (2 * l + 1) * 2 * half * value) / (l + 1)
        value = value + difference
    return sums + forward


def log_panels(order: int) -> tuple[float, ...]:
    """Edges (rad) of panels that resolve a forward peak and P_order: geometric, then even."""
    even = 2 * max(12, (order + 7) // 8)
    edges = np.linspace(0, np.pi, even + 1)[1:]
    steps = math.ceil(math.log(edges[0] / SMALLEST_ANGLE))
    return (*np.geomspace(SMALLEST_ANGLE, edges[0], steps + 1)[:-1].tolist(), *edges.tolist())


@functools.lru_cache(maxsize=64)
def angular_quadrature(edges: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """16-point Gauss-Legendre nodes and weights in the angle (rad) on each panel."""
    rules = [gauss_legendre(16, low, high) for low, high in itertools.pairwise(edges)]
    return np.concatenate([x for x, _ in rules]), np.concatenate([w for _, w in rules])


def legendre_sums(half, weights, order: int):
    """sum of weights * P_l(1 - 2 half) for l = 0 ... order, one compiled recurrence.

    The recurrence runs on differences P_l - P_(l-1), exact where half is tiny.
    """

    def step(carry, l):
        value, difference = carry
        difference = (l * difference - (2 * l + 1) * 2 * half * value) / (l + 1)
        return (value + difference, difference), jnp.sum(weights * value)

    degrees = jnp.arange(order + 1, dtype=half.dtype)
    start = (jnp.ones_like(half), jnp.zeros_like(half))
    return jax.lax.scan(step, start, degrees)[1]


def hg_backscatter(g):
    """bb/b of the Henyey-Greenstein function, regular at g = 0; numpy or JAX."""
    root = (1 + g**2) ** 0.5
    return (1 - g) / (root * (1 + g + root))


_STEEPEST = 0.99999


def two_term_parameters(cosine, log_target, mean: float, back: float):
    """(g1, g2, weight) with mean cosine `mean`, bb/b `back`, nearest to `log_target` (numpy)."""
    excess = back - hg_backscatter(mean)
    if excess < -1e-6:
        raise ValueError(
            f"phase scatters bb/b = {back:.6f} backwards, less than the {hg_backscatter(mean):.6f}"
            f" of a Henyey-Greenstein function with its mean cosine {mean:.6f}; no two-term"
            " function of non-negative weights has both.  Use the phase function itself."
        )
    if excess < 1e-6:
        return mean, 0.0, 1.0
    # Nested grids of g2; a grid of 201 narrows the bracket a hundredfold.
    low, high = -0.99, mean
    found = (mean, 0.0, 1.0)
    for _ in range(5):
        g2 = np.linspace(low, high, 203)[1:-1]
        g1 = _first_asymmetry(g2, mean, back)
        weight = (mean - g2) / (g1 - g2)
        first, second = (_hg(g[:, None], cosine[None, :]) for g in (g1, g2))
        model = weight[:, None] * first + (1 - weight)[:, None] * second
        misfit = np.mean((np.log(model) - log_target[None, :]) ** 2, axis=1)
        best = int(np.argmin(np.where(g1 < _STEEPEST, misfit, np.inf)))
        found = (float(g1[best]), float(g2[best]), float(weight[best]))
        low, high = g2[max(best - 1, 0)], g2[min(best + 1, len(g2) - 1)]
    return found


def _first_asymmetry(g2, mean, back):
    """g1 of the chord from (g2, bb/b(g2)) through (mean, back) to the one-term curve beyond it.

    The moments of a mixture are mixtures of moments, so that (mean, bb/b) lies on that chord; the
    curve is convex for g > 0, hence met once.
    """
    slope = (back - hg_backscatter(g2)) / (mean - g2)
    low, high = np.full_like(g2, mean), np.full_like(g2, _STEEPEST)
    for _ in range(60):
        middle = (low + high) / 2
        above = back + slope * (middle - mean) > hg_backscatter(middle)
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return high


def _hg(g, cosine):
    return (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * cosine) ** 1.5)
