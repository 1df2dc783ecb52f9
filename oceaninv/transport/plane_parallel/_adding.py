"""The adding method: layers joined with floor and surface, and the light between them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv.transport.plane_parallel import _layer_modes


class Joined(NamedTuple):
    """Layers joined with floor and surface: the operators that do not depend on sources."""

    reflect: Array | None  # (layer - 1, n, n) of the upper layers, top first; so the next ones
    transmit: Array | None
    below: Array | None  # reflection of all below the layer
    between: Array | None  # (1 - reflect below)^-1
    lowest: _layer_modes.Slab  # sources: none
    floor: tuple | None  # (share, flux, reflect flux share/(1 - share flux . reflect flux))
    surface: Array | None  # (n,)
    opened: Array | None  # (1 - surface reflect)^-1


def join(
    slabs: _layer_modes.Slab | None,
    bottom: _layer_modes.Slab,
    floor: _layer_modes.Wall | None,
    surface: Float[Array, "n"] | None,
) -> Joined:
    """Join layers upwards: `slabs` all but the lowest (stacked, top first), `bottom` the lowest,
    endless if there is no `floor`.  `surface` is the reflectance for light from below."""
    one = jnp.eye(bottom.up.shape[0], dtype=bottom.up.dtype)
    whole, ground = bottom.reflect, None
    if floor is not None:
        returned = bottom.reflect @ floor.flux
        gain = floor.share / (1 - floor.share * (floor.flux @ returned))
        through = bottom.transmit @ floor.flux
        whole = whole + gain * through[:, None] * through[None, :]
        ground = (floor.share, floor.flux, gain * returned)
    reflect = transmit = below = between = None
    if slabs is not None:
        reflect, transmit = slabs.reflect, slabs.transmit

        def add(below, slab):
            between = _layer_modes.inverse_of(one - slab.reflect @ below, False)
            # A homogeneous layer is symmetric, so that it transmits equally upwards.
            whole = slab.reflect + slab.transmit @ below @ between @ slab.transmit
            return whole, (below, between)

        whole, (below, between) = jax.lax.scan(add, whole, slabs, reverse=True)
    opened = None
    if surface is not None:
        opened = _layer_modes.inverse_of(one - surface[:, None] * whole, False)
    return Joined(reflect, transmit, below, between, bottom, ground, surface, opened)


def fill(
    joined: Joined,
    up: Float[Array, "layer n"],
    down: Float[Array, "layer n"],
    returned: Float[Array, "n"] | None,
    sky: Float[Array, "n"],
) -> _layer_modes.Field:
    """The field of given sources: those of layers up and down, of the floor up, of the sky down."""
    lowest, floor = joined.lowest, joined.floor

    def landed(down):
        """Light on the floor, of what comes down to it without returning, and what that returns."""
        assert floor is not None
        assert returned is not None
        share, flux, again = floor
        down = down + lowest.reflect @ returned
        down = down + again * (flux @ down)
        return down, share * flux * (flux @ down) + returned

    above = up[-1]
    if floor is not None:
        above = above + lowest.transmit @ landed(down[-1])[1]
    upper, stages = None, None
    if joined.between is not None:
        upper = (joined.reflect, joined.transmit, joined.below, joined.between)

        def rise(below, stage):
            (reflect, transmit, wall, between), up, down = stage
            landing = between @ (down + reflect @ below)
            return up + transmit @ (below + wall @ landing), below

        above, stages = jax.lax.scan(rise, above, (upper, up[:-1], down[:-1]), reverse=True)
    top = sky
    if joined.opened is not None and joined.surface is not None:
        top = joined.opened @ (sky + joined.surface * above)
    downs, ups, bottoms = [], [], []
    if upper is not None:

        def descend(top, stage):
            (reflect, transmit, wall, between), below, up, down = stage
            landing = between @ (transmit @ top + down + reflect @ below)
            out = reflect @ top + transmit @ (wall @ landing + below) + up
            return landing, (top, out, landing)

        top, parts = jax.lax.scan(descend, top, (upper, stages, up[:-1], down[:-1]))
        for found, part in zip((downs, ups, bottoms), parts, strict=True):
            found.append(part)
    landing = bounced = jnp.zeros_like(top)
    out = lowest.reflect @ top + up[-1]
    if floor is not None:
        landing, bounced = landed(lowest.transmit @ top + down[-1])
        out = out + lowest.transmit @ bounced
    for found, last in zip((downs, ups, bottoms), (top, out, landing), strict=True):
        found.append(last[None])
    top_down, top_up, bottom_down = (jnp.concatenate(p) for p in (downs, ups, bottoms))
    return _layer_modes.Field(
        top_down, top_up, bottom_down, jnp.concatenate([top_up[1:], bounced[None]])
    )


def add_layers(
    slabs: _layer_modes.Slab | None,
    bottom: _layer_modes.Slab,
    floor: _layer_modes.Wall | None,
    surface: Float[Array, "n"] | None,
    sky: Float[Array, "n"] | None,
) -> _layer_modes.Field:
    """Join layers, floor and surface upwards, then compute the light downwards; see `join`.  `sky`
    enters through the surface."""
    joined = join(slabs, bottom, floor, surface)
    up, down = bottom.up[None], bottom.down[None]
    if slabs is not None:
        up, down = (jnp.concatenate(p) for p in ((slabs.up, up), (slabs.down, down)))
    sky = jnp.zeros_like(bottom.up) if sky is None else sky
    return fill(joined, up, down, None if floor is None else floor.source, sky)
