"""Array-RQMC: a sorted group of walks takes the points of one low-discrepancy set at every event.

The walks of a group are sorted by position and direction along a space-filling curve and take the
points of a scrambled net in that order (L'Ecuyer, Lecot & Tuffin 2008, Oper. Res. 56:958).
Neighbours thus draw different numbers, and the variance of the group's mean is smaller than that of
independent walks.  The numbers of every walk are uniform and independent of its history, so that
all estimates are unbiased; groups are independent of each other.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.transport.monte_carlo import _weights
from oceaninv.transport.monte_carlo._random_numbers import hashed, uniforms
from oceaninv.transport.monte_carlo._random_walk import WalkBatch

NUMBERS = 6  # coordinates of a point: four for the walk itself, two for other uses
_DRAW = 0x2C1B3C6D  # separates the random stream of the resampling
_SCRAMBLE = (0x3C6EF372, 0x1F83D9AB, 0x5BE0CD19)  # and those of the scrambles
# Primitive polynomials and initial direction numbers of Joe & Kuo (2008, SIAM J. Sci. Comput.
# 30:2635), dimensions 2 to 7: degree, inner coefficients, numbers.
_DIRECTIONS = (
    (1, 0, (1,)),
    (2, 1, (1, 3)),
    (3, 1, (1, 3, 1)),
    (3, 2, (1, 1, 1)),
    (4, 1, (1, 1, 3, 3)),
    (4, 4, (1, 3, 5, 13)),
)
_DEPTH_BITS = 11  # of each coordinate along the curve


class SortOrder(NamedTuple):
    """How walks are sorted and resampled.

    `height`: position of a walk from 0 to 1; `importance`: its expected further contribution
    relative to its weight; `rate`: rate at which its next flight is drawn, relative to the
    proposal's.  The last two are None where walks are not resampled.
    """

    height: Callable[[WalkBatch], Array]
    importance: Callable[[WalkBatch], Array] | None
    rate: Callable[[WalkBatch], Array] | None


def _reversed(word):
    """The 32 bits of a word in reverse order."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        s, m = np.uint32(shift), np.uint32(mask)
        word = ((word >> s) & m) | ((word & m) << s)
    return (word >> np.uint32(16)) | (word << np.uint32(16))


@lru_cache
def net(count: int) -> np.ndarray:
    """(number, point) Sobol points as words of reversed bits, in the order of their first
    coordinate.  That coordinate is the place of a walk in the sorted order and is left out.
    `count` is a power of 2."""
    bits = count.bit_length() - 1
    index = np.arange(count, dtype=np.uint32)
    place = _reversed(index) >> np.uint32(32 - bits) if bits else index
    points = np.zeros((NUMBERS, count), np.uint32)
    for row, (degree, inner, start) in zip(points, _DIRECTIONS, strict=True):
        m = list(start)
        for k in range(degree, bits):
            new = m[k - degree] ^ (m[k - degree] << degree)
            for j in range(1, degree):
                new ^= ((inner >> (degree - 1 - j)) & 1) * (m[k - j] << j)
            m.append(new)
        for k in range(bits):
            row ^= np.where((place >> np.uint32(k)) & np.uint32(1), np.uint32(m[k] << (31 - k)), 0)
    return _reversed(points)


def points(
    unit: UInt32[Array, " unit"],
    event: UInt32[Array, ""],
    words: UInt32[Array, " 2"],
    count: int,
    dtype,
    which: tuple[int, ...] = tuple(range(NUMBERS)),
) -> tuple[Float[Array, "unit walk"], ...]:
    """Numbers in (0, 1): the points of one net per unit and event, scrambled independently.

    The scramble is a hash in which no bit depends on lower ones (Laine & Karras 2011, Comput.
    Graph. Forum 30:1265), an approximation of Owen's scrambling.
    """
    # The scramble relies most on a seed's lowest bits, which our hash mixes least.
    seeds = [
        _reversed(seed)
        for key in _SCRAMBLE
        for seed in hashed(unit, event, words ^ jnp.uint32(key))
    ]
    table, found = net(count), []
    for i in which:
        add, turn = seeds[2 * i][:, None], seeds[2 * i + 1][:, None]
        word = jnp.asarray(table[i])[None, :] + add
        for factor in (jnp.uint32(0x6C50B47C), turn & jnp.uint32(0xFFFFFFFE), 0xC7AFE638):
            word = word ^ (word * jnp.asarray(factor, jnp.uint32))
        word = _reversed(word)
        found.append(((word >> jnp.uint32(9)).astype(dtype) + 0.5) * 2.0**-23)
    return tuple(found)


def _sparse(word: UInt32[Array, "..."]) -> UInt32[Array, "..."]:
    """The lower 16 bits of a word, each followed by a bit 0."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        word = (word | (word << jnp.uint32(shift))) & jnp.uint32(mask)
    return word


def places(
    height: Float[Array, "unit walk"], steepness: Float[Array, "unit walk"]
) -> Int[Array, "unit walk"]:
    """Walks ordered along Morton's curve through the square of two coordinates from 0 to 1."""
    count = height.shape[1]
    top = 2**_DEPTH_BITS
    cells = [jnp.clip(v * top, 0, top - 1).astype(jnp.uint32) for v in (height, steepness)]
    curve = _sparse(cells[0]) | (_sparse(cells[1]) << jnp.uint32(1))
    # The last bits hold the index of the walk: one word is sorted, and ties keep their order.
    bits = (count - 1).bit_length()
    coarse = jnp.uint32(max(bits + 2 * _DEPTH_BITS - 32, 0))
    walk = jnp.arange(count, dtype=jnp.uint32)[None, :]
    key = ((curve >> coarse) << jnp.uint32(bits)) | walk
    return (jnp.sort(key, axis=1) & jnp.uint32(2**bits - 1)).astype(jnp.int32)


def sorted_and_resampled(
    walks: WalkBatch,
    order: SortOrder,
    unit: UInt32[Array, " unit"],
    event: UInt32[Array, ""],
    words: UInt32[Array, " 2"],
) -> WalkBatch:
    """The walks of every unit, sorted and, if `order` has an importance, resampled by it.

    They are moved to one vertical line and turned into one vertical plane, which changes nothing in
    horizontally uniform light.
    """
    fixed = jax.lax.stop_gradient(walks)
    place = places(order.height(fixed), 0.5 * (1.0 + fixed.direction[2]))
    copies = None
    if order.importance is not None:
        u = uniforms(unit, event, words ^ jnp.uint32(_DRAW), walks.weight.dtype)[0]
        importance = jnp.take_along_axis(fixed.weight * order.importance(fixed), place, axis=1)
        systematic_resampling, copies = _weights.systematic_resampling(
            importance, importance.shape[1], u
        )
        place = jnp.take_along_axis(place, systematic_resampling, axis=1)
    # Horizontal position and azimuth do not matter and are not carried along.
    walks = walks._replace(
        position=(None, None, walks.position[2]), direction=(None, None, walks.direction[2])
    )
    walks = _weights.resample(walks, place, copies)
    depth, steep = walks.position[2], walks.direction[2]
    level, zero = safe_sqrt(jnp.maximum(1.0 - steep**2, 0.0)), jnp.zeros_like(steep)
    return walks._replace(position=(zero, zero, depth), direction=(level, zero, steep))
