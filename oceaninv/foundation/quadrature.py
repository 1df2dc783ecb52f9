"""Directions of discrete ordinates: node sets on a hemisphere and the angular basis on them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation.numerics import gauss_legendre, safe_sqrt


class Basis(NamedTuple):
    """Nodes of one hemisphere and, for an azimuth order m, the Legendre functions on them.

    With A_li = sqrt(w_i) p_l(mu_i), corrected (`angular_basis`): `odd` is A for l - m = 1, 3, ...;
    `even` is turn' A for l - m = 0, 2, ..., `turn` orthogonal with first column sqrt(w).
    """

    mu: Array  # (n,)
    weight: Array  # (n,)
    even: Array  # (n, moment/2)
    odd: Array  # (n, moment/2)
    turn: Array  # (n, n)
    order: Array  # () m

    @property
    def flux(self):
        """f = sqrt(w mu), the vector with f.y the flux over 2 pi."""
        return jnp.sqrt(self.weight * self.mu)

    def from_order(self, values: Array) -> Array:
        """Values by degree l, rearranged to begin at l = m (what wraps around meets zeros)."""
        return jnp.roll(values, -self.order)


def legendre(
    mu: Float[Array, "node"], orders: int, degrees: int
) -> Float[Array, "order degree node"]:
    """Associated Legendre functions, normalised on the half range, of m < orders, l < degrees.

    p_l = sqrt((2l+1)(l-m)!/(l+m)!) P_l^m without the Condon-Shortley sign: the integral of p_l^2
    over 0..1 is 1 and p_l(-mu) = (-1)^(l+m) p_l(mu).  Entries with l < m are zero.  |mu| <= 1.
    """
    m, l = np.arange(orders), np.arange(degrees)[:, None]
    above = l > m
    gain = np.sqrt(np.where(above, 4 * l**2 - 1, 0) / np.where(above, l**2 - m**2, 1))
    back = np.where(l > m + 1, (l - 1) ** 2 - m**2, 0) / np.where(l > 1, 4 * (l - 1) ** 2 - 1, 1)
    sine = safe_sqrt((1 - mu) * (1 + mu))
    factors = np.sqrt([1.0] + [1 + 0.5 / i for i in range(1, orders)])
    powers = jnp.concatenate([jnp.ones_like(mu)[None], jnp.tile(sine[None], (orders - 1, 1))])
    start = jnp.cumprod(powers * jnp.asarray(factors, dtype=mu.dtype)[:, None], axis=0)

    def step(carry, coefficients):
        older, last = carry
        g, b, first = coefficients
        new = g[:, None] * (mu[None, :] * last - b[:, None] * older) + first[:, None] * start
        return (last, new), new

    coefficients = tuple(jnp.asarray(v, dtype=mu.dtype) for v in (gain, np.sqrt(back), l == m))
    zero = jnp.zeros_like(start)
    _, table = jax.lax.scan(step, (zero, zero), coefficients)
    return jnp.swapaxes(table, 0, 1)


def double_gauss(streams: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights in the cosine on 0..1."""
    return gauss_legendre(streams, 0.0, 1.0)


def snell_gauss(
    streams: int, index: Float[Array, ""]
) -> tuple[Float[Array, "node"], Float[Array, "node"]]:
    """Nodes and weights in water under a surface of this index, a quarter to half of them (all
    but streams/2, rounded down) inside Snell's cone.

    The Fresnel reflectance has a square-root singularity at the critical cosine: the range is
    split there, and inside the cone the rule is Gauss in the cosine in air, in which the
    singularity is gone.
    """
    inner, outer = gauss_legendre(streams - streams // 2, 0.0, 1.0), double_gauss(streams // 2)
    air, air_weight, rest, rest_weight = (
        jnp.asarray(v, dtype=index.dtype) for v in (*inner, *outer)
    )
    cone = jnp.sqrt(1 - (1 - air**2) / index**2)
    critical = jnp.sqrt(1 - 1 / index**2)
    mu = jnp.concatenate([critical * rest, cone])
    return mu, jnp.concatenate([critical * rest_weight, air_weight * air / (index**2 * cone)])


def angular_basis(
    mu: Float[Array, "node"],
    weight: Float[Array, "node"],
    orders: int,
    moments: int,
    orthonormal: bool = False,
) -> Basis:
    """The bases of azimuth orders m < orders (leading axis), degrees l < moments (even).

    Nodes do not integrate the Legendre functions exactly: light of one degree is then scattered
    with a share of another's moment.  Those of order 0 are made orthogonal to the first even and
    the first odd one, which makes flux and its first moment conserved exactly (as Wiscombe 1977
    does by correcting the phase function).  `orthonormal` makes all even and all odd ones of every
    order orthonormal, low degrees first, so that each degree is scattered with its own moment; it
    needs functions that the nodes tell apart, moments up to 5/4 of the nodes.
    """
    table = legendre(mu, orders, moments) * jnp.sqrt(weight)[None, None, :]
    table = jnp.pad(table, [(0, 0), (0, orders), (0, 0)])
    m, step = np.arange(orders)[:, None], np.arange(0, moments, 2)[None, :]
    degree = np.minimum(m + step, moments)
    even, odd = (jnp.swapaxes(table[m, degree + i], 1, 2) for i in (0, 1))
    if orthonormal:
        even, odd = jax.vmap(jax.vmap(_orthonormal))(jnp.stack([even, odd]))
    else:
        even = even.at[0].set(_orthogonal_to_first(even[0]))
        odd = odd.at[0].set(_orthogonal_to_first(odd[0]))
    # Householder: maps the first unit vector to the first column of order 0.
    one = jnp.eye(mu.shape[0], dtype=mu.dtype)
    normal = even[0, :, 0] - one[0]
    normal = normal / jnp.linalg.norm(normal)
    turn = one - 2 * jnp.outer(normal, normal)

    def each(value):
        return jnp.broadcast_to(value, (orders, *value.shape))

    return Basis(each(mu), each(weight), turn @ even, odd, each(turn), jnp.arange(orders))


def _orthogonal_to_first(columns):
    first = columns[:, :1] / jnp.linalg.norm(columns[:, :1])
    rest = columns[:, 1:] - first @ (first.T @ columns[:, 1:])
    return jnp.concatenate([first, rest], axis=1)


def _orthonormal(columns: Float[Array, "node moment"]) -> Float[Array, "node moment"]:
    """Orthonormal columns of the same spans, in order (Gram & Schmidt); empty ones stay empty."""

    def step(done, place):
        column = columns[:, place]
        for _ in range(2):  # the second time for the rounding of the first
            column = column - done @ (done.T @ column)
        square = column @ column
        column = column / jnp.sqrt(jnp.where(square > 0, square, 1.0))
        return done.at[:, place].set(column), None

    done, _ = jax.lax.scan(step, jnp.zeros_like(columns), jnp.arange(columns.shape[1]))
    return done
