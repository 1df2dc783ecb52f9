"""Light fields whose derivatives are found band by band.

Of elastic light a band depends on the water of that band alone, and a ray or depth on its own
distance: changing all bands, or all distances, together tells the derivative of each.  A derivative
in many unknowns then takes as many passes through the light field as there are rows of optical
properties that they change (five or so), not as many as unknowns.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

import oceaninv as oi
from oceaninv.transport.base import AbstractTransport


def _basis(leaves: list) -> tuple:
    """Of each leaf (leaf, ...) ones in its own turn, zeros in the others'."""
    eye = jnp.eye(len(leaves), dtype=leaves[0].dtype)
    return tuple(
        jnp.broadcast_to(
            eye[:, k].reshape(-1, *[1] * leaf.ndim).astype(leaf.dtype), (len(leaves), *leaf.shape)
        )
        for k, leaf in enumerate(leaves)
    )


def _bandwise(function):
    """The derivative of `function` (rows, numbers, own, rest) -> (n, wl) by as few passes as it
    has arguments: `rows` a tuple of (wl,), `numbers` a tuple of scalars, `own` (n,)."""

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
        # One pass after the other: side by side, what they share would be computed in each.
        value, linear = jax.linearize(of, *here)
        slopes = jax.lax.map(lambda push: linear(*push), _basis(list(here)))
        # As a product of matrices: in one of elements the compiler would repeat the light field for
        # every unknown (XLA on a CPU fuses what makes an element into each of its uses).
        shape = slopes.shape
        pushes = jnp.stack([jnp.broadcast_to(moves[k], shape[1:]) for k in live])
        return value, jnp.einsum("knw,knw->nw", slopes, pushes)

    return wrapped


def _scene(rows, phases, zenith) -> oi.Scene:
    grid, shapes = phases
    water = oi.IOPs(grid, rows[0][None, :], jnp.stack(rows[1:]), shapes)
    return oi.Scene(water, oi.Light(zenith, jnp.ones_like(rows[0])), oi.FlatSurface())


@_bandwise
def _radiance(rows, numbers, own, rest):
    transport, phases, direction = rest
    zenith, depth = numbers
    zero = jnp.zeros_like(depth)
    rays = oi.Rays(jnp.stack([zero, zero, depth]), direction, own)
    return transport.radiance(_scene(rows, phases, zenith), rays, None).value


@_bandwise
def _irradiance(rows, numbers, own, rest):
    transport, phases = rest
    return transport.irradiance(_scene(rows, phases, numbers[0]), own, None).Ed.value


def _parts(scene: oi.Scene):
    water = scene.water
    assert isinstance(water, oi.IOPs)
    return (water.a, *water.b_components), (water.grid, water.phases)


def path_radiance(
    scene: oi.Scene,
    depth: Float[Array, ""],
    direction: Float[Array, "ray 3"],
    distance: Float[Array, " ray"],
    transport: AbstractTransport,
) -> Float[Array, "ray wl"]:
    """Light that the water sends along each line of sight to an eye at `depth`, within `distance`.

    Of one water lit by the sun alone under a flat surface; without derivative in `direction`.
    """
    rows, phases = _parts(scene)
    numbers = (scene.light.zenith, depth)
    found = _radiance(rows, numbers, distance, (transport, phases, direction))
    return found * scene.light.direct[None, :]


def downward(
    scene: oi.Scene, depths: Float[Array, " depth"], transport: AbstractTransport
) -> Float[Array, "depth wl"]:
    """Ed at depths, of one water lit by the sun alone under a flat surface."""
    rows, phases = _parts(scene)
    found = _irradiance(rows, (scene.light.zenith,), depths, (transport, phases))
    return found * scene.light.direct[None, :]
