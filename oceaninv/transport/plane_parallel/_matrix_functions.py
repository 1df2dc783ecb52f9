"""Functions of a symmetric matrix, applied to vectors, with derivatives free of eigenvectors.

A homogeneous layer is solved by functions f(B) of one symmetric positive semi-definite matrix B,
all regular in B even where an eigenvalue vanishes (no absorption) or meets the sun's 1/mu0.  Here
B is given in the basis of its own eigenvectors, held fixed: its value is diagonal, its derivative
full.  Then df = F o dB with F the divided differences of f, which are bounded where a derivative
of an eigenvector, with its 1/(x_i - x_j), is not (Daleckii and Krein 1951; Higham 2008, theorem
3.11).
"""

import functools
import math
import operator
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from oceaninv.foundation.numerics import exp_mean3

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
    lost = jnp.expm1(-x)
    zero = x == 0
    value = jnp.where(zero, 1.0, -lost / jnp.where(zero, 1.0, x))
    small = x < 0.1
    low = jnp.where(small, x, 0.0)
    series = jnp.zeros_like(x)
    for n in range(9, 0, -1):
        series = -series * low + n / math.factorial(n + 1)
    slope = (1 + lost - value) / jnp.where(small, 1.0, x)
    return value, jnp.where(small, -series, slope) * tangents[0]


def mean_decay_between(x, y, t):
    """Mean of e^(-u t) for u between x and y.

    Of x t - y t instead, fused products make two values that differ by rounding, and a tiny one
    divided by the other is not 1.
    """
    return jnp.exp(-jnp.minimum(x, y) * t) * mean_decay(jnp.abs(x - y) * t)


# Exponentials and means take stacked arguments, as each one in the program costs compile time.


def through(k, t):
    """tanh(k h)/k twice, 1/cosh(k h)^2, k coth(k t) and k/sinh(k t)."""
    return _through(t, jnp.exp(-k * t), mean_decay(k * t))


def _through(t, decay, mean):
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
    return sunlit(k, t, nu)[5:]


def forced_endless(k, t, nu):
    """The first two of `forced`."""
    return forced(k, t, nu)[:2]


def sunlit(k, t, nu):
    """`through`, then `forced`."""
    decay, nearer, beam = jnp.exp(-t * jnp.stack([k, jnp.minimum(k, nu), 0 * k + nu]))
    mean, both, apart = mean_decay(t * jnp.stack([k, k + nu, jnp.abs(k - nu)]))
    between = nearer * apart
    p = t / 2 * (both + between) / (1 + decay)
    q = (t * mean / (1 + decay) * (1 + beam) / 2 - p) / nu  # integration by parts
    below = (2 * between / (mean * (1 + decay)) - beam) / (k + nu)
    return jnp.concatenate([_through(t, decay, mean), jnp.stack([p, q, below])])


def sunlit_endless(k, t, nu):
    """The first two of `through` and of `forced`."""
    every = sunlit(k, t, nu)
    return jnp.concatenate([every[:2], every[5:7]])


def sunlit_thin(k, t, nu):
    """`sunlit`, but for 1/cosh(k h)^2 - 1 in a thin layer: of a change of f(B) = L f L^-1 a
    constant has no part, but its rounding would drown what a thin layer changes."""
    every = sunlit(k, t, nu)
    return every.at[2].set(jnp.where(t < 1, -((k * every[0]) ** 2), every[2]))


def inside(k, t, share):
    """sinh(k(t - s))/sinh(k t) and sinh(k s)/sinh(k t) at s = share t."""
    s, rest = k * t * share, k * t * (1 - share)
    decay = jnp.exp(-jnp.stack([s, rest]))
    upper, lower, whole = mean_decay(2 * jnp.stack([rest, s, k * t]))
    shares = jnp.stack([1 - share, share])
    return decay * shares[:, None] * jnp.stack([upper, lower]) / whole[None]


def inside_apart(k, t, share):
    """`inside`; in a thin layer (t < 1) only how far they are from the straight line."""
    shares = jnp.stack([1 - share, share])[:, None]
    thin, y = t < 1, k[None] * t
    low = thin & (y < 1)
    square = jnp.where(low, y, 0.0) ** 2

    def excess(square):
        """(sinh(x)/x - 1)/x^2."""
        total = jnp.zeros_like(square)
        for n in range(19, 1, -2):
            total = total * square + 1 / math.factorial(n)
        return total

    more = excess(jnp.concatenate([shares**2 * square, square]))
    apart = shares * square * (shares**2 * more[:2] - more[2:]) / (1 + square * more[2:])
    return jnp.where(low, apart, inside(k, t, share) - jnp.where(thin, shares, 0.0))


def forced_inside(k, t, share, nu):
    """`inside`, and W with W'' - k^2 W = -e^(-nu s), W(0) = W(t) = 0."""
    ends = inside(k, t, share)
    lengths = t * jnp.stack([share, jnp.ones_like(share)])
    nearer, apart = jnp.minimum(k, nu)[None], jnp.abs(k - nu)[None]
    far, image = lengths[:, None] * (
        jnp.exp(-nearer * lengths[:, None]) * mean_decay(apart * lengths[:, None])
    )
    return jnp.concatenate([ends, ((far - ends[1] * image) / (k + nu))[None]])


def forced_inside_apart(k, t, share, nu):
    """`forced_inside` with `inside_apart`."""
    return jnp.concatenate([inside_apart(k, t, share), forced_inside(k, t, share, nu)[2:]])


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
    image = t * mean_decay_between(k, nu, t)
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
    return functions(root(x), *parameters)[:, :, None] * vectors


def _apply_functions_jvp(functions, primals, tangents):
    vectors = primals[3]
    values, changed, slope = _derivatives(functions, primals, tangents)
    found = values[:, :, None] * vectors
    tangent = jnp.zeros_like(vectors)
    if not is_zero(tangents[3]):
        tangent = tangent + values[:, :, None] * tangents[3]
    if changed is not None:
        tangent = tangent + changed[:, :, None] * vectors
    if slope is not None:
        apart, close = _split_change(primals, tangents)
        slopes = slope[:, :, None] * vectors
        tangent = tangent + values[:, :, None] * (apart @ vectors) - apart @ found
        tangent = tangent + (slope[:, :, None] * (close @ vectors) + close @ slopes) / 2
    return found, tangent


apply_functions.defjvp(_apply_functions_jvp, symbolic_zeros=True)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def combine(
    functions: Callable,
    x: Float[Array, "n"],
    matrix: Float[Array, "n n"],
    parameters: tuple,
    vectors: Float[Array, "f n m"],
) -> Float[Array, "n m"]:
    """The sum of `apply_functions` over its functions."""
    return added(functions(root(x), *parameters)[:, :, None] * vectors)


def _combine_jvp(functions, primals, tangents):
    vectors = primals[3]
    values, changed, slope = _derivatives(functions, primals, tangents)
    total = added(values[:, :, None] * vectors)
    tangent = jnp.zeros_like(total)
    if not is_zero(tangents[3]):
        tangent = tangent + added(values[:, :, None] * tangents[3])
    if changed is not None:
        tangent = tangent + added(changed[:, :, None] * vectors)
    if slope is not None:
        apart, close = _split_change(primals, tangents)
        mean = slope[:, :, None] / 2
        tangent = tangent + added(values[:, :, None] * (apart @ vectors))
        tangent = tangent + added(mean * (close @ vectors))
        tangent = tangent + close @ added(mean * vectors) - apart @ total
    return total, tangent


combine.defjvp(_combine_jvp, symbolic_zeros=True)


def added(terms: Float[Array, "f *more"]) -> Float[Array, "*more"]:
    """Sum over the first axis, term by term or as a product of matrices, never as a sum.

    XLA makes a product that is summed over an axis one operation of its own, which in float32 on
    a CPU crashes the process from seven axes on (jaxlib 0.10.2 and 0.11.0); maps over rays,
    orders, wavelengths and layers reach that number.
    """
    if terms.shape[0] > 4:
        return jnp.tensordot(jnp.ones_like(terms, shape=terms.shape[:1]), terms, 1)
    return functools.reduce(operator.add, list(terms))


def is_zero(tangent) -> bool:
    """Whether a tangent is known to vanish, so that nothing needs to be compiled for it."""
    return isinstance(tangent, SymbolicZero)


def change(function: Callable, primals, tangents):
    """The tangent of a function's value, of which no more is made than its moving inputs need."""
    leaves, tree = jax.tree.flatten(primals)
    slopes = jax.tree.leaves(tangents, is_leaf=is_zero)
    moving = [i for i, d in enumerate(slopes) if not is_zero(d)]

    def vary(*some):
        every = list(leaves)
        for i, value in zip(moving, some, strict=True):
            every[i] = value
        return function(jax.tree.unflatten(tree, every))

    some, changes = (tuple(v[i] for i in moving) for v in (leaves, slopes))
    if not moving:
        return jax.tree.map(jnp.zeros_like, function(primals))
    return jax.jvp(vary, some, changes)[1]


def expand(functions: Callable, x, parameters: tuple, moving: list[int]):
    """Values of functions at k = sqrt(x), each (f, n), their slopes in x, and in the parameters
    whose places are `moving`, in one evaluation."""
    # df/dx = (df/dk)/(2k) loses eps/(k t)^2; f is analytic in x: take it at a small k t instead.
    k = root(x)
    safe = jnp.maximum(k, float(jnp.finfo(x.dtype).eps) ** 0.25 / parameters[0])

    def of(some):
        every = list(parameters)
        for i, value in zip(moving, some[1:], strict=True):
            every[i] = value
        return functions(some[0], *every)

    some = tuple(parameters[i] for i in moving)
    count = 1 + len(some)
    units = []
    for place, value in enumerate((k, *some)):
        unit = np.eye(count)[place].reshape((count,) + (1,) * value.ndim)
        unit = jnp.asarray(unit, dtype=value.dtype)
        units.append(jnp.broadcast_to(unit, (count, *value.shape)))

    def at(k):
        def along(*unit):
            return jax.jvp(of, ((k, *some),), (unit,))

        return jax.vmap(along, out_axes=(None, 0))(*units)

    values, slopes = jax.vmap(at)(jnp.stack([k, safe]))
    return values[0], slopes[1, 0] / (2 * safe)[None, :], slopes[0, 1:]


def _derivatives(functions, primals, tangents):
    """Values, their change with the parameters and their slope in x; None: no change."""
    x, matrix, parameters, _ = primals
    _, dmatrix, dparameters, _ = tangents
    x = still(x, matrix)
    moving = [i for i, d in enumerate(dparameters) if not is_zero(d)]
    if not moving and is_zero(dmatrix):
        return functions(root(x), *parameters), None, None
    values, slope, slopes = expand(functions, x, parameters, moving)
    changed = None
    for i, part in zip(moving, slopes, strict=True):
        moved = dparameters[i]
        # A parameter with an axis has one value for each function.
        part = part * (moved[:, None] if moved.ndim else moved)
        changed = part if changed is None else changed + part
    return values, changed, None if is_zero(dmatrix) else slope


@jax.custom_jvp
def still(x, matrix):
    """x inside a derivative, which must not be differentiated again where `matrix` moves."""
    return x


def _still_jvp(primals, tangents):
    if not is_zero(tangents[1]):
        raise NotImplementedError(
            "PlaneParallel has first derivatives in the water, not second ones (functions of the "
            "modes are differentiated once); take differences of its first derivatives instead."
        )
    return primals[0], jnp.zeros_like(primals[0])


still.defjvp(_still_jvp, symbolic_zeros=True)


def root(x):
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _split_change(primals, tangents):
    """Parts of dB for df = F o dB, F_ij = (f_i - f_j)/(x_i - x_j), the mean slope where x_i and
    x_j are close: with P = dB/(x_i - x_j) elsewhere and C = dB there, which no f enters,
    df = f P - P f + (f' C + C f')/2."""
    x, _, parameters, _ = primals
    change = tangents[1]
    difference = x[:, None] - x[None, :]
    near = float(jnp.finfo(x.dtype).eps) ** (1 / 3)
    close = jnp.abs(difference) <= near * (x[:, None] + x[None, :] + 1 / parameters[0] ** 2)
    apart = jnp.where(close, 0.0, change / jnp.where(close, 1.0, difference))
    return apart, jnp.where(close, change, 0.0)
