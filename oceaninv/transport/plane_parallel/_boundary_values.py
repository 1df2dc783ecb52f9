"""The diffuse light at the boundaries of layers, with derivatives by their linear equations.

The light y at the boundaries obeys A y = s, A made of reflections and transmissions.  Its
derivative is A^-1 (ds - dA y): of dA only the product with the known y is needed.  No derivative
of a matrix of reflection or transmission is ever formed.
"""

import functools

import jax
import jax.numpy as jnp

from oceaninv.transport.plane_parallel import _adding, _layer_modes
from oceaninv.transport.plane_parallel import _matrix_functions as mf


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def solve(stack, bounds, endless: bool) -> _layer_modes.Field:
    """The field of layers `stack`: (layer, modes, beam), leading axis for layers, top first;
    between `bounds`: (floor, surface, sky) of `_adding.add_layers`.  `endless`: nothing leaves the
    only one below."""
    return _solve(stack, bounds, endless)[0]


def _solve(stack, bounds, endless, moving=None):
    """`moving`: of depth and nu those (0, 1) that derivatives are taken in, so that the values of
    functions are those of `_effects`: made once."""
    floor, surface, sky = bounds

    def respond(stack):
        layer, modes, beam = stack
        functions = mf.sunlit_endless if endless else mf.sunlit
        parameters = (layer.depth, beam.nu)
        if moving is None:
            values = functions(mf.root(modes.k2), *parameters)
        else:
            values = mf.expand(functions, modes.k2, parameters, moving)[0]
        values = values[:, :, None]
        count = 2 if endless else 5
        own = _layer_modes.operators(modes, lambda matrices: values[:count] * matrices, endless)
        both = jnp.stack([beam.even, beam.odd], axis=1)
        return own, _layer_modes.leaving(layer, modes, beam, own, values[count:] * both[None])

    own, sent = jax.vmap(respond)(stack)
    none = jnp.zeros_like(sent.up)
    bare = _layer_modes.Slab(own.reflect, own.transmit, none, none)
    upper = None if none.shape[0] == 1 else jax.tree.map(lambda v: v[:-1], bare)
    lowest = jax.tree.map(lambda v: v[-1], bare)
    joined = _adding.join(upper, lowest, floor, surface)
    returned = None if floor is None else floor.source
    field = _adding.fill(joined, sent.up, sent.down, returned, none[0] if sky is None else sky)
    return field, joined, own, sent


def _solve_jvp(endless, primals, tangents):
    stack, bounds = primals
    slopes = (tangents[0][0].depth, tangents[0][2].nu)
    moving = [i for i, d in enumerate(slopes) if not mf.is_zero(d)]
    field, joined, own, sent = _solve(stack, bounds, endless, moving)
    # Tangents that vanish cannot be mapped over.
    slopes, tree = jax.tree.flatten(tangents[0], is_leaf=mf.is_zero)

    def missing(known, some):
        left = iter(some)
        every = [d if mf.is_zero(d) else next(left) for d in slopes]
        return _missing(known, jax.tree.unflatten(tree, every), endless)

    some = [d for d in slopes if not mf.is_zero(d)]
    dup, ddown = jax.vmap(missing)((stack, own, sent, field), some)

    def at_bounds(bounds):
        """The light that floor and surface reflect of the known field."""
        floor, surface, sky = bounds
        returned = None
        if floor is not None:
            onto = floor.flux @ field.bottom_down[-1]
            returned = floor.share * floor.flux * onto + floor.source
        entering = jnp.zeros_like(field.top_up[0]) if sky is None else sky
        if surface is not None:
            entering = entering + surface * field.top_up[0]
        return returned, entering

    dreturned, dentering = mf.change(at_bounds, bounds, tangents[1])
    return field, _adding.fill(joined, dup, ddown, dreturned, dentering)


solve.defjvp(_solve_jvp, symbolic_zeros=True)


def _missing(known, tangents, endless):
    """Change of the light that one layer sends up and down, for a change of the layer under
    constant incident light.

    dR = K1 dZ K1 - K2 dY K2 and dT = K1 (dX K2 - dZ T) - T dY K2 with T = K1 X K2.
    """
    stack, own, sent, field = known
    incoming = jnp.stack([field.top_down, field.bottom_up], axis=1)
    entered, turned = own.k2 @ incoming, own.k1 @ incoming
    if endless:
        light = (turned[:, :1], entered[:, :1])
    else:
        light = (turned - (own.transmit @ incoming)[:, ::-1], entered)

    def effects(stack):
        return _effects(stack, sent, light, endless)

    odd, even, through, odd_source, even_source, arriving = mf.change(effects, stack, tangents)
    dsent = own.k2 @ (even_source - even[:, -1]) + own.k1 @ (odd[:, -1] - odd_source)
    if endless:
        up = own.k1 @ odd[:, 0] - own.k2 @ even[:, 0] + dsent
        return up, jnp.zeros_like(up)
    crossed = own.k1 @ (odd[:, :2] + through[:, ::-1])
    crossed = crossed - own.k2 @ even[:, :2] - own.transmit @ even[:, 1::-1]
    ddown = own.k3 @ (arriving + own.csch @ dsent)
    return crossed[:, 0] + dsent, crossed[:, 1] + ddown


def _effects(stack, sent, light, endless):
    """The operators Z, Y and X of a layer on known light, its sources, and (unless `endless`) what
    arrives at its lower boundary."""
    (layer, modes, beam), (turned, entered) = stack, light
    last = jnp.zeros_like(sent.odd)
    into_odd = modes.factor.T @ jnp.concatenate([turned, sent.odd[:, None]], axis=1)
    into_even = modes.inverse @ jnp.concatenate([entered, sent.even[:, None]], axis=1)
    wide = into_odd.shape[1]

    def padded(columns):
        return jnp.pad(columns, [(0, 0), (0, wide - columns.shape[1])])

    both = padded(jnp.stack([beam.even, beam.odd], axis=1))
    if endless:
        vectors, functions = [into_odd, into_even, both, both], mf.sunlit_endless
    else:
        ends = modes.inverse @ jnp.stack([sent.down, sent.up], axis=1)
        below, above = padded(ends[:, :1]), padded(ends[:, 1:])
        vectors = [into_odd, into_even, into_even, below, above, both, both, both]
        functions = mf.sunlit_thin
    parameters = (layer.depth, beam.nu)
    every = mf.apply_functions(functions, modes.k2, modes.matrix, parameters, jnp.stack(vectors))
    odd, even = modes.factor @ every[0], modes.inverse.T @ (modes.matrix @ every[1])
    response = every[2:] if endless else every[5:]
    even_source, odd_source, arriving = _layer_modes.sources(layer, modes, beam, response[..., :2])
    if endless:
        return odd, even, last[:, None], odd_source, even_source, last
    through = modes.factor @ every[2, :, :2]
    arriving = arriving + modes.inverse.T @ (every[4, :, 0] - every[3, :, 0])
    return odd, even, through, odd_source, even_source, arriving
