"""Numbers that stay right at their removable singularities: exponential integrals, safe roots."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_TERMS = 13


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def exp_moment(n: int, x: Float[Array, "..."]) -> Float[Array, "..."]:
    """I_n(x) = integral of s^n e^(-x s) over 0 <= s <= 1, for x >= 0.

    I_0(x) = (1 - e^-x)/x with I_0(0) = 1.  The derivative is -I_(n+1), so every derivative of
    every order is as accurate as the value.  Relative accuracy a few ulp times 6^n.
    """
    # I_0 needs no series: expm1 is exact down to the smallest numbers.
    small = x < (0.5 if n else float(np.finfo(x.dtype).tiny))
    high = jnp.where(small, 1.0, x)
    value = -jnp.expm1(-high) / high
    for order in range(1, n + 1):
        value = (order * value - jnp.exp(-high)) / high
    if n == 0:
        return jnp.where(small, 1.0, value)
    # I_n = e^-x sum_k x^k / ((n+1)...(n+k+1)): positive terms, hence no cancellation.
    low = jnp.where(small, x, 0.0)
    series = jnp.ones_like(low)
    for k in range(_TERMS, 0, -1):
        series = 1.0 + series * low / (n + k + 1.0)
    return jnp.where(small, jnp.exp(-low) * series / (n + 1.0), value)


@exp_moment.defjvp
def _exp_moment_jvp(n, primals, tangents):
    (x,) = primals
    (dx,) = tangents
    return exp_moment(n, x), -exp_moment(n + 1, x) * dx


def _ordered(a, b):
    """(smaller, larger), each with the whole derivative of one argument also at a tie, where
    min, max and abs split or sign it so that the symmetric function's slope comes out wrong."""
    swapped = b < a
    return jnp.where(swapped, b, a), jnp.where(swapped, a, b)


def exp_mean(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """Mean of e^-u for u between a and b: (e^-a - e^-b)/(b - a), and e^-a where a = b."""
    low, high = _ordered(a, b)
    return jnp.exp(-low) * exp_moment(0, high - low)


def exp_mean3(
    a: Float[Array, "..."], b: Float[Array, "..."], c: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Integral of e^-u over the simplex spanned by a, b, c (its mean, times 1/2).

    This is the second divided difference of e^-u: symmetric in its arguments and 1/2 e^-a where
    all three are equal.
    """
    low, high = _ordered(a, b)
    middle, high = _ordered(high, c)
    low, middle = _ordered(low, middle)
    spread = high - low
    near = spread < 0.25
    apart = (exp_mean(low, middle) - exp_mean(middle, high)) / jnp.where(near, 1.0, spread)
    # e^-low sum_n (-1)^n h_n(0, p, q)/(n+2)!, h_n the complete homogeneous polynomial.
    p = jnp.where(near, middle - low, 0.0)
    q = jnp.where(near, spread, 0.0)
    powers = jnp.ones_like(p)
    homogeneous = jnp.ones_like(p)
    total = jnp.full_like(p, 0.5)
    factor = 0.5
    for n in range(1, 13):
        powers = powers * q
        homogeneous = homogeneous * p + powers
        factor = -factor / (n + 2)
        total = total + factor * homogeneous
    return jnp.where(near, jnp.exp(-low) * total, apart)


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """sqrt(x) for x > 0 and 0 for x <= 0, with derivative 0 there instead of inf or nan."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_power(x: Float[Array, "..."], exponent: Float[Array, "..."]) -> Float[Array, "..."]:
    """x^exponent with finite value and gradient at x = 0.

    Below x = 1e-6 the power is continued by its tangent through the origin, so that C^0.62 has a
    large but finite slope at C = 0 and no NaN; negative x follow the same line.
    """
    knee = 1e-6
    above = x > knee
    power = jnp.where(above, x, knee) ** exponent
    return jnp.where(above, power, power * x / knee)


def linear_interpolation_matrix(at: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Matrix M with M @ values(knots) = values interpolated linearly to `at` (inside the knots)."""
    i = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    t = (at - knots[i]) / (knots[i + 1] - knots[i])
    matrix = np.zeros((len(at), len(knots)))
    rows = np.arange(len(at))
    matrix[rows, i] += 1 - t
    matrix[rows, i + 1] += t
    return matrix


def gauss_legendre(n: int, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """n Gauss-Legendre nodes and weights on [low, high], float64."""
    x, w = np.polynomial.legendre.leggauss(n)
    half = (high - low) / 2
    return low + half * (x + 1), half * w
