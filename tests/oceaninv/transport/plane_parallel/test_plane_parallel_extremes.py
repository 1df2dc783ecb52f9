"""Fluxes of the exact transport over the whole range of waters, slabs and suns: values by the
conservation of energy and by cutting a layer in two, derivatives by finite differences."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oceaninv.foundation.quadrature import angular_basis, double_gauss, legendre
from oceaninv.transport.plane_parallel import _column

STREAMS = 16
# Absorption and scattering, 1/m: with c = 1, and nothing at all.
WATERS = ((0.0, 1.0), (1e-12, 1.0), (1e-6, 1.0), (0.2, 0.8), (1.0, 1e-12), (1.0, 0.0))
ASYMMETRY = (-0.5, 0.0, 0.924, 0.99)
COSINE = (1.0, 0.5, 0.01)
THICKNESS = (1e-8, 1e-3, 1.0, 30.0, 1e4)
SHARES = jnp.asarray([0.0, 0.3, 1.0])


def field(p, shares, parts=1):
    """Ed, Eu, E0 (row, depth) at shares of a slab; p = (a, b, g, mu0, rho, thickness)."""
    a, b, g, cosine, rho, thickness = p
    moments = b * jnp.cumprod(jnp.full(2 * STREAMS + 1, g).at[0].set(1.0))
    mu, weight = (jnp.asarray(v, dtype=p.dtype) for v in double_gauss(STREAMS))
    basis = jax.tree.map(lambda v: v[0], angular_basis(mu, weight, 1, 2 * STREAMS))
    angular = legendre(cosine[None], 1, 2 * STREAMS)[0, :, 0]
    sources = _column.Sources(cosine, jnp.ones_like(a), angular, None, None, rho)
    water = _column.Water(
        jnp.tile(a[None], parts),
        jnp.tile(moments[None], (parts, 1)),
        jnp.tile(thickness[None] / parts, parts),
    )
    column = _column.solve(water, sources, basis)
    down, up, depth = jax.vmap(lambda z: _column.within(*_column.locate(column, z)))(
        shares * thickness
    )
    flux = 2 * np.pi * basis.flux
    beam = jnp.exp(-depth / cosine)
    scalar = (down + up) @ (flux / basis.mu) + beam
    return jnp.stack([down @ flux + cosine * beam, up @ flux, scalar])


def grid(waters=WATERS, asymmetry=ASYMMETRY, cosine=COSINE, thickness=THICKNESS):
    rest = itertools.product(asymmetry, cosine, (0.0, 0.5), thickness)
    return np.array([(*water, *others) for others in rest for water in waters])


@jax.jit
def both(points, shares):
    """Values and their derivatives with respect to p, and with respect to the shares."""

    def one(p):
        slope, found = jax.jacfwd(lambda p: (field(p, shares),) * 2, has_aux=True)(p)
        _, along = jax.jvp(lambda s: field(p, s), (shares,), (jnp.ones_like(shares),))
        return found, slope, along

    return jax.lax.map(one, points, batch_size=64)


values = jax.jit(
    lambda points, shares: jax.lax.map(lambda p: field(p, shares), points, batch_size=64)
)
halves = jax.jit(
    lambda points, shares: jax.lax.map(lambda p: field(p, shares, 2), points, batch_size=64)
)


def differences(points, i, step):
    """Fourth-order differences with respect to p_i; one-sided where p must not be passed."""
    unit = np.eye(points.shape[1])[i] * step[:, None]
    places = range(-4, 5)
    both_sides = np.array([0, 0, 1, -8, 0, 8, -1, 0, 0])
    upwards = np.array([0, 0, 0, 0, -25, 48, -36, 16, -3])
    stack = np.concatenate([points + k * unit for k in places])
    found = np.asarray(values(jnp.asarray(stack), SHARES)).reshape(9, len(points), 3, -1)
    low = (i != 2) & (points[:, i] < 2 * step)
    high = (i == 3) & (points[:, i] + 2 * step > 1)
    weights = np.where(low, upwards[:, None], both_sides[:, None])
    weights = np.where(high, -upwards[::-1, None], weights)
    return np.sum(weights[:, :, None, None] * found, axis=0) / (12 * step[:, None, None])


def steps(points):
    """As long as the scale on which the light changes allows; (point, argument)."""
    a, b, g, cosine, rho, t = points.T
    return np.stack(
        [
            2e-3 * np.maximum(a, np.minimum(0.02, 1 / (3 * t * (1 + t)))),
            2e-3 * np.maximum(b, np.minimum(0.02, 1 / t)),
            np.full_like(g, 1e-4),
            1e-4 * cosine,
            np.full_like(rho, 1e-3),
            5e-4 * t,
        ],
        axis=1,
    )


def check_double(points):
    found, slope, along = (np.asarray(v) for v in both(jnp.asarray(points), SHARES))
    assert np.isfinite(found).all()
    assert np.isfinite(slope).all()
    assert np.isfinite(along).all()
    a, b, _, cosine, rho, t = (v[:, None] for v in points.T)
    down, up, scalar = np.moveaxis(found, 1, 0)
    # Gershun: what the net flux loses is absorbed.
    lost = -(along[:, 0] - along[:, 1])
    np.testing.assert_allclose(lost, a * t * scalar, atol=2e-9, rtol=1e-7)
    np.testing.assert_allclose(up[:, -1:], rho * down[:, -1:], atol=1e-13)
    free = (a == 0)[:, 0]
    assert free.any()
    np.testing.assert_allclose(
        (down[:, -1] - up[:, -1] + up[:, 0])[free], cosine[free, 0], rtol=1e-9
    )
    empty = (b == 0)[:, 0] & (points[:, 4] == 0)
    assert empty.any()
    beer = cosine * np.exp(-a * t * np.asarray(SHARES) / cosine)
    np.testing.assert_allclose(down[empty], beer[empty], rtol=1e-12)
    # One layer or two of the same.
    cut = np.asarray(halves(jnp.asarray(points), SHARES))
    np.testing.assert_allclose(cut, found, rtol=1e-8, atol=1e-11)
    return found, slope


def check_slopes(points, slope):
    for i, step in enumerate(steps(points).T):
        quotient = differences(points, i, step)
        scale = np.abs(quotient).max(axis=2, keepdims=True)
        noise = 2e-15 / step[:, None, None]
        gap = np.abs(slope[..., i] - quotient)
        assert (gap <= 1e-6 * scale + noise + 1e-9).all(), points[gap.argmax() // gap[0].size]


@pytest.mark.slow
@pytest.mark.parametrize("first", range(11))
def test_every_eleventh_point_of_the_grid(first):
    """Every water, asymmetry, sun, floor and thickness is among them (65 or 66 of 720)."""
    points = grid()[first::11]
    assert [len(np.unique(column)) for column in points.T] == [5, 4, 4, 3, 2, 5]
    _, slope = check_double(points)
    check_slopes(points, slope)
