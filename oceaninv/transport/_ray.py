"""Radiance along a line of sight: the source function of a solved column, integrated exactly.

Between two depths of a layer u and v are known functions of depth, so that their integral against
e^(-s/mu) is one more function of B: no radiance is ever interpolated between nodes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv._quadrature import Basis
from oceaninv.transport import _discrete_ordinates as do
from oceaninv.transport import _matrix_functions as mf
from oceaninv.transport._column import Column

_EMPTY = 1e-12  # optical length added to every stretch, so that none is 0


class Sight(NamedTuple):
    """One line of sight from depth z (m) to the surface, the floor or endless depth."""

    z: Array  # () m
    mu: Array  # () |cosine| > 0
    up: Array  # () bool: the light travels up, the eye looks down


class Stretch(NamedTuple):
    """What of it lies in each layer; leading axis for layers."""

    share: Array  # of the layer, at the end nearer to the eye
    length: Array  # optical, vertical
    top: Array  # optical depth of the upper end
    clear: Array  # transmittance from there to the eye


def _shares(column: Column, z: Float[Array, ""]) -> Float[Array, "layer"]:
    """What of each layer lies above depth z (m)."""
    return jnp.clip((z - column.top) * column.rate, 0.0, 1.0)


def depth_of(column: Column, z: Float[Array, ""]) -> Float[Array, ""]:
    """Optical depth (delta-scaled) of depth z (m)."""
    return column.start[0] + jnp.sum(_shares(column, z) * column.layer.depth)


def stretches(column: Column, sight: Sight) -> tuple[Stretch, Float[Array, ""]]:
    """The stretches of a sight, and the transmittance to the surface or floor at its end."""
    depth, start = column.layer.depth, column.start
    share = _shares(column, sight.z)
    here = depth_of(column, sight.z)
    length = jnp.where(sight.up, 1 - share, share) * depth
    top = start + jnp.where(sight.up, share * depth, 0.0)
    near = jnp.where(sight.up, top, top + length)
    clear = jnp.exp(-jnp.abs(near - here) / sight.mu)
    out = jnp.exp(-jnp.sum(length) / sight.mu)
    return Stretch(share, length + _EMPTY, top, clear), out


def single_scattering(
    column: Column,
    sight: Sight,
    vsf: Float[Array, "layer"],
    sun: Float[Array, ""],
    cosine: Float[Array, ""],
) -> Float[Array, ""]:
    """Sunlight scattered once, by the exact volume scattering function (1/m/sr), in the
    delta-scaled water (Nakajima & Tanaka 1988, the method TMS)."""
    path, _ = stretches(column, sight)
    nu, rate = 1 / cosine, 1 / sight.mu
    down = mf.mean_decay_between(nu * path.length, rate * path.length)
    both = jnp.where(sight.up, mf.mean_decay((nu + rate) * path.length), down)
    light = sun * jnp.exp(-nu * path.top) * path.clear * path.length * rate
    return jnp.sum(light * both * vsf / column.layer.extinction)


def multiple_scattering(
    column: Column, basis: Basis, sight: Sight, angular: Float[Array, "moment"]
) -> Float[Array, ""]:
    """Light scattered from the diffuse field of one azimuth order; `angular` is p_l(mu)."""
    path, _ = stretches(column, sight)

    def one(layer, modes, beam, field, share, length, top):
        near = do.inside(share, layer, modes, beam, field)
        far_down = jnp.where(sight.up, field.bottom_down, field.top_down)
        far_up = jnp.where(sight.up, field.bottom_up, field.top_up)

        def project(down, up):
            return jnp.stack([modes.inverse @ (down + up), modes.factor.T @ (down - up)], axis=1)

        # The source at the top of the stretch, not of the layer.
        light = jnp.exp(-beam.nu * jnp.where(sight.up, share, 0.0) * layer.depth)
        forcing = do.forcing(modes, beam) * light
        vectors = jnp.stack([project(*near), project(far_down, far_up), forcing])
        parameters = (length, 1 / sight.mu, beam.nu, sight.up)
        total = mf.apply_functions(mf.forced_seen, modes.k2, modes.matrix, parameters, vectors)
        sums, differences = jnp.sum(total[..., 0], axis=0), jnp.sum(total[..., 1], axis=0)
        return scattered(layer, modes, basis, sight, angular, sums, differences)

    leaves = (column.layer, column.modes, column.beam, column.field)
    each = jax.vmap(one)(*leaves, path.share, path.length, path.top)
    return jnp.sum(each * path.clear)


def scattered(
    layer: do.Layer, modes: do.Modes, basis: Basis, sight: Sight, angular, sums, differences
) -> Float[Array, ""]:
    """What is scattered into a line of sight, given the integrals of u and v along it."""
    gain = basis.from_order(layer.gain * angular) / (2 * sight.mu)
    root_mu = jnp.sqrt(basis.mu)
    even = (basis.turn @ (basis.even @ gain[0::2])) / root_mu
    odd = (basis.odd @ gain[1::2]) / root_mu
    scattered_even = even @ (modes.factor @ sums)
    scattered_odd = odd @ (modes.inverse.T @ differences)
    return jnp.where(sight.up, scattered_even - scattered_odd, scattered_even + scattered_odd)
