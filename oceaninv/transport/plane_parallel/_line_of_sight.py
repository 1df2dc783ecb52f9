"""Radiance along a line of sight: the source function of a solved column, integrated exactly.

Between two depths of a layer u and v are known functions of depth, so that their integral against
e^(-s/mu) is one more function of B: no radiance is ever interpolated between nodes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation.numerics import gauss_legendre
from oceaninv.foundation.quadrature import Basis
from oceaninv.transport.plane_parallel import _layer_modes
from oceaninv.transport.plane_parallel import _matrix_functions as mf
from oceaninv.transport.plane_parallel._column import Column

_SHARES = gauss_legendre(3, 0.0, 1.0)  # of the path, for (e^x - 1)/x
_EMPTY = 1e-12  # optical length added to every stretch, so that none is 0


class Sight(NamedTuple):
    """One line of sight from depth z (m) to the surface, the floor or endless depth."""

    z: Array  # () m
    mu: Array  # () |cosine| > 0
    up: Array  # () bool: the light travels up, the eye looks down


class Stretch(NamedTuple):
    """The part of a line of sight in each layer; leading axis for layers."""

    share: Array  # of the layer, at the end nearer to the eye
    length: Array  # optical, vertical
    top: Array  # optical depth of the upper end
    clear: Array  # transmittance from there to the eye


def _shares(column: Column, z: Float[Array, ""]) -> Float[Array, "layer"]:
    """The share of each layer that lies above depth z (m)."""
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
    moments: Float[Array, "layer moment"],
    polynomials: Float[Array, "moment"],
    vsf: Float[Array, "layer"],
    sun: Float[Array, ""],
    cosine: Float[Array, ""],
) -> Float[Array, ""]:
    """Sunlight scattered once, and any number of further times within the forward peak.

    `moments`: b chi_l, 1/m, of more degrees than the column has; `polynomials`: P_l of the angle
    between sun and sight; `vsf`: the exact volume scattering function there, 1/m/sr.

    With the exact function in the column's water (the TMS method of Nakajima & Tanaka 1988) all of
    it would reach great depths without blur.  Here the peak that the column treats as unscattered
    light blurs it: at small angles each degree has its own attenuation, e^(-(c - b chi_l) s)
    (Snyder & Dash 1949).  This is all the light of degrees L and above, which the column leaves
    out; for lower degrees the column holds the light scattered twice or more.  Away
    from the sun the method is TMS; within some 30 degrees it is right to 1e-3 where TMS errs by
    some percent (their IMS is its second order).
    """
    path, _ = stretches(column, sight)
    nu, rate = 1 / cosine, 1 / sight.mu
    layer = column.layer
    # Per optical depth of the column, not per metre: in endless vacuum even the derivatives of
    # metres are beyond single precision.
    moments, vsf = moments / layer.extinction[:, None], vsf / layer.extinction

    def seen(extinction):
        """Light per unit of scattering, (layer,), for an attenuation (layer,)."""
        whole, part = extinction * layer.depth, extinction * path.length
        start = jnp.pad(jnp.cumsum(whole)[:-1], (1, 0))
        top = start + jnp.where(sight.up, path.share * whole, 0.0)
        near = jnp.where(sight.up, top, top + part)
        clear = jnp.exp(-jnp.abs(near - jnp.sum(path.share * whole)) * rate)
        down = mf.mean_decay_between(nu, rate, part)
        both = jnp.where(sight.up, mf.mean_decay((nu + rate) * part), down)
        return sun * jnp.exp(-nu * top) * clear * both * path.length * rate

    count, kept = moments.shape[1], layer.gain.shape[1]
    peak, sharp = moments[:, kept], moments[:, kept:]
    full = 1 + peak
    node, node_weight = (jnp.asarray(v, dtype=full.dtype) for v in _SHARES)
    once = seen(full)
    scaled = seen(jnp.ones_like(full))
    partly = jax.vmap(seen)(full[None] - node[:, None] * peak[None])
    # What the column counts as sun has been scattered, all forward: taken off in the degrees that
    # it holds, for it is left out of the others.
    doubled = peak * (scaled - node_weight @ partly)
    own = jax.vmap(jax.vmap(seen, 1, 1))(full[None, :, None] - node[:, None, None] * sharp[None])
    own = jnp.tensordot(node_weight, own, 1)
    low = moments[:, :kept] * (scaled - once)[:, None] - doubled[:, None]
    high = sharp * (own - once[:, None])
    degree = np.arange(count)
    tapered = np.cos(np.pi / 2 * np.clip(2 * degree / count - 1, 0, 1)) ** 2
    weight = jnp.asarray((2 * degree + 1) * tapered / (4 * np.pi), dtype=moments.dtype)
    smooth = jnp.concatenate([low, high], axis=1) @ (weight * polynomials)
    return jnp.sum(once * vsf + smooth)


def multiple_scattering(
    column: Column, basis: Basis, sight: Sight, angular: Float[Array, "moment"]
) -> Float[Array, ""]:
    """Light scattered from the diffuse field of one azimuth order; `angular` is p_l(mu)."""
    path, _ = stretches(column, sight)

    def one(layer, modes, beam, field, share, length, top):
        near = _layer_modes.inside(share, layer, modes, beam, field)
        far_down = jnp.where(sight.up, field.bottom_down, field.top_down)
        far_up = jnp.where(sight.up, field.bottom_up, field.top_up)

        def project(down, up):
            return jnp.stack([modes.inverse @ (down + up), modes.factor.T @ (down - up)], axis=1)

        # The source at the top of the stretch, not of the layer.
        light = jnp.exp(-beam.nu * jnp.where(sight.up, share, 0.0) * layer.depth)
        forcing = _layer_modes.forcing(modes, beam) * light
        vectors = jnp.stack([project(*near), project(far_down, far_up), forcing])
        parameters = (length, 1 / sight.mu, beam.nu, sight.up)
        total = mf.combine(mf.forced_seen, modes.k2, modes.matrix, parameters, vectors)
        sums, differences = total[:, 0], total[:, 1]
        return scattered(layer, modes, basis, sight, angular, sums, differences)

    leaves = (column.layer, column.modes, column.beam, column.field)
    each = jax.vmap(one)(*leaves, path.share, path.length, path.top)
    return jnp.sum(each * path.clear)


def scattered(
    layer: _layer_modes.Layer,
    modes: _layer_modes.Modes,
    basis: Basis,
    sight: Sight,
    angular,
    sums,
    differences,
) -> Float[Array, ""]:
    """Light scattered into a line of sight, given the integrals of u and v along it."""
    gain = basis.from_order(layer.gain * angular) / (2 * sight.mu)
    root_mu = jnp.sqrt(basis.mu)
    even = (basis.turn @ (basis.even @ gain[0::2])) / root_mu
    odd = (basis.odd @ gain[1::2]) / root_mu
    scattered_even = even @ (modes.factor @ sums)
    scattered_odd = odd @ (modes.inverse.T @ differences)
    return jnp.where(sight.up, scattered_even - scattered_odd, scattered_even + scattered_odd)
