"""Algebra of the four-stream field: two directions per hemisphere, azimuth orders 0 and 1.

The sum s and the difference d of the radiances that travel down and up obey, in optical depth t,

    s' = D d + q_d e^(-k0 t),   d' = S s + q_s e^(-k0 t),   hence s'' = D S s + ...:

2x2 systems with two modes each, v e^(-k t) in s and -k D^-1 v e^(-k t) in d.  Written with D^-1,
a mode that does not decay (k = 0) is no exception.  The orders are stacked, which keeps the
program short.  Axes, those that a quantity has: (order, node, mode, wl).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.transport.closed_form._ray_integral import ScaledAttenuation
from oceaninv.water.iops import IOPs
from oceaninv.water.phase import moments_of

# The directions for which the means of 1, mu and mu^2 over a hemisphere are exact.
WEIGHT = np.array([0.575, 0.425])
_HALF = (12 * WEIGHT[0] * WEIGHT[1]) ** -0.5
MU = np.array([0.5 - WEIGHT[1] * _HALF, 0.5 + WEIGHT[0] * _HALF])
FLUX = WEIGHT * MU
# Degrees l of order m = 0, 1 whose Legendre function is even in mu, or odd (order 1 has but one).
EVEN, ODD = np.array([[0, 2], [1, 3]]), np.array([[1, 3], [2, 2]])
# Fitted to exact fields: exponent of the truncated share; its weight, cap and least angle in
# single scattering.
_POWER, _FORWARD, _CAP, _AUREOLE = 0.93, 1.025, 0.995, 0.144


def angular(mu, level):
    """Even and odd normalised Legendre functions (order, degree, ...) at cosines mu.

    `level`: sin(zenith angle) cos(azimuth), a factor of those of order 1."""
    one, none, square = 0 * mu + 1, 0 * mu, mu * mu
    slanted = [0.5**0.5 * level, 0.1875**0.5 * (5 * square - 1) * level]
    even = [[one, 1.5 * square - 0.5], slanted]
    odd = [[mu, (2.5 * square - 1.5) * mu], [1.5**0.5 * mu * level, none]]
    return even, odd


_NODES = tuple(np.array(table) for table in angular(MU, np.sqrt(1 - MU**2)))


def at_nodes(orders: int, dtype) -> tuple[Array, Array]:
    """Even and odd Legendre functions at the nodes, each (order, degree, node)."""
    return tuple(jnp.asarray(table[:orders], dtype) for table in _NODES)  # pyright: ignore


def product(matrix, columns):
    """Matrix (order, i, j, wl) times columns (order, j, q, wl)."""
    return jnp.sum(matrix[:, :, :, None] * columns[:, None], axis=2)


def inverse(matrix):
    """Inverse of 2x2 matrices (order, i, j, wl)."""
    a, b, c, d = (matrix[:, i, j] for i in (0, 1) for j in (0, 1))
    rows = jnp.stack([jnp.stack([d, -b], axis=1), jnp.stack([-c, a], axis=1)], axis=1)
    return rows / (a * d - b * c)[:, None, None]


class TruncatedWater(eqx.Module):
    """Water whose forward peak, the share chi_4^0.93 of scattering, counts as unscattered.

    `gain`: (2 l + 1) times what is left of b chi_l, 1/m; `lost`: absorbed share of the
    attenuation; `correction`: relative increase of the slowest mode's attenuation.
    """

    attenuation: ScaledAttenuation
    gain: Float[Array, "4 wl"]
    lost: Float[Array, " wl"]
    correction: Float[Array, " wl"]

    def __init__(self, water: IOPs):
        a, b, dtype = water.a, water.b, water.a.dtype
        moments = jnp.stack([jnp.asarray(moments_of(p, 4), dtype) for p in water.phases])
        # Without scattering: the mean of the phase functions, which the derivative in b needs.
        weights = water.b_components + 1e-18
        chi = jnp.sum(moments[:, :, None] * weights[:, None, :], axis=0)
        chi = chi / jnp.sum(weights, axis=0, keepdims=True)
        # The least share keeps the slope in g finite at g = 0.
        share = (jnp.maximum(chi[4], 0.0) * (1 - 1e-8) + 1e-8) ** _POWER
        c_star = a + b * (1.0 - share)
        forward = b * jnp.minimum(_FORWARD * share, _CAP)
        self.attenuation = ScaledAttenuation(water.c, c_star, forward, _AUREOLE)
        degree = jnp.asarray([[1.0], [3.0], [5.0], [7.0]], dtype)
        self.gain = degree * b[None, :] * (chi[:4] - share[None, :])
        self.lost = _ratio(a, c_star, 1.0)
        dark, high = _ratio(a, water.c, 1.0), water.albedo**12
        self.correction = 0.0175 * high / (high + 0.275) * dark / (dark + 0.003)

    @property
    def gain_per_depth(self) -> Float[Array, "4 wl"]:
        """`gain` per optical depth."""
        return _ratio(self.gain, self.attenuation.c_star[None, :], 0.0)


def _ratio(x, y, otherwise):
    return jnp.where(y > 0, x / jnp.where(y > 0, y, 1.0), otherwise)


class Modes(eqx.Module):
    """`k`: decay of the modes per optical depth; `s`, `d`: their values at the nodes, d for
    k = -1; `D`: the matrix of the field, `D_inverse` its inverse."""

    k: Float[Array, "order mode wl"]
    s: Float[Array, "order node mode wl"]
    d: Float[Array, "order node mode wl"]
    D: Float[Array, "order node node wl"]
    D_inverse: Float[Array, "order node node wl"]

    def __init__(self, gain: Float[Array, "4 wl"], lost: Float[Array, " wl"], orders: int, least):
        dtype = gain.dtype
        one = jnp.asarray(np.eye(2)[None, :, :, None], dtype)
        weight = jnp.asarray(WEIGHT[None, None, None], dtype)
        mu = jnp.asarray(MU[None, :, None, None], dtype)

        def matrix(table, degree):
            pairs = table[:, :, :, None] * table[:, :, None, :] * weight
            rates = jnp.sum(pairs[..., None] * gain[degree[:orders]][:, :, None, None], axis=1)
            return (rates - one) / mu

        even, odd = at_nodes(orders, dtype)
        S, D = matrix(even, EVEN), matrix(odd, ODD)
        X = product(D, S)
        # The larger eigenvalue; the smaller by determinants, that of order 0 without cancellation
        # where little is absorbed: (w mu) S = -lost w.
        half = 0.5 * (X[:, 0, 0] - X[:, 1, 1])
        root = jnp.sqrt(half**2 + X[:, 0, 1] * X[:, 1, 0])
        large = 0.5 * (X[:, 0, 0] + X[:, 1, 1]) + root
        of_S = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0]
        first, second = (float(x) for x in WEIGHT / FLUX[1])
        kept = first * S[:1, 0, 1] - second * S[:1, 0, 0]
        of_S = jnp.concatenate([kept * lost[None, :], of_S[1:]])
        of_D = D[:, 0, 0] * D[:, 1, 1] - D[:, 0, 1] * D[:, 1, 0]
        small = of_D * of_S / large
        self.k = jnp.stack([safe_sqrt(least(small)), jnp.sqrt(large)], axis=1)
        # The eigenvalues never meet: the first node's attenuation is far above the second's.
        gap = half + root
        p, q, unit = X[:, 0, 1] / gap, X[:, 1, 0] / gap, jnp.ones_like(gap)
        self.s = jnp.stack([jnp.stack([-p, unit], 1), jnp.stack([unit, q], 1)], axis=1)
        self.D, self.D_inverse = D, inverse(D)
        self.d = product(self.D_inverse, self.s)


def beam_source(
    gain: Float[Array, "4 wl"], mu0: Float[Array, ""], beam: Float[Array, " wl"], orders: int
) -> tuple[Float[Array, "order node 1 wl"], Float[Array, "order node 1 wl"]]:
    """q_s and q_d: light scattered out of the sunbeam at t = 0, as columns."""
    sun = angular(mu0, safe_sqrt(1 - mu0**2))
    tables = at_nodes(orders, gain.dtype)
    found = []
    for table, here, degree in zip(tables, sun, (EVEN, ODD), strict=True):
        here = jnp.stack([jnp.stack(row) for row in here[:orders]])
        rates = table[..., None] * (here[:, :, None] * gain[degree[:orders]])[:, :, None, :]
        found.append(jnp.sum(rates, axis=1))
    share = np.array([0.5, 1.0])[:orders] / np.pi
    scale = jnp.asarray(share[:, None, None] / MU[None, :, None], gain.dtype)
    q_s, q_d = ((scale * beam[None, None, :] * x)[:, :, None] for x in found)
    return q_s, q_d
