"""Amplitudes S1, S2 at given angles, summed by Clenshaw's rule inside the downward sweep.

With pi_{n+1} = (2n+1)/n cos pi_n - (n+1)/n pi_{n-1} and tau_n = n cos pi_n - (n+1) pi_{n-1},
S1 = sum c_n (a_n pi_n + b_n tau_n) has the pi_n-coefficients
c_n a_n + n cos c_n b_n - (n+2) c_{n+1} b_{n+1}, c_n = (2n+1)/(n(n+1)); S2 exchanges a and b.
The partial sums y_n run in Reinsch's difference form, y_n = d_n +- (n+1)/n y_{n+1} (sign of cos):
plain Clenshaw loses a factor of n^2 in accuracy towards 0 and 180 degrees.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from oceaninv.mie._recurrences import (
    Pair,
    SphereBatch,
    Term,
    add,
    conjugate,
    joined,
    modulus2,
    multiply,
    scale,
    subtract,
    sweep,
    zeros_like,
)
from oceaninv.mie._series_sums import in_groups


class AngleSums(NamedTuple):
    """S1 and S2 (angle, sphere) over |x| and the power sum over |x|^2; a_n scaled by
    e^(-2 Im x)."""

    s1: Array
    s2: Array
    power: Array


class _Partial(NamedTuple):
    """y_{n+1}, d_{n+1}, and c_{n+1} times the coefficient of tau."""

    y: Pair
    d: Pair
    tau: Pair


class _Angle(NamedTuple):
    """Cosine, its sign, and sign (1 - |cos|)."""

    cosine: Array
    sign: Array
    off_axis: Array


def _wide(u: Pair) -> Pair:
    return Pair(u.re[None, :], None if u.im is None else u.im[None, :])


def _advance(n, angle: _Angle, source: Pair, state: _Partial) -> tuple[Pair, Pair]:
    alpha = (2.0 * n + 1.0) / n
    d = add(source, scale(angle.sign, state.d))
    d = subtract(d, scale(alpha * angle.off_axis, state.y))
    return add(d, scale((n + 1.0) / n * angle.sign, state.y)), d


def _clenshaw(n, angle: _Angle, with_pi: Pair, with_tau: Pair, state: _Partial) -> _Partial:
    weight = (2.0 * n + 1.0) / (n * (n + 1.0))
    tau = scale(weight, with_tau)
    source = _wide(subtract(scale(weight, with_pi), scale(n + 2.0, state.tau)))
    source = add(source, scale(n * angle.cosine, _wide(tau)))
    return _Partial(*_advance(n, angle, source, state), tau)


def _clenshaw_slope(n, angle: _Angle, tau: Pair, value: _Partial, state: _Partial) -> _Partial:
    """d/dcos of the partial sums; `value` is their state before this order."""
    source = _wide(scale((2.0 * n + 1.0) / (n + 1.0), tau))
    source = add(source, scale((2.0 * n + 1.0) / n, value.y))
    return _Partial(*_advance(n, angle, source, state), state.tau)


def _consume(term: Term, state: Any, angle: _Angle) -> Any:
    n = term.n
    pairs = [(term.a, term.b)]
    power = [Pair(modulus2(term.a) + modulus2(term.b), None)]
    for da, db in term.slopes:
        pairs.append((da, db))
        power.append(add(multiply(conjugate(term.a), da), multiply(conjugate(term.b), db)))
    first, second, slopes, total = state
    if slopes is not None:
        slopes = (
            _clenshaw_slope(n, angle, term.b, first[0], slopes[0]),
            _clenshaw_slope(n, angle, term.a, second[0], slopes[1]),
        )
    first = [_clenshaw(n, angle, a, b, s) for (a, b), s in zip(pairs, first, strict=True)]
    second = [_clenshaw(n, angle, b, a, s) for (a, b), s in zip(pairs, second, strict=True)]
    total = [add(t, scale(2.0 * n + 1.0, p)) for t, p in zip(total, power, strict=True)]
    return first, second, slopes, total


def _run(group: SphereBatch, scratch: Pair, cosine: Array, slopes: bool):
    zero = zeros_like(group.x).re
    nothing = Pair(jnp.zeros_like(cosine), jnp.zeros_like(cosine))
    empty = _Partial(nothing, nothing, Pair(zero, zero))
    count = 3 if slopes else 1
    start = (
        [empty] * count,
        [empty] * count,
        (empty, empty) if slopes else None,
        [Pair(zero, None)] + [Pair(zero, zero)] * (count - 1),
    )
    sign = jnp.where(cosine < 0, -1.0, 1.0).astype(cosine.dtype)
    angle = _Angle(cosine, sign, sign - cosine)
    consume = functools.partial(_consume, angle=angle)
    (first, second, along_cosine, total), scratch = sweep(group, scratch, consume, start, slopes)
    size = jnp.sqrt(modulus2(group.x))
    damping = group.wronskian
    if group.x.im is not None:
        mild = jnp.exp(-2.0 * jnp.minimum(group.x.im, 1.0))
        damping = jnp.where(group.own == 0.0, 1.0, damping * mild)
    linear = damping / size
    one = Pair(jnp.ones_like(size), None)
    contrast = multiply(add(group.m, scale(-1.0, one)), add(group.m, one))
    factors = [one, multiply(group.x, contrast), group.m]

    def finish(values, weight):
        return [
            joined(multiply(_wide(scale(weight, f)), v))
            for f, v in zip(factors, values, strict=False)
        ]

    power = [
        joined(scale(linear * linear, multiply(f, v))) for f, v in zip(factors, total, strict=False)
    ]
    sums = [finish([s.y for s in values], linear) for values in (first, second)]
    if along_cosine is not None:
        for out, s in zip(sums, along_cosine, strict=True):
            out.extend(finish([s.y], linear))
    return (*sums, power), scratch


@functools.partial(jax.jit, static_argnames=("rows", "slopes"))
def _angles(x: Array, m: Array, cosine: Array, rows: int, slopes: bool):
    run = functools.partial(_run, slopes=slopes)
    return in_groups(run, x, m, rows, cosine, width=max(8, 16384 // max(cosine.shape[0], 1)))


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def angle_sums(x: Array, m: Array, cosine: Array, rows: int) -> AngleSums:
    """Amplitudes of flat x and m, shape (sphere,), at cosine, shape (angle, sphere)."""
    (s1,), (s2,), (power,) = _angles(x, m, cosine, rows, False)
    return AngleSums(s1, s2, power)


@angle_sums.defjvp
def _angle_sums_jvp(rows, primals, tangents):
    x, m, cosine = primals
    dx, dm, dcosine = tangents
    s1, s2, power = _angles(x, m, cosine, rows, True)
    ctype = s1[0].dtype
    log_x, log_m = (dx / x).astype(ctype), (dm / m).astype(ctype)
    # The scale |x|^-1 e^(-2 Im x) varies too, twice in the power.
    shrink = -jnp.real(log_x)
    if jnp.iscomplexobj(x):
        shrink = shrink - 2.0 * jnp.imag(dx)

    def amplitude(s):
        along = s[1] * log_x[None, :] + s[2] * log_m[None, :] + s[3] * dcosine.astype(ctype)
        return along + s[0] * shrink.astype(ctype)[None, :]

    d_power = 2.0 * jnp.real(power[1] * log_x + power[2] * log_m) + 2.0 * shrink * power[0]
    values = AngleSums(s1[0], s2[0], power[0])
    return values, AngleSums(amplitude(s1), amplitude(s2), d_power)
