"""One column of water at one wavelength and azimuth order: solve it, and look inside."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv.foundation.quadrature import Basis
from oceaninv.transport.plane_parallel import _boundary_values, _layer_modes

# Optical thickness of water without a floor.  Light returns from there only where a/c < 1e-11.
ENDLESS = 1e6


class Water(NamedTuple):
    """Optical properties of the layers at one wavelength, top first."""

    absorption: Array  # (layer,) 1/m
    moments: Array  # (layer, moment + 1) b chi_l, 1/m; the last is the truncated peak
    thickness: Array  # (layer,) m, or (layer - 1,) if the last is endless


class Sources(NamedTuple):
    """The light that enters, for one azimuth order."""

    cosine: Array  # () of the sunbeam in the water
    sun: Array  # () irradiance normal to the beam, below the surface
    angular: Array  # (moment,) p_l(cosine), times 2 if m > 0
    sky: Array | None  # (n,) radiance entering at the nodes
    surface: Array | None  # (n,) reflectance from below
    floor: Array | None  # () reflectance of the floor


class Column(NamedTuple):
    """A solved column; every leaf has a leading axis for the layers."""

    layer: _layer_modes.Layer
    modes: _layer_modes.Modes
    beam: _layer_modes.Beam
    field: _layer_modes.Field
    top: Array  # (layer,) m
    rate: Array  # (layer,) share of the layer per metre
    start: Array  # (layer,) optical depth of the top


def solve(water: Water, sources: Sources, basis: Basis) -> Column:
    """The diffuse light field of a column."""
    endless = sources.floor is None
    thickness = water.thickness
    one = jnp.ones((1,), dtype=thickness.dtype)
    padded = jnp.concatenate([thickness, one]) if endless else thickness
    layer = jax.vmap(_layer_modes.scale_layer)(water.absorption, water.moments, padded)
    rate = 1 / padded
    if endless:
        layer = layer._replace(depth=layer.depth.at[-1].set(ENDLESS))
        rate = rate.at[-1].set(layer.extinction[-1] / ENDLESS)
    modes = jax.vmap(_layer_modes.layer_modes, (0, None))(layer, basis)
    nu = 1 / sources.cosine
    start = jnp.concatenate([0 * one, jnp.cumsum(layer.depth)[:-1]])

    def sunlit(layer, modes, start):
        light = sources.sun * jnp.exp(-nu * start)
        return _layer_modes.beam_source(layer, modes, basis, sources.angular * light, nu)

    beam = jax.vmap(sunlit)(layer, modes, start)
    floor = None if endless else _floor(sources, basis, layer.depth[-1] + start[-1])
    sky = None if sources.sky is None else basis.flux * sources.sky
    stack, bounds = (layer, modes, beam), (floor, sources.surface, sky)
    field = _boundary_values.solve(stack, bounds, endless and start.shape[0] == 1)
    top = jnp.concatenate([0 * one, jnp.cumsum(padded)[:-1]])
    return Column(layer, modes, beam, field, top, rate, start)


def _floor(sources, basis, depth):
    """A Lambertian floor sends light to azimuth order 0 only."""
    share = jnp.where(basis.order == 0, sources.floor, jnp.zeros_like(sources.floor))
    flux = sources.cosine * sources.sun * jnp.exp(-depth / sources.cosine)
    return _layer_modes.Wall(2 * share, basis.flux, basis.flux * (share * flux / jnp.pi))


def locate(column: Column, z: Float[Array, ""], *more) -> tuple:
    """The layer at depth z (m), z's share of it, and the same layer of further trees."""
    index = 0 if column.top.shape[0] == 1 else jnp.sum(z > column.top[1:])
    here, *others = jax.tree.map(lambda leaf: leaf[index], (column, *more))
    share = (z - here.top) * here.rate
    # Deeper than endless there is no light, and no exponential that grows instead.  The lower edge
    # itself keeps its slope, whatever its rounding.
    beyond = share > 1.0 + 16.0 * float(jnp.finfo(share.dtype).eps)
    return here, jnp.where(beyond, 1.0, share), *others


def within(
    here: Column, share: Float[Array, ""]
) -> tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, ""]]:
    """Diffuse light (down, up) in y at a share of one layer, and the optical depth of it."""
    down, up = _layer_modes.inside(share, here.layer, here.modes, here.beam, here.field)
    return down, up, here.start + share * here.layer.depth


def slope_at(
    here: Column, share: Float[Array, ""], down: Float[Array, "n"], up: Float[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """d(down, up)/dz (1/m) of a layer's diffuse light, by the transfer equation itself."""
    beam = here.beam
    left = jnp.exp(-beam.nu * share * here.layer.depth)
    return _layer_modes.slope(here.layer, here.modes, down, up, left * beam.even, left * beam.odd)
