"""Functions of a symmetric matrix, applied to vectors, with derivatives free of eigenvectors.

A homogeneous layer is solved by functions f(B) of one symmetric positive semi-definite matrix B,
all regular in B even where an eigenvalue vanishes (no absorption) or meets the sun's 1/mu0.  Here
B is given in the basis of its own eigenvectors, held fixed: its value is diagonal, its derivative
full.  Then df = F o dB with F the divided differences of f, so no derivative of an eigenvector,
with its 1/(x_i - x_j), is ever formed (Daleckii and Krein 1951; Higham 2008, theorem 3.11).
"""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv._numerics import exp_mean3

# Every function below is even in k = sqrt(x) and does not grow with it faster than k (products
# with B itself are left to the caller).  t > 0 is the thickness of the layer, h = t/2.
# Places inside are given as shares of t, so that nothing divides by t.


@jax.custom_jvp
def mean_decay(x):
    """Mean of e^-u over 0 <= u <= x, as `exp_moment(0, x)` but with less to compile."""
    zero = x == 0
    return jnp.where(zero, 1.0, -jnp.expm1(-x) / jnp.where(zero, 1.0, x))


@mean_decay.defjvp
def _mean_decay_jvp(primals, tangents):
    (x,) = primals
    value = mean_decay(x)
    small = x < 0.1
    low = jnp.where(small, x, 0.0)
    series = jnp.zeros_like(x)
    for n in range(9, 0, -1):
        series = -series * low + n / math.factorial(n + 1)
    slope = (jnp.exp(-x) - value) / jnp.where(small, 1.0, x)
    return value, jnp.where(small, -series, slope) * tangents[0]


def mean_decay_between(x, y):
    """Mean of e^-u for u between x and y."""
    return jnp.exp(-jnp.minimum(x, y)) * mean_decay(jnp.abs(x - y))


def through(k, t):
    """tanh(k h)/k twice, 1/cosh(k h)^2, k coth(k t) and k/sinh(k t)."""
    decay = jnp.exp(-k * t)
    mean = mean_decay(k * t)
    tanh = t * mean / (1 + decay)
    scale = t * mean * (1 + decay) / 2
    coth, csch = (1 + decay**2) / (2 * scale), decay / scale
    return jnp.stack([tanh, tanh, 4 * decay / (1 + decay) ** 2, coth, csch])


def endless(k, t):
    """The first two of `through`."""
    return through(k, t)[:2]


def forced(k, t, nu):
    """With e = e^(-nu s) integrated over the layer: half of e cosh(k(s - h))/cosh(k h); half of
    e sinh(k(h - s))/(k cosh(k h)); and e sinh(k s)/sinh(k t)."""
    decay, beam = jnp.exp(-k * t), jnp.exp(-nu * t)
    mean, between = mean_decay(k * t), mean_decay_between(k * t, nu * t)
    p = t / 2 * (mean_decay((k + nu) * t) + between) / (1 + decay)
    q = (t * mean / (1 + decay) * (1 + beam) / 2 - p) / nu  # integration by parts
    below = (2 * between / (mean * (1 + decay)) - beam) / (k + nu)
    return jnp.stack([p, q, below])


def forced_endless(k, t, nu):
    """The first two of `forced`."""
    return forced(k, t, nu)[:2]


def inside(k, t, share):
    """sinh(k(t - s))/sinh(k t) and sinh(k s)/sinh(k t) at s = share t."""
    rest, s = k * (1 - share) * t, k * share * t
    whole = mean_decay(2 * k * t)
    top = jnp.exp(-s) * (1 - share) * mean_decay(2 * rest) / whole
    return jnp.stack([top, jnp.exp(-rest) * share * mean_decay(2 * s) / whole])


def forced_inside(k, t, share, nu):
    """`inside`, and W with W'' - k^2 W = -e^(-nu s), W(0) = W(t) = 0."""
    ends = inside(k, t, share)
    far = share * t * mean_decay_between(k * share * t, nu * share * t)
    image = t * mean_decay_between(k * t, nu * t)
    return jnp.concatenate([ends, ((far - ends[1] * image) / (k + nu))[None]])


def seen(k, t, rate):
    """Integrals over 0 < s < t of e^(-rate s) times the two functions of `inside`."""
    x, y = k * t, rate * t
    scale = t / mean_decay(2 * x)
    near = scale * exp_mean3(jnp.zeros_like(x), x + y, 2 * x)
    return jnp.stack([near, scale * exp_mean3(x, y, 2 * x + y)])


def forced_seen(k, t, rate, nu, along):
    """`seen`, and the integral of e^(-rate s) W(s), or of e^(-rate(t - s)) W(s) unless `along`;
    W as in `forced_inside`."""
    near, far = seen(k, t, rate)
    x, y, view = k * t, nu * t, rate * t
    first = jnp.where(along, jnp.zeros_like(x), view)
    shift = jnp.where(along, view, 0.0)
    whole = t**2 * exp_mean3(first, x + shift, jnp.zeros_like(x) + y + shift)
    image = t * mean_decay_between(x, y)
    return jnp.stack([near, far, (whole - image * jnp.where(along, far, near)) / (k + nu)])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def apply_functions(
    functions: Callable,
    x: Float[Array, "n"],
    matrix: Float[Array, "n n"],
    parameters: tuple,
    vectors: Float[Array, "f n m"],
) -> Float[Array, "f n m"]:
    """f(B) @ vectors for each f of a stack, of the B whose value is diag(x) and whose derivative
    is that of `matrix`.

    `functions(k, *parameters)` is (f, n); the first parameter is the length scale t.
    """
    return functions(_root(x), *parameters)[:, :, None] * vectors


@apply_functions.defjvp
def _apply_functions_jvp(functions, primals, tangents):
    x, _, parameters, vectors = primals
    _, dmatrix, dparameters, dvectors = tangents
    # df/dx = (df/dk)/(2k) loses eps/(k t)^2; f is analytic in x: take it at a small k t instead.
    k = _root(x)
    values, dvalues = jax.jvp(lambda *p: functions(k, *p), parameters, dparameters)
    k = jnp.maximum(k, float(jnp.finfo(x.dtype).eps) ** 0.25 / parameters[0])
    _, slope = jax.jvp(lambda k: functions(k, *parameters), (k,), (jnp.ones_like(k),))
    slope = slope / (2 * k)[None, :]
    change = (_divided_differences(x, values, slope, parameters[0]) * dmatrix[None]) @ vectors
    tangent = values[:, :, None] * dvectors + dvalues[:, :, None] * vectors + change
    return values[:, :, None] * vectors, tangent


def _root(x):
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _divided_differences(x, values, slope, t):
    """(f(x_i) - f(x_j))/(x_i - x_j), the mean slope where x_i and x_j are close."""
    difference = x[:, None] - x[None, :]
    near = float(jnp.finfo(x.dtype).eps) ** (1 / 3)
    close = jnp.abs(difference) <= near * (x[:, None] + x[None, :] + 1 / t**2)
    quotient = (values[:, :, None] - values[:, None, :]) / jnp.where(close, 1.0, difference)[None]
    return jnp.where(close[None], (slope[:, :, None] + slope[:, None, :]) / 2, quotient)
