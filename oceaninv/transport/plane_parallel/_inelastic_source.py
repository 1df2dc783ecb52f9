"""Light that inelastic processes emit in the water, for one wavelength and azimuth order.

The source of a layer is proportional to the light that excites it.  It is fitted by a sum of
exponentials of depth, with rates in geometric steps, by least squares at depths that are graded in
the same way.  Each exponential is then solved as exactly as the sunbeam, by the same functions.
Over a floor a second set decays upwards: the same problem seen from below, in which down and up,
and with them the sign of odd functions of direction, are exchanged.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation.quadrature import Basis
from oceaninv.transport.plane_parallel import _adding, _column, _layer_modes, _line_of_sight
from oceaninv.transport.plane_parallel import _matrix_functions as mf

# Rates from half the slowest to 10^4 times as fast, and 1.5 depths for each.
_RATES, _RANGE = 56, 1e4
_DEPTHS = 85  # odd
_REACH = 20.0  # depth of the grid in endless water, in decay lengths of the slowest exponential
DEGREES = 3  # Legendre degrees of an emission: isotropic, or as of a dipole


class Grid(NamedTuple):
    """Depths of a layer and the exponentials fitted at them; derivatives do not pass through."""

    below: Array  # (depth,) m below the top of the layer
    rate: Array  # (rate,) 1/m
    weight: Array  # (depth,) divisor of the values before the fit
    fit: Array  # (2 rate, depth): exponentials that decay downwards, then those upwards


class Glow(NamedTuple):
    """The sources of a layer: exponentials that decay downwards, and upwards."""

    down: _layer_modes.Beam  # leading axis (rate,); in `nu` per optical depth
    up: _layer_modes.Beam
    radiance: Array  # (degree, 2 rate) source of radiance per optical depth, by p_l


class Column(NamedTuple):
    """The emitted light of a column; leading axis for layers."""

    glow: Glow
    field: _layer_modes.Field


def grid(slowest: Float[Array, ""], thickness: Float[Array, ""] | None) -> Grid:
    """Depths and rates for a layer (`thickness` None: endless) in which no excitation decays more
    slowly than `slowest` (1/m)."""
    dtype = slowest.dtype
    steps = jnp.asarray(np.geomspace(0.5, _RANGE, _RATES), dtype=dtype)
    graded = np.geomspace(0.05 / _RANGE, 1.0, _DEPTHS - 1)
    if thickness is None:
        rate, both = slowest * steps, 0.0
        below = jnp.asarray(np.concatenate([[0.0], graded]) * _REACH, dtype=dtype) / slowest
    else:
        # In a thin layer slower exponentials cannot be told apart.
        rate, both = jnp.maximum(slowest, 1 / thickness) * steps, 1.0
        half = np.concatenate([[0.0], graded[::2] / 2])
        share = jnp.asarray(np.concatenate([half, 1 - half[-2::-1]]), dtype=dtype)
        below = share * thickness
    weight = jnp.exp(-slowest * below)
    falling = jnp.exp(-jnp.outer(below, rate))
    above = below if thickness is None else thickness - below
    rising = both * jnp.exp(-jnp.outer(above, rate))
    design = jnp.concatenate([falling, rising], axis=1) / weight[:, None]
    left, values, right = jnp.linalg.svd(design, full_matrices=False)
    kept = values > 1e3 * float(jnp.finfo(dtype).eps) * values[0]
    inverse = jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)
    return jax.tree.map(
        jax.lax.stop_gradient, Grid(below, rate, weight, (right.T * inverse[None, :]) @ left.T)
    )


def moments(basis: Basis, down, up) -> Float[Array, "degree"]:
    """2 pi times the integral of p_l I over the sphere, of light (down, up) in y."""
    root_mu = jnp.sqrt(basis.mu)
    even = basis.even.T @ (basis.turn @ ((down + up) / root_mu))
    odd = basis.odd.T @ ((down - up) / root_mu)
    both = jnp.stack([even, odd], axis=1).reshape(-1)[:DEGREES]
    # From l - m = 0, 1, ... to l = 0, 1, ...: elements that wrap around have l < m and are 0.
    return (
        2 * np.pi * jnp.where(jnp.arange(DEGREES) >= basis.order, jnp.roll(both, basis.order), 0.0)
    )


def excitation(
    column: _column.Column, basis: Basis, sun, angular, below
) -> Float[Array, "depth degree"]:
    """Moments of the light, sunbeam included, at depths (m) below the top of one layer of a column;
    `sun` and `angular` as in `_column.Sources`."""

    def at(z):
        share = z * column.layer.extinction / column.layer.depth
        parts = (column.layer, column.modes, column.beam, column.field)
        depth = column.start + share * column.layer.depth
        beam = sun * jnp.exp(-column.beam.nu * depth)
        return moments(basis, *_layer_modes.inside(share, *parts)) + beam * angular[:DEGREES]

    return jax.vmap(at)(below)


def emitted(
    layer: _layer_modes.Layer,
    modes: _layer_modes.Modes,
    glow: Glow,
    field: _layer_modes.Field,
    basis: Basis,
    below,
) -> Float[Array, "depth degree"]:
    """The same for light that was itself emitted."""

    def at(z):
        share = z * layer.extinction / layer.depth
        return moments(basis, *inside(share, layer, modes, glow, field))

    return jax.vmap(at)(below)


def glow(
    layer: _layer_modes.Layer,
    modes: _layer_modes.Modes,
    basis: Basis,
    grid: Grid,
    source: Float[Array, "depth degree"],
) -> Glow:
    """Fit a source: power per volume and p_l at the depths of the grid (1/m times irradiance)."""
    amplitude = (grid.fit @ (source / grid.weight[:, None])).T / (4 * np.pi * layer.extinction)
    # As in `_layer_modes.beam_source`, with down + up for one direction.
    moments = 2 * basis.even.shape[1]
    doubled = jnp.pad(2 * amplitude.T, [(0, 0), (0, moments - DEGREES)])
    doubled = jax.vmap(basis.from_order)(doubled)
    root_mu = jnp.sqrt(basis.mu)[None, :]
    even = (doubled[:, 0::2] @ basis.even.T) @ basis.turn / root_mu
    odd = (doubled[:, 1::2] @ basis.odd.T) / root_mu
    even, odd = even @ modes.factor, odd @ modes.inverse.T
    n = grid.rate.shape[0]
    nu = grid.rate / layer.extinction
    return Glow(
        _layer_modes.Beam(even[:n], odd[:n], nu),
        _layer_modes.Beam(even[n:], -odd[n:], nu),
        amplitude,
    )


def solve(
    layers: _layer_modes.Layer,
    modes: _layer_modes.Modes,
    glows: Glow,
    basis: Basis,
    sources: _column.Sources,
) -> Column:
    """The field of the light that all layers (leading axis) emit, between floor and surface."""
    endless = sources.floor is None and layers.depth.shape[0] == 1

    def respond(layer, modes, glow):
        def apply(functions, vectors, *more):
            parameters = (layer.depth, *more)
            return mf.apply_functions(functions, modes.k2, modes.matrix, parameters, vectors)

        own = _layer_modes.operators(
            modes, lambda m: apply(mf.endless if endless else mf.through, m), endless
        )

        def leaving(beam):
            both = jnp.stack([beam.even, beam.odd], axis=1)
            vectors = jnp.stack([both] * (2 if endless else 3))
            response = apply(mf.forced_endless if endless else mf.forced, vectors, beam.nu)
            sent = _layer_modes.leaving(layer, modes, beam, own, response)
            return sent.up, sent.down

        up, down = (jnp.sum(v, axis=0) for v in jax.vmap(leaving)(glow.down))
        if not endless:
            mirrored = (jnp.sum(v, axis=0) for v in jax.vmap(leaving)(glow.up))
            up, down = (v + w for v, w in zip((up, down), reversed(tuple(mirrored)), strict=True))
        return _layer_modes.Slab(own.reflect, own.transmit, up, down)

    slabs = jax.vmap(respond)(layers, modes, glows)
    upper = None
    if layers.depth.shape[0] > 1:
        upper = jax.tree.map(lambda leaf: leaf[:-1], slabs)
    lowest = jax.tree.map(lambda leaf: leaf[-1], slabs)
    floor = None
    if sources.floor is not None:
        share = jnp.where(basis.order == 0, sources.floor, jnp.zeros_like(sources.floor))
        floor = _layer_modes.Wall(2 * share, basis.flux, 0 * basis.flux)
    return Column(glows, _adding.add_layers(upper, lowest, floor, sources.surface, None))


def inside(
    share: Float[Array, ""],
    layer: _layer_modes.Layer,
    modes: _layer_modes.Modes,
    glow: Glow,
    field: _layer_modes.Field,
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Emitted light (down, up) in y at a share of the way from top to bottom of a layer."""
    down, up = _layer_modes.inside(share, layer, modes, None, field)

    def own(beams, share):
        """Light that meets nothing at top and bottom: sums and differences of down and up."""
        source = jax.vmap(_layer_modes.forcing, (None, 0))(modes, beams)
        parameters = (layer.depth, share, beams.nu)
        return mf.combine(_inside, modes.k2, modes.matrix, parameters, source)

    first, second = own(glow.down, share), own(glow.up, 1 - share)
    sum_ = modes.factor @ (first[:, 0] + second[:, 0])
    difference = modes.inverse.T @ (first[:, 1] - second[:, 1])
    return down + (sum_ + difference) / 2, up + (sum_ - difference) / 2


def _inside(k, t, share, nu):
    return jax.vmap(lambda nu: mf.forced_inside(k, t, share, nu)[2])(nu)


def _seen(k, t, rate, nu, along):
    return jax.vmap(lambda nu: mf.forced_seen(k, t, rate, nu, along)[2])(nu)


def slope_at(
    here: _column.Column, glow: Glow, share: Float[Array, ""], down, up
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """d(down, up)/dz (1/m) of a layer's emitted light; see `_column.slope_at`."""

    def total(beams, share):
        left = jnp.exp(-beams.nu * share * here.layer.depth)
        return left @ beams.even, left @ beams.odd

    falling, rising = total(glow.down, share), total(glow.up, 1 - share)
    even, odd = falling[0] + rising[0], falling[1] - rising[1]
    return _layer_modes.slope(here.layer, here.modes, down, up, even, odd)


def along(
    column: _column.Column,
    emitted: Column,
    basis: Basis,
    sight: _line_of_sight.Sight,
    angular: Float[Array, "moment"],
) -> Float[Array, ""]:
    """Emitted light that a line of sight gathers, scattered or not; `angular` is p_l(mu)."""
    path, _ = _line_of_sight.stretches(column, sight)
    rate = 1 / sight.mu
    odd = (jnp.arange(DEGREES) + basis.order) % 2 == 1
    turned = jnp.where(odd & sight.up, -1.0, 1.0) * angular[:DEGREES]

    def one(layer, modes, glow, field, share, length):
        near = inside(share, layer, modes, glow, field)
        far_down = jnp.where(sight.up, field.bottom_down, field.top_down)
        far_up = jnp.where(sight.up, field.bottom_up, field.top_up)

        def project(down, up):
            return jnp.stack([modes.inverse @ (down + up), modes.factor.T @ (down - up)], axis=1)

        def combine(functions, vectors, *more):
            parameters = (length, rate, *more)
            return mf.combine(functions, modes.k2, modes.matrix, parameters, vectors)

        def own(beams, outside, along):
            """`outside`: share of the layer between where the source is 1 and the stretch."""
            light = jnp.exp(-beams.nu * outside * layer.depth)
            source = jax.vmap(_layer_modes.forcing, (None, 0))(modes, beams) * light[:, None, None]
            reach = beams.nu * length
            straight = mf.mean_decay_between(beams.nu, jnp.full_like(reach, rate), length)
            straight = jnp.where(along, mf.mean_decay(reach + rate * length), straight)
            return combine(_seen, source, beams.nu, along), light * straight

        top = jnp.where(sight.up, share, 0.0)
        bottom = jnp.where(sight.up, 0.0, 1 - share)
        falling, straight = own(glow.down, top, sight.up)
        rising, mirrored = own(glow.up, bottom, ~sight.up)
        total = combine(mf.seen, jnp.stack([project(*near), project(far_down, far_up)]))
        sums = total[:, 0] + falling[:, 0] + rising[:, 0]
        differences = total[:, 1] + falling[:, 1] - rising[:, 1]
        scattered = _line_of_sight.scattered(layer, modes, basis, sight, angular, sums, differences)
        direct = (turned @ glow.radiance) @ jnp.concatenate([straight, mirrored])
        return scattered + direct * length * rate

    leaves = (column.layer, column.modes, emitted.glow, emitted.field)
    each = jax.vmap(one)(*leaves, path.share, path.length)
    return jnp.sum(each * path.clear)
