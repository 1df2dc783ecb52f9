"""Counter-based random numbers, and directions from any phase function.

Every number is a hash of (path, event, key) and depends on nothing else, so that neither the order
nor the grouping of paths changes a result.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.water.phase import AbstractPhase

BINS = 1024  # of equal probability, per layer
_GRID = 4096
_DEAL = 0x3C6EF372  # separates the random stream that assigns the strata


def key_words(key) -> UInt32[Array, " 2"]:
    """64 bits of a JAX key."""
    return jax.random.bits(key, (2,), jnp.uint32)


def hashed(
    path: UInt32[Array, "..."], event: UInt32[Array, ""], words: UInt32[Array, " 2"]
) -> tuple[UInt32[Array, "..."], ...]:
    """Four words of 32 random bits per path.

    The hash is pcg4d (Jarzynski & Olano 2020, J. Comput. Graph. Tech. 9(3):20): a dozen integer
    products for 128 bits, where JAX's own generator takes five times as many operations.
    """
    multiplier, increment = jnp.uint32(1664525), jnp.uint32(1013904223)
    event = jnp.full_like(path, event)
    seeds = (path, event, jnp.full_like(path, words[0]), jnp.full_like(path, words[1]))
    a, b, c, d = (seed * multiplier + increment for seed in seeds)
    for last in (False, True):
        a = a + b * d
        b = b + c * a
        c = c + a * b
        d = d + b * c
        if not last:
            a, b, c, d = (word ^ (word >> jnp.uint32(16)) for word in (a, b, c, d))
    return a, b, c, d


def uniforms(
    path: UInt32[Array, "..."], event: UInt32[Array, ""], words: UInt32[Array, " 2"], dtype
) -> tuple[Float[Array, "..."], ...]:
    """Four independent numbers in (0, 1) per path."""
    # 23 bits: with the half added, every value is exact in single precision and inside (0, 1).
    scale = 2.0**-23
    return tuple(
        ((word >> jnp.uint32(9)).astype(dtype) + 0.5) * scale for word in hashed(path, event, words)
    )


def spread(
    u: tuple[Float[Array, "unit walk"], ...],
    unit: UInt32[Array, " unit"],
    event: UInt32[Array, ""],
    words: UInt32[Array, " 2"],
) -> tuple[Float[Array, "unit walk"], ...]:
    """Four numbers per walk, stratified among the walks of a unit (Latin hypercube sampling; McKay,
    Beckman & Conover 1979, Technometrics 21:239).

    The strata are assigned to the walks anew for every number and event.  Every number is still
    uniform, and independent of the other numbers of its walk.  The number of walks is a power of 2.
    """
    count = u[0].shape[1]
    if count == 1:
        return u
    mask = jnp.uint32(count - 1)
    place = jnp.arange(count, dtype=jnp.uint32)[None, :]
    deals = hashed(unit, event, words ^ jnp.uint32(_DEAL))
    top = 1.0 - 0.5 * float(jnp.finfo(u[0].dtype).eps)
    dealt = []
    for number, deal in zip(u, deals, strict=True):
        bits = [(deal >> jnp.uint32(shift))[:, None] for shift in (8, 16, 24)]
        stratum = (((place ^ bits[0]) * (bits[1] | jnp.uint32(1))) ^ bits[2]) & mask
        dealt.append(jnp.minimum((stratum.astype(number.dtype) + number) / count, top))
    return tuple(dealt)


def half_angle_table(
    phases: Sequence[AbstractPhase], weights: Float[Array, " shape"]
) -> Float[Array, " edge"]:
    """Edges, in sin^2(theta/2) from 0 to 1, of bins of equal probability of a mixture of phase
    functions.  The histogram itself is sampled, and its density is known exactly, so that the
    accuracy of the edges affects the variance but not the mean."""
    dtype = weights.dtype
    # Evenly in the logarithm near the peak, evenly in the angle further out.
    t = jnp.linspace(0.0, 1.0, _GRID, dtype=dtype)
    grid = jnp.sin(0.5 * jnp.pi * jnp.expm1(7.0 * t) / jnp.expm1(jnp.asarray(7.0, dtype))) ** 2
    grid = grid.at[0].set(0.0).at[-1].set(1.0)
    density = sum(
        (w * p(1.0 - 2.0 * grid).astype(dtype) for w, p in zip(weights, phases, strict=True)),
        start=jnp.full_like(grid, 1e-6),
    )
    steps = 0.5 * (density[1:] + density[:-1]) * jnp.diff(grid)
    cumulative = jnp.concatenate([jnp.zeros((1,), dtype), jnp.cumsum(steps)])
    at = jnp.linspace(0.0, 1.0, BINS + 1, dtype=dtype)
    edges = jnp.interp(at, cumulative / cumulative[-1], grid)
    return edges.at[0].set(0.0).at[-1].set(1.0)


def sample_half_angle(
    tables: Float[Array, "layer edge"], layer: Int[Array, "..."], u: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """sin^2(theta/2) and the density (1/sr) with which it was drawn."""
    at = u * BINS
    low = jnp.clip(at.astype(jnp.int32), 0, BINS - 1)
    flat = tables.reshape(-1)
    first = flat[layer * (BINS + 1) + low]
    width = flat[layer * (BINS + 1) + low + 1] - first
    tiny = jnp.finfo(u.dtype).tiny
    half = jnp.clip(first + (at - low.astype(u.dtype)) * width, 0.0, 1.0)
    return half, 1.0 / (4.0 * jnp.pi * BINS * jnp.maximum(width, tiny))


Vector = tuple[Array, ...]  # x, y, z


def turn(direction: Vector, half: Float[Array, "..."], u: Float[Array, "..."]) -> Vector:
    """`direction` turned by theta, of which sin^2(theta/2) is given, about a random azimuth.

    The frame is that of Duff et al. (2017, J. Comput. Graph. Tech. 6(1):1).
    """
    x, y, z = direction
    sign = jnp.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    cosine, sine = 1.0 - 2.0 * half, 2.0 * safe_sqrt(half * (1.0 - half))
    azimuth = 2.0 * jnp.pi * u
    p, q = sine * jnp.cos(azimuth), sine * jnp.sin(azimuth)
    turned = (
        p * (1.0 + sign * x * x * a) + q * b + cosine * x,
        p * sign * b + q * (sign + y * y * a) + cosine * y,
        -p * sign * x - q * y + cosine * z,
    )
    scale = jax.lax.rsqrt(turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2)
    return turned[0] * scale, turned[1] * scale, turned[2] * scale


def lambertian(normal: Vector, u: Float[Array, "..."], v: Float[Array, "..."]) -> Vector:
    """A direction of the hemisphere about `normal`, with density cosine/pi."""
    return turn(normal, 0.5 * u / (1.0 + safe_sqrt(1.0 - u)), v)
