"""Derivatives of light fields by changing all bands at once.

Elastic light of a band depends on the water in that band only, and a ray or irradiance on its own
depth only: one pass that changes all bands, or all depths, gives the derivative of each.  A
derivative in many unknowns then takes as many passes through the light field as there are rows of
optical properties that they change (five or so), not as many as there are unknowns.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

import oceaninv as oi
from oceaninv.transport.base import AbstractTransport, homogeneous
from oceaninv.transport.closed_form._two_moment_field import DeltaScaledWater

# Metres after which a line of sight into open water ends.
_FAR = 1e6
# Least share of diffuse light in scalar irradiance.
_LEAST = 1e-4


def _basis(leaves: list) -> tuple:
    """For each leaf an array (leaf, ...): ones in the row of its own index, zeros in the others."""
    eye = jnp.eye(len(leaves), dtype=leaves[0].dtype)
    return tuple(
        jnp.broadcast_to(
            eye[:, k].reshape(-1, *[1] * leaf.ndim).astype(leaf.dtype), (len(leaves), *leaf.shape)
        )
        for k, leaf in enumerate(leaves)
    )


def _bandwise(function):
    """The derivative of `function` (rows, numbers, own, rest) -> (..., n, wl) by as few passes as
    it has arguments: `rows` a tuple of (wl,), `numbers` a tuple of scalars, `own` (n,)."""

    @eqx.filter_custom_jvp
    def wrapped(rows, numbers, own, rest):
        return function(rows, numbers, own, rest)

    @wrapped.def_jvp
    def rule(primals, tangents):
        if jax.tree.leaves(tangents[3]):
            return eqx.filter_jvp(function, primals, tangents)
        rows, numbers, own, rest = primals
        leaves = [*rows, *numbers, own]
        moves = [
            *(None if move is None else move[None, :] for move in tangents[0]),
            *tangents[1],
            None if tangents[2] is None else tangents[2][:, None],
        ]
        live = [k for k, move in enumerate(moves) if move is not None]

        def of(*moved):
            all_ = leaves.copy()
            for k, leaf in zip(live, moved, strict=True):
                all_[k] = leaf
            return function(tuple(all_[: len(rows)]), tuple(all_[len(rows) : -1]), all_[-1], rest)

        here = tuple(leaves[k] for k in live)
        # One pass after another: in a batch, each would recompute what they share.
        value, linear = jax.linearize(of, *here)
        slopes = jax.lax.map(lambda push: linear(*push), _basis(list(here)))
        # As a matrix product: in an elementwise one, XLA on a CPU would recompute the light field
        # for every unknown, as it fuses the computation of an element into each of its uses.
        shape = slopes.shape
        pushes = jnp.stack([jnp.broadcast_to(moves[k], shape[1:]) for k in live])
        return value, jnp.einsum("k...,k...->...", slopes, pushes)

    return wrapped


def _water(rows, phases) -> oi.IOPs:
    grid, shapes = phases
    return oi.IOPs(grid, rows[0][None, :], jnp.stack(rows[1:]), shapes)


def _scene(rows, phases, zenith) -> oi.Scene:
    return oi.Scene(
        _water(rows, phases), oi.Light(zenith, jnp.ones_like(rows[0])), oi.FlatSurface()
    )


@_bandwise
def _radiance(rows, numbers, own, rest):
    transport, phases, direction = rest
    zero = jnp.zeros_like(own)
    rays = oi.Rays(jnp.stack([zero, zero, own], axis=-1), direction, jnp.full_like(own, _FAR))
    return transport.radiance(_scene(rows, phases, numbers[0]), rays, None).value


@_bandwise
def _irradiance(rows, numbers, own, rest):
    transport, phases = rest
    scene = _scene(rows, phases, numbers[0])
    found = transport.irradiance(scene, own, None)
    mu0, beam = scene.beam()
    lost = DeltaScaledWater(homogeneous(scene)).attenuation.c_star
    sun = beam[None, :] * jnp.exp(-lost[None, :] * own[:, None] / mu0)
    around = jnp.maximum(found.E0.value - sun, _LEAST * found.E0.value)
    return jnp.stack([found.Ed.value, around, sun])


@_bandwise
def _rings(rows, numbers, own, rest):
    grid_and_shapes, radius = rest
    peak_width, board_size = numbers
    water = _water(rows, grid_and_shapes)
    discs = oi.disc_transmission(water, own, radius * board_size, peak_width)
    discs = jnp.swapaxes(discs, 0, 1)
    return jnp.concatenate([discs[:1], jnp.diff(discs, axis=0)])


def ring_transmission(
    water: oi.IOPs,
    distance: Float[Array, " chart"],
    radius: Float[Array, "chart ring"],
    peak_width: Float[Array, ""],
    board_size: Float[Array, ""],
) -> Float[Array, "ring chart wl"]:
    """Share of the light of the rings about a line of sight that arrives.

    - `radius`: m, outer radii; the innermost ring is a disc.  No derivative.
    - `peak_width`: see `oceaninv.disc_transmission`; `board_size`: factor on the radii.
    """
    rows = (water.a, *water.b_components)
    numbers = (peak_width, board_size)
    return _rings(rows, numbers, distance, ((water.grid, water.phases), radius))


def _parts(scene: oi.Scene):
    water = scene.water
    assert isinstance(water, oi.IOPs)
    return (water.a, *water.b_components), (water.grid, water.phases)


def open_radiance(
    scene: oi.Scene,
    depths: Float[Array, " ray"],
    direction: Float[Array, "ray 3"],
    transport: AbstractTransport,
) -> Float[Array, "ray wl"]:
    """Radiance of open water without end along lines of sight from eyes at `depths` (m).

    For one water lit by the sun alone under a flat surface; no derivative in `direction`.
    """
    rows, phases = _parts(scene)
    found = _radiance(rows, (scene.light.zenith,), depths, (transport, phases, direction))
    return found * scene.light.direct[None, :]


def downward(
    scene: oi.Scene, depths: Float[Array, " depth"], transport: AbstractTransport
) -> Float[Array, "3 depth wl"]:
    """Ed, diffuse scalar irradiance, and irradiance normal to the sun's beam, at depths.

    Of one water lit by the sun alone under a flat surface.  Light scattered by less than the
    forward peak's width counts as the sun's.
    """
    rows, phases = _parts(scene)
    found = _irradiance(rows, (scene.light.zenith,), depths, (transport, phases))
    return found * scene.light.direct[None, None, :]
