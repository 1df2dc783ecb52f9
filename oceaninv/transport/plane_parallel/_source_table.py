"""Source functions tabulated in depth, so that many lines of sight share them.

The light that the diffuse field scatters into a direction is a sum over azimuth orders and Legendre
degrees whose coefficients depend on depth alone.  They are computed at knots.  Between knots, their
ratio to the scalar irradiance and its logarithm are taken as linear in optical depth, for which the
integral against the attenuation is exact.  A line of sight costs one product of
matrices instead of one set of matrix functions per order.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation.quadrature import Basis
from oceaninv.transport.plane_parallel import _layer_modes
from oceaninv.transport.plane_parallel._column import Column
from oceaninv.transport.plane_parallel._line_of_sight import Sight
from oceaninv.transport.plane_parallel._matrix_functions import mean_decay

_NEAR = 0.02  # optical depth from which knots of endless water are spaced geometrically
_DECAYS = 20.0  # of the slowest mode, over which knots of endless water reach
_FAR = 1e4  # optical depth beyond which none lies


class Table(NamedTuple):
    """Sources of one wavelength; axes (layer, knot, ...)."""

    depth: Array  # (layer, knot) optical, delta-scaled
    scalar: Array  # (layer, knot) logarithm of the diffuse scalar irradiance over 2 pi
    source: Array  # (layer, knot, order, moment) over the scalar irradiance


def tabulate(columns: Column, bases: Basis, count: int, endless: bool) -> Table:
    """Table with `count` knots per layer; leading axes of `columns` (order, wl), of the result
    (wl,)."""
    shares = jax.vmap(lambda column: _shares(column, count, endless))(
        jax.tree.map(lambda leaf: leaf[0], columns)
    )
    over_layers = jax.vmap(_moments, (0, 0, 0, 0, None, 0))
    over_wavelength = jax.vmap(over_layers, (0, 0, 0, 0, None, 0))
    over_order = jax.vmap(over_wavelength, (0, 0, 0, 0, 0, None), out_axes=3)
    leaves = (columns.layer, columns.modes, columns.beam, columns.field)
    moments = over_order(*leaves, bases, shares)  # (wl, layer, knot, order, moment)
    mean = jax.tree.map(lambda leaf: leaf[0], columns)
    depth = mean.start[..., None] + shares * mean.layer.depth[..., None]
    tiny = float(np.finfo(depth.dtype).tiny)
    scalar = jnp.maximum(moments[..., 0, 0], tiny)
    gain = mean.layer.gain[:, :, None, None, :] / 2
    return Table(depth, jnp.log(scalar), gain * moments / scalar[..., None, None])


def _shares(column: Column, count: int, endless: bool) -> Float[Array, "layer knot"]:
    """Places of the knots in each layer: dense at its ends, where light changes fast."""
    x = np.linspace(0.0, 1.0, count)
    depth = column.layer.depth
    both = jnp.asarray((1 - np.cos(np.pi * x)) / 2, dtype=depth.dtype)
    shares = jnp.tile(both, (depth.shape[0], 1))
    if endless:
        slowest = jnp.sqrt(jnp.maximum(jnp.min(column.modes.k2[-1]), (_DECAYS / _FAR) ** 2))
        growth = jnp.log(1 + _DECAYS / slowest / _NEAR)
        below = _NEAR * jnp.expm1(growth * jnp.asarray(x, dtype=depth.dtype))
        shares = shares.at[-1].set(jax.lax.stop_gradient(below / depth[-1]))
    return shares


def _moments(layer, modes, beam, field, basis: Basis, shares) -> Float[Array, "knot moment"]:
    """Integral of p_l times the diffuse radiance over the cosine, by l."""

    def at(share):
        down, up = _layer_modes.inside(share, layer, modes, beam, field)
        root_mu = jnp.sqrt(basis.mu)
        even = basis.even.T @ (basis.turn @ ((down + up) / root_mu))
        odd = basis.odd.T @ ((down - up) / root_mu)
        both = jnp.stack([even, odd], axis=1).reshape(-1)
        # From l - m = 0, 1, ... to l = 0, 1, ...: what wraps around is 0.
        return jnp.roll(both, basis.order)

    return jax.vmap(at)(shares)


def seen(
    table: Table, here: Float[Array, ""], sight: Sight, angular: Float[Array, "order moment"]
) -> Float[Array, ""]:
    """Light scattered from the diffuse field into a line of sight, at one wavelength.

    `here`: optical depth of the eye; `angular`: cos(m phi) p_l of the direction of the light.
    """
    source = jnp.tensordot(table.source, angular, 2)
    low, high = table.depth[:, :-1], table.depth[:, 1:]
    first = jnp.where(sight.up, jnp.maximum(low, here), low)
    last = jnp.where(sight.up, high, jnp.minimum(high, here))
    length = jnp.maximum(last - first, 0.0)
    width = high - low
    width = jnp.where(width > 0, width, 1.0)
    near, far = jnp.where(sight.up, first, last), jnp.where(sight.up, last, first)
    rise = (table.scalar[:, 1:] - table.scalar[:, :-1]) / width
    slope = (source[:, 1:] - source[:, :-1]) / width
    light = jnp.exp(table.scalar[:, :-1] + rise * (near - low) - jnp.abs(near - here) / sight.mu)
    start = source[:, :-1] + slope * (near - low)
    change = slope * (far - near)
    away = jnp.where(sight.up, 1.0, -1.0)
    x = (1 / sight.mu - away * rise) * length
    mean, moment = _decays(x)
    lit = length > 0
    each = jnp.where(lit, light, 0.0) * length * (start * mean + change * moment)
    return jnp.sum(each) / sight.mu


def _decays(x):
    """Integrals of e^(-x u) and of u e^(-x u) over 0 <= u <= 1, for x of either sign."""
    small = jnp.abs(x) < 0.05
    safe = jnp.where(small, 1.0, x)
    mean = mean_decay(x)
    moment = jnp.where(
        small, 0.5 - x / 3 + x**2 / 8 - x**3 / 30 + x**4 / 144, (mean - jnp.exp(-safe)) / safe
    )
    return mean, moment
