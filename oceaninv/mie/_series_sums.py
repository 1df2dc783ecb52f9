"""Sums over the Lorenz-Mie series for many particles at once, with their derivatives.

Particles are sorted by size and swept in groups, whose loops end at the series length of their
largest member: one compiled program serves every size, and small particles cost little.
"""

import functools
import math
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
    dot,
    joined,
    modulus2,
    multiply,
    pair,
    scale,
    sphere_batch,
    sweep,
    zeros_like,
)

_GROUP = 256  # particles per group: larger groups amortise loop overhead, smaller waste less
_BUFFERS = (2560, 11264)  # rows of scratch space; then by factors of 4


class Sums(NamedTuple):
    """Series sums of one particle each over |x|^2, for a_n and b_n scaled by e^(-2 Im x)."""

    amplitude: Array  # sum (2n+1)(a_n + b_n): twice the forward amplitude S(0); complex
    power: Array  # sum (2n+1)(|a_n|^2 + |b_n|^2)
    cosine: Array  # the numerator of eq 26


def buffer_rows(max_size: float) -> int:
    """Static rows of scratch space for |x| <= max_size: few values, hence few programs."""
    needed = math.ceil(max_size + 6.5 * max_size ** (1 / 3)) + 12  # series_length and a few rows
    for rows in _BUFFERS:
        if needed <= rows:
            return rows
    return _BUFFERS[-1] * 4 ** math.ceil(math.log(needed / _BUFFERS[-1], 4))


def largest_size(rows: int) -> float:
    """A size parameter whose series certainly fits into `rows`."""
    return rows - 12 - 6.5 * rows ** (1 / 3)


def _group_sizes(count: int, width: int) -> tuple[int, int]:
    """(groups, particles per group), the latter at most `width`, for `count` particles."""
    width = min(width, max(8, -(-count // 16)))
    groups = -(-count // width)
    return groups, -(-count // groups)


def in_groups(
    run, x: Array, m: Array, rows: int, sphere_data: Any = (), width: int = _GROUP
) -> Any:
    """Apply run(group, scratch, sphere_data) -> (out, scratch) to sorted groups of a flat batch.

    x and m have shape (sphere,); sphere_data is a pytree of arrays whose last axis is the sphere;
    the last axis of the result is the sphere, too, in the original order.
    """
    count = x.shape[0]
    groups, width = _group_sizes(count, min(width, _GROUP))
    order = jnp.argsort(jnp.abs(x))
    # Repeat the largest particle to fill the last group.
    slots = order[jnp.minimum(jnp.arange(groups * width), count - 1)]
    original = jnp.zeros(count, slots.dtype).at[slots[:count]].set(jnp.arange(count))

    def split(values):
        picked = jnp.take(values, slots, axis=-1)
        grouped = picked.reshape(*values.shape[:-1], groups, width)
        return jnp.moveaxis(grouped, -2, 0)

    dtype = jnp.real(x).dtype
    scratch = jnp.zeros((rows, width), dtype)
    scratch = Pair(scratch, jnp.zeros_like(scratch) if jnp.iscomplexobj(x) else None)

    def one_group(scratch, inputs):
        group_x, group_m, data = inputs
        out, scratch = run(sphere_batch(pair(group_x), pair(group_m)), scratch, data)
        return scratch, out

    inputs = (split(x), split(m), jax.tree.map(split, sphere_data))
    _, outs = jax.lax.scan(one_group, scratch, inputs)

    def merge(values):
        joint = jnp.moveaxis(values, 0, -2)
        return jnp.take(joint.reshape(*joint.shape[:-2], groups * width), original, axis=-1)

    return jax.tree.map(merge, outs)


class _Accumulator(NamedTuple):
    term: Term  # the term of the next higher order
    amplitude: Any
    power: Any
    cosine: Any


def _accumulate(term: Term, state: _Accumulator) -> _Accumulator:
    """Add one order to eqs 22, 23 and 26, and to their complex slopes along ln x and ln m."""
    n, before = term.n, state.term
    weight = 2.0 * n + 1.0
    near = n * (n + 2.0) / (n + 1.0)
    cross = weight / (n * (n + 1.0))

    def cosine(a, b):
        return near * (dot(a, before.a) + dot(b, before.b)) + cross * dot(a, term.b)

    def slopes(da, db, da_before, db_before):
        a_bar, b_bar = conjugate(term.a), conjugate(term.b)
        power = add(multiply(a_bar, da), multiply(b_bar, db))
        neighbours = add(
            add(multiply(conjugate(before.a), da), multiply(a_bar, da_before)),
            add(multiply(conjugate(before.b), db), multiply(b_bar, db_before)),
        )
        mixed = add(multiply(b_bar, da), multiply(a_bar, db))
        return add(da, db), power, add(scale(near, neighbours), scale(cross, mixed))

    amplitude = [add(term.a, term.b)]
    power = [Pair(modulus2(term.a) + modulus2(term.b), None)]
    moment = [Pair(cosine(term.a, term.b), None)]
    for new, old in zip(term.slopes, before.slopes, strict=True):
        for total, value in zip((amplitude, power, moment), slopes(*new, *old), strict=True):
            total.append(value)

    def sums(old, new):
        return [add(o, scale(weight, v)) for o, v in zip(old, new, strict=True)]

    return _Accumulator(
        term,
        sums(state.amplitude, amplitude),
        sums(state.power, power),
        [add(o, v) for o, v in zip(state.cosine, moment, strict=True)],
    )


def _run_totals(group: SphereBatch, scratch: Pair, _: Any, slopes: bool):
    zero = zeros_like(group.x).re
    complex_zero, real_zero = Pair(zero, zero), Pair(zero, None)
    directions = 2 if slopes else 0
    nothing = (complex_zero, complex_zero)
    start = _Accumulator(
        Term(jnp.zeros((), zero.dtype), *nothing, (nothing,) * directions),
        [complex_zero] * (1 + directions),
        [real_zero] + [complex_zero] * directions,
        [real_zero] + [complex_zero] * directions,
    )
    end, scratch = sweep(group, scratch, _accumulate, start, slopes)
    # Undo kappa, divide by |x|^2, and bring every sphere to the scale e^(-2 Im x).
    size2 = modulus2(group.x)
    damping = group.wronskian
    if group.x.im is not None:
        mild = jnp.exp(-2.0 * jnp.minimum(group.x.im, 1.0))
        damping = jnp.where(group.own == 0.0, 1.0, damping * mild)
    linear = damping / size2
    square = linear * damping
    # The constant factors of the slopes: x (m^2 - 1) and m.
    one = Pair(jnp.ones_like(size2), None)
    contrast = multiply(add(group.m, scale(-1.0, one)), add(group.m, one))
    factors = [one, multiply(group.x, contrast), group.m]

    def finish(values, weight):
        return [
            joined(scale(weight, multiply(f, v))) for f, v in zip(factors, values, strict=False)
        ]

    sums = (
        finish(end.amplitude, linear),
        finish(end.power, square),
        finish(end.cosine, square),
    )
    return sums, scratch


@functools.partial(jax.jit, static_argnames=("rows", "slopes"))
def _totals(x: Array, m: Array, rows: int, slopes: bool):
    run = functools.partial(_run_totals, slopes=slopes)
    return in_groups(run, x, m, rows)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def series_sums(x: Array, m: Array, rows: int) -> Sums:
    """Sums over the series for flat x = k r (real or complex) and m (real or complex).

    The same sweep gives every derivative in closed form (after Grainger et al., 2004, Appl. Opt.
    43:5386): a_n and b_n are holomorphic in ln x and ln m, so that two complex slopes contain all
    five real ones.  Nothing is stored, so that forward and reverse mode cost the same.
    """
    (amplitude,), (power,), (cosine,) = _totals(x, m, rows, False)
    return Sums(amplitude, power, cosine)


@series_sums.defjvp
def _series_sums_jvp(rows, primals, tangents):
    x, m = primals
    dx, dm = tangents
    amplitude, power, cosine = _totals(x, m, rows, True)
    ctype = amplitude[0].dtype
    log_x, log_m = (dx / x).astype(ctype), (dm / m).astype(ctype)

    def along(slopes):
        return slopes[1] * log_x + slopes[2] * log_m

    # The scale |x|^-2 e^(-2 Im x) varies too, and its factor e^(-2 Im x) comes twice in squares.
    linear = -2.0 * jnp.real(log_x)
    square = linear
    if jnp.iscomplexobj(x):
        linear = linear - 2.0 * jnp.imag(dx)
        square = square - 4.0 * jnp.imag(dx)
    tangents = Sums(
        along(amplitude) + linear.astype(ctype) * amplitude[0],
        2.0 * jnp.real(along(power)) + square * power[0],
        jnp.real(along(cosine)) + square * cosine[0],
    )
    return Sums(amplitude[0], power[0], cosine[0]), tangents
