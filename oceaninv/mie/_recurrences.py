"""The recurrences behind Lorenz-Mie: one upward and one downward sweep per group of particles.

For a sphere of size parameter x = k r (in its host) and index ratio m, with y = m x, the sweep
delivers a_n and b_n from n = N down to 1 to a consumer that sums them, so that no coefficient is
ever stored.  Notation: psi_n = z j_n(z), chi_n = z y_n(z), zeta_n = psi_n + i chi_n (time factor
exp(-i w t), index n + ik with k >= 0).

* Upward: u_n(x), a second solution beside psi_n.  It is chi_n where x is nearly real, so that
  1/a = 1 + i w holds to the last digit of the real part, and -i zeta_n where Im x > 1/2, where
  psi and chi would cancel.  Upward is the stable direction for both.
* Downward: psi_{n+1}/psi_n at y, and psi_n(x) itself.  psi_n(x) is normalised at the top by its
  Wronskian with u, psi_{n+1} u_n - psi_n u_{n+1} = 1, not at the bottom by sin x, which is
  nearly zero at x = k pi.

With rho = psi_{n+1}(y)/psi_n(y), p = psi_n(x), c = (n+1)(1 - m^2)/(m x) the numerators and
denominators of eqs 9-10 of Frisvad et al. (2007) become, free of cancellation,

  a_n: N = (c - rho) p_n + m p_{n+1},   b_n: N = p_{n+1} - m rho p_n,   C the same with u for p,

and a_n = N/(N + iC), or N/(iC) where u is -i zeta.  Particles with x < 1 carry a factor
kappa = |x|^3 that keeps single precision from underflow: everything delivered is a_n/kappa.

Complex numbers are kept as (real, imaginary) pairs, the imaginary part None where it is absent:
the same code then serves real and complex arguments.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

_CROSSOVER = 0.5  # Im x above which the second solution is -i zeta instead of chi


class Pair(NamedTuple):
    """A complex array in two parts; im is None for a real one."""

    re: Array
    im: Array | None


def pair(z: Array) -> Pair:
    return Pair(z.real, z.imag) if jnp.iscomplexobj(z) else Pair(z, None)


def joined(z: Pair) -> Array:
    return z.re if z.im is None else jax.lax.complex(z.re, z.im)


def add(u: Pair, v: Pair) -> Pair:
    if u.im is None or v.im is None:
        return Pair(u.re + v.re, v.im if u.im is None else u.im)
    return Pair(u.re + v.re, u.im + v.im)


def negative(u: Pair) -> Pair:
    return Pair(-u.re, None if u.im is None else -u.im)


def subtract(u: Pair, v: Pair) -> Pair:
    return add(u, negative(v))


def scale(s: Array | float, u: Pair) -> Pair:
    return Pair(s * u.re, None if u.im is None else s * u.im)


def multiply(u: Pair, v: Pair) -> Pair:
    if u.im is None:
        return scale(u.re, v)
    if v.im is None:
        return scale(v.re, u)
    return Pair(u.re * v.re - u.im * v.im, u.re * v.im + u.im * v.re)


def conjugate(u: Pair) -> Pair:
    return Pair(u.re, None if u.im is None else -u.im)


def times_i(u: Pair) -> Pair:
    return Pair(jnp.zeros_like(u.re) if u.im is None else -u.im, u.re)


def modulus2(u: Pair) -> Array:
    return u.re * u.re if u.im is None else u.re * u.re + u.im * u.im


def dot(u: Pair, v: Pair) -> Array:
    """Re(u conj v)."""
    if u.im is None or v.im is None:
        return u.re * v.re
    return u.re * v.re + u.im * v.im


def select(condition: Array, u: Pair, v: Pair) -> Pair:
    if u.im is None or v.im is None:
        return Pair(jnp.where(condition, u.re, v.re), None)
    return Pair(jnp.where(condition, u.re, v.re), jnp.where(condition, u.im, v.im))


def reciprocal(u: Pair) -> Pair:
    """1/u, with an exact zero replaced by a tiny number: psi_n(y) = 0 must not stop the sweep."""
    tiny = float(jnp.finfo(u.re.dtype).eps) ** 2
    if u.im is None:
        return Pair(1.0 / jnp.where(u.re == 0.0, tiny, u.re), None)
    norm = modulus2(u)
    inverse = 1.0 / jnp.where(norm == 0.0, tiny * tiny, norm)
    return Pair(u.re * inverse, -u.im * inverse)


def zeros_like(u: Pair) -> Pair:
    return Pair(jnp.zeros_like(u.re), None if u.im is None else jnp.zeros_like(u.im))


class Term(NamedTuple):
    """The input of a consumer for each order, from the highest down to 1."""

    n: Array  # the order, as a float
    a: Pair
    b: Pair
    # Logarithmic derivatives of (a, b), empty unless requested: along ln x at fixed m, without
    # its factor x (m^2 - 1), and along ln m at fixed x, without its factor m.
    slopes: tuple[tuple[Pair, Pair], ...]


class SphereBatch(NamedTuple):
    """A batch of spheres and the constants of their sweep."""

    x: Pair
    m: Pair
    terms: Array  # number of orders of each sphere
    start: Array  # order at which psi(y) may be started from zero
    wronskian: Array  # kappa, or 1 where u is -i zeta
    own: Array  # weight of N in the denominator: kappa, or 0 where u is -i zeta


def series_length(size: Array) -> Array:
    """Orders needed for full precision at |x| = size (Wiscombe's form, wider for float64)."""
    cube = size ** (1.0 / 3.0)
    if size.dtype == jnp.float32:
        return jnp.ceil(size + 4.5 * cube + 2.0).astype(jnp.int32)
    return jnp.ceil(size + 6.5 * cube + 8.0).astype(jnp.int32)


def sphere_batch(x: Pair, m: Pair) -> SphereBatch:
    size = jnp.sqrt(modulus2(x))
    inner = jnp.sqrt(modulus2(multiply(m, x)))
    kappa = jnp.minimum(size, 1.0) ** 3
    steep = jnp.zeros_like(size, bool) if x.im is None else x.im > _CROSSOVER
    return SphereBatch(
        x,
        m,
        series_length(size),
        jnp.ceil(inner + 7.0 * inner ** (1.0 / 3.0) + 10.0).astype(jnp.int32),
        jnp.where(steep, 1.0, kappa),
        jnp.where(steep, 0.0, kappa),
    )


def _seeds(group: SphereBatch) -> tuple[Pair, Pair]:
    """u_0 and u_1: kappa chi_n, or -i zeta_n e^(Im x)."""
    x = group.x
    cosine, sine = jnp.cos(x.re), jnp.sin(x.re)
    inverse = reciprocal(x)
    if x.im is None:
        zero = scale(-group.wronskian, Pair(cosine, None))
        return zero, subtract(multiply(zero, inverse), Pair(group.wronskian * sine, None))
    mild = jnp.minimum(x.im, _CROSSOVER)
    cos_x = Pair(cosine * jnp.cosh(mild), -sine * jnp.sinh(mild))
    sin_x = Pair(sine * jnp.cosh(mild), cosine * jnp.sinh(mild))
    steep = group.own == 0.0
    zero = select(steep, Pair(-cosine, -sine), scale(-group.wronskian, cos_x))
    one = subtract(
        multiply(zero, inverse),
        select(steep, times_i(zero), scale(group.wronskian, sin_x)),
    )
    return zero, one


def _write(rows: Pair, row: Pair, n: Array) -> Pair:
    def put(buffer, value):
        return jax.lax.dynamic_update_index_in_dim(buffer, value, n, 0)

    return Pair(put(rows.re, row.re), None if rows.im is None else put(rows.im, row.im))


def _read(rows: Pair, n: Array) -> Pair:
    def get(buffer):
        return jax.lax.dynamic_index_in_dim(buffer, n, 0, keepdims=False)

    return Pair(get(rows.re), None if rows.im is None else get(rows.im))


def _upward(group: SphereBatch, inverse_x: Pair, orders: Array, rows: Pair) -> tuple[Pair, Pair]:
    """Fill rows[n] with u_n for 1 <= n <= orders; return them and u_(terms+1) of every sphere."""

    def step(i, carry):
        rows, below, here = carry
        n = i + 1
        factor = (2 * n + 1).astype(here.re.dtype)
        above = subtract(multiply(scale(factor, inverse_x), here), below)
        # Spheres that have all their orders stay as they are, so that they cannot overflow.
        return _write(rows, here, n), here, select(n <= group.terms, above, here)

    rows, _, top = jax.lax.fori_loop(0, orders, step, (rows, *_seeds(group)))
    return rows, top


def _step_inner(n: Array, inverse_y: Pair, rho: Pair) -> Pair:
    """psi_n(y)/psi_{n-1}(y) from psi_{n+1}(y)/psi_n(y)."""
    return reciprocal(subtract(scale(2.0 * n + 1.0, inverse_y), rho))


def _coefficient(numerator: Pair, second: Pair, own: Array, active: Array) -> tuple[Pair, Pair]:
    """N/D and 1/D with D = own N + iC; both 0 for spheres that do not have this order."""
    denominator = add(scale(own, numerator), times_i(second))
    inverse = scale(jnp.where(active, 1.0 / modulus2(denominator), 0.0), conjugate(denominator))
    return multiply(numerator, inverse), inverse


def _slopes(n, group, y, inverses, rho, inverse_a, inverse_b) -> tuple[tuple[Pair, Pair], ...]:
    """Logarithmic derivatives of a_n and b_n: every one is a Wronskian over D^2."""
    inverse_x2, inverse_y = inverses
    A = subtract(scale(n + 1.0, inverse_y), rho)
    A2 = multiply(A, A)
    nn = n * (n + 1.0)
    f_a = scale(group.wronskian, times_i(multiply(inverse_a, inverse_a)))
    f_b = scale(group.wronskian, times_i(multiply(inverse_b, inverse_b)))
    q = subtract(multiply(y, Pair(A2.re + 1.0, A2.im)), scale(nn, inverse_y))
    a_x = multiply(add(A2, scale(nn, inverse_x2)), f_a)
    a_m, b_m = multiply(add(q, A), f_a), multiply(subtract(q, A), f_b)
    return (a_x, f_b), (a_m, b_m)


def sweep(
    group: SphereBatch,
    rows: Pair,
    consume: Callable[[Term, Any], Any],
    state: Any,
    slopes: bool,
) -> tuple[Any, Pair]:
    """Run both sweeps over one group; rows is scratch space for u_n, handed back for reuse."""
    dtype = group.x.re.dtype
    y = multiply(group.m, group.x)
    inverse_x, inverse_y = reciprocal(group.x), reciprocal(y)
    inverse_x2 = multiply(inverse_x, inverse_x)
    one = jnp.ones_like(group.x.re)
    gap = multiply(
        multiply(subtract(Pair(one, None), group.m), add(Pair(one, None), group.m)), inverse_y
    )
    orders = jnp.max(group.terms)
    rows, top = _upward(group, inverse_x, orders, rows)
    p_top = scale(-group.wronskian, reciprocal(top))

    start = jnp.maximum(jnp.max(group.start), orders)

    def warm(i, rho):
        return _step_inner((start - i).astype(dtype), inverse_y, rho)

    rho = jax.lax.fori_loop(0, start - orders, warm, zeros_like(y))

    def down(i, carry):
        rho, above, p, u_above, state = carry
        k = orders - i
        n = k.astype(dtype)
        active = k <= group.terms
        u = _read(rows, k)
        p = select(k == group.terms, p_top, p)
        t = subtract(scale(n + 1.0, gap), rho)
        m_rho = multiply(group.m, rho)
        a, inverse_a = _coefficient(
            add(multiply(t, p), multiply(group.m, above)),
            add(multiply(t, u), multiply(group.m, u_above)),
            group.own,
            active,
        )
        b, inverse_b = _coefficient(
            subtract(above, multiply(m_rho, p)),
            subtract(u_above, multiply(m_rho, u)),
            group.own,
            active,
        )
        derivatives = ()
        if slopes:
            inverses = (inverse_x2, inverse_y)
            derivatives = _slopes(n, group, y, inverses, rho, inverse_a, inverse_b)
        state = consume(Term(n, a, b, derivatives), state)
        p_below = subtract(multiply(scale(2.0 * n + 1.0, inverse_x), p), above)
        return _step_inner(n, inverse_y, rho), p, p_below, u, state

    nothing = zeros_like(group.x)
    carry = (rho, nothing, nothing, top, state)
    return jax.lax.fori_loop(0, orders, down, carry)[-1], rows
