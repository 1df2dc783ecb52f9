"""Functions accurate at their removable singularities: exponential integrals, safe roots."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Spread of three arguments below which their divided difference is a series.
_NEAR = 0.25


def _terms(dtype) -> int:
    """Number of terms of the series: the remainder is below a fortieth of the dtype's rounding."""
    return 13 if dtype == jnp.float64 else 8


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
    for k in range(_terms(x.dtype), 0, -1):
        series = 1.0 + series * low / (n + k + 1.0)
    return jnp.where(small, jnp.exp(-low) * series / (n + 1.0), value)


@exp_moment.defjvp
def _exp_moment_jvp(n, primals, tangents):
    (x,) = primals
    (dx,) = tangents
    return exp_moment(n, x), -exp_moment(n + 1, x) * dx


@jax.custom_jvp
def exp_mean(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """Mean of e^-u for u between a and b: (e^-a - e^-b)/(b - a), and e^-a where a = b."""
    return jnp.exp(-jnp.minimum(a, b)) * exp_moment(0, jnp.abs(b - a))


@exp_mean.defjvp
def _exp_mean_jvp(primals, tangents):
    # The slope belongs to the smaller or the larger argument, not to a branch that a compiler may
    # round differently in two places: at a tie both slopes are equal, so that no choice is wrong.
    (a, b), (da, db) = primals, tangents
    ordered = a <= b
    value, of_low, of_high = _mean_and_slopes(jnp.where(ordered, a, b), jnp.where(ordered, b, a))
    slope = jnp.where(ordered, of_low, of_high) * da + jnp.where(ordered, of_high, of_low) * db
    return value, slope


def _mean_and_slopes(low, high):
    """exp_mean of ordered arguments, its slope in the lower and in the higher one."""
    envelope, x = jnp.exp(-low), high - low
    whole, first = exp_moment(0, x), exp_moment(1, x)
    return envelope * whole, -envelope * (whole - first), -envelope * first


@jax.custom_jvp
def exp_mean3(
    a: Float[Array, "..."], b: Float[Array, "..."], c: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Integral of e^-u over the simplex spanned by a, b, c (its mean, times 1/2).

    This is the second divided difference of e^-u: symmetric in its arguments and 1/2 e^-a where
    all three are equal.
    """
    low, middle, high = _ordered(a, b, c)
    spread = high - low
    near = spread < _NEAR
    apart = (exp_mean(low, middle) - exp_mean(middle, high)) / jnp.where(near, 1.0, spread)
    series = _near_series(jnp.where(near, middle - low, 0.0), jnp.where(near, spread, 0.0))
    return jnp.where(near, jnp.exp(-low) * series[0], apart)


@exp_mean3.defjvp
def _exp_mean3_jvp(primals, tangents):
    low, middle, high = _ordered(*primals)
    spread = high - low
    near = spread < _NEAR
    lower, lower_low, lower_middle = _mean_and_slopes(low, middle)
    upper, upper_middle, upper_high = _mean_and_slopes(middle, high)
    wide = jnp.where(near, 1.0, spread)
    apart = (lower - upper) / wide
    envelope = jnp.exp(-low)
    series, in_p, in_q = _near_series(
        jnp.where(near, middle - low, 0.0), jnp.where(near, spread, 0.0)
    )
    value = jnp.where(near, envelope * series, apart)
    of_low = jnp.where(near, -envelope * (series + in_p + in_q), (lower_low + apart) / wide)
    of_middle = jnp.where(near, envelope * in_p, (lower_middle - upper_middle) / wide)
    of_high = jnp.where(near, envelope * in_q, -(upper_high + apart) / wide)
    slope = jnp.zeros_like(low)
    for x, dx in zip(primals, tangents, strict=True):
        rank = jnp.where(x <= low, of_low, jnp.where(x >= high, of_high, of_middle))
        slope = slope + rank * dx
    return value, slope


def _ordered(a, b, c):
    low = jnp.minimum(jnp.minimum(a, b), c)
    high = jnp.maximum(jnp.maximum(a, b), c)
    return low, jnp.maximum(jnp.minimum(a, b), jnp.minimum(jnp.maximum(a, b), c)), high


def _near_series(p, q):
    """sum_n (-1)^n h_n(0, p, q)/(n+2)!, h_n the complete homogeneous polynomial, and its slopes."""
    one, none = jnp.ones_like(p), jnp.zeros_like(p)
    powers, power_slope = one, none
    terms, in_p, in_q = one, none, none
    factor = 0.5
    total, total_p, total_q = 0.5 * one, none, none
    for n in range(1, _terms(q.dtype)):
        power_slope = power_slope * q + powers
        powers = powers * q
        in_p = in_p * p + terms
        in_q = in_q * p + power_slope
        terms = terms * p + powers
        factor = -factor / (n + 2)
        total = total + factor * terms
        total_p = total_p + factor * in_p
        total_q = total_q + factor * in_q
    return total, total_p, total_q


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """sqrt(x) for x > 0 and 0 for x <= 0, with derivative 0 there instead of inf or nan."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_ratio(part: Float[Array, "..."], whole: Float[Array, "..."]) -> Float[Array, "..."]:
    """part/whole, 0 where the whole is 0 (or below the normal numbers of its dtype).

    The derivative contains no squares: it is finite wherever the inverse of the whole is.
    """
    present = whole > 16.0 * float(jnp.finfo(whole.dtype).tiny)
    scale = jax.lax.stop_gradient(1.0 / jnp.where(present, whole, 1.0))
    return jnp.where(present, part * scale / jnp.where(present, whole * scale, 1.0), 0.0)


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
