"""The numerical core of the plane-parallel solver, on plain arrays, for one wavelength.

Everything is written in y = sqrt(w mu) I at the nodes of one hemisphere, in which every operator
is symmetric.  With S = down + up and D = down - up at optical depth t,

    S' = -S_o D + q_o e^(-nu t),   D' = -S_e S + q_e e^(-nu t),
    S_e = M^-1/2 (1 - sum over even l of A_l omega chi_l A_l') M^-1/2,   S_o: odd l,

A_l the Legendre functions times sqrt(w) (see `Basis`), M = diag(mu).  With S_o = L L' and
B = L' S_e L = V diag(k^2) V', u = L^-1 S and v = L' D obey u'' = B u + ..., v'' = B v + ....
All that is needed of a layer are functions of B that are regular at k = 0 and at k = nu.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv._quadrature import Basis
from oceaninv.transport import _matrix_functions as mf

_TINY = 1e-18  # 1/m, added to absorption: keeps value and derivative of empty water defined


class Layer(NamedTuple):
    """One homogeneous layer after delta-M scaling."""

    depth: Array  # () optical thickness
    extinction: Array  # () 1/m
    lost: Array  # () 1 - omega
    gain: Array  # (moment,) omega chi_l


class Modes(NamedTuple):
    """The reduced problem of one layer in the (fixed) basis of its modes."""

    k2: Array  # (n,)
    matrix: Array  # (n, n): B
    factor: Array  # (n, n): L V
    inverse: Array  # (n, n): V' L^-1


class Slab(NamedTuple):
    """What a layer does to light: y_out = reflect y_in + transmit y_in' + source."""

    reflect: Array  # (n, n)
    transmit: Array  # (n, n)
    up: Array  # (n,) source leaving at the top
    down: Array  # (n,) source leaving at the bottom


class Beam(NamedTuple):
    """A source q e^(-nu t) of a layer, projected on its modes."""

    even: Array  # (n,): V' L' q_e
    odd: Array  # (n,): V' L^-1 q_o
    nu: Array  # ()


def scale_layer(
    absorption: Float[Array, ""], moments: Float[Array, "moment"], thickness: Float[Array, ""]
) -> Layer:
    """Delta-M scaling (Wiscombe 1977) of a (1/m), b chi_l (1/m) and meters.

    The last moment is the truncated forward peak.  Written in a and b, not in albedo and optical
    thickness: 1 - omega is then as accurate as a.
    """
    absorption = absorption + _TINY
    peak = moments[-1]
    extinction = absorption + (moments[0] - peak)
    gain = (moments[:-1] - peak) / extinction
    return Layer(extinction * thickness, extinction, absorption / extinction, gain)


def layer_modes(layer: Layer, basis: Basis) -> Modes:
    """Eigenvalues and modes; derivatives flow through `matrix`, `factor`, `inverse` only."""
    one = jnp.eye(basis.mu.shape[0], dtype=basis.mu.dtype)
    gain = basis.from_order(layer.gain)
    even = one - (basis.even * gain[None, 0::2]) @ basis.even.T
    # What is not scattered, exact: in this element lies the whole difference that a makes.
    even = even.at[0, 0].set(jnp.where(basis.order == 0, layer.lost, even[0, 0]))
    root, inverse_root = _square_root(one - (basis.odd * gain[None, 1::2]) @ basis.odd.T)
    across = basis.turn.T / basis.mu[None, :]
    fixed = jax.lax.stop_gradient(across @ root)
    _, vectors = jnp.linalg.eigh(
        fixed.T @ jax.lax.stop_gradient(even) @ fixed, symmetrize_input=False
    )
    vectors = jax.lax.stop_gradient(vectors)
    right = root @ vectors
    projected = across @ right
    # Rayleigh quotients: right to second order in the error of a vector, so that the smallest
    # eigenvalue, which vanishes with absorption, does not carry the rounding of the largest.
    matrix = projected.T @ (even @ projected)
    k2 = jax.lax.stop_gradient(jnp.diagonal(matrix))
    matrix = jnp.diag(k2) + (matrix - jax.lax.stop_gradient(matrix))
    root_mu = jnp.sqrt(basis.mu)
    factor = right / root_mu[:, None]
    inverse = (vectors.T @ inverse_root) * root_mu[None, :]
    return Modes(k2, matrix, factor, inverse)


@jax.custom_jvp
def _square_root(matrix):
    """(C, C^-1) with C C' = matrix, symmetric positive definite.

    Which C does not matter to the field; the derivative is that of the simplest choice.
    """
    root = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    one = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    return root, jax.lax.linalg.triangular_solve(root, one, left_side=True, lower=True)


@_square_root.defjvp
def _square_root_jvp(primals, tangents):
    root, inverse = _square_root(*primals)
    half = inverse @ tangents[0] / 2
    change = half @ inverse.T
    return (root, inverse), (half.T, -change @ inverse)


def beam_source(
    layer: Layer, modes: Modes, basis: Basis, angular: Float[Array, "moment"], nu: Float[Array, ""]
) -> Beam:
    """Single scattering of a beam of unit irradiance along itself; `angular` is p_l(mu0)."""
    amplitude = basis.from_order(layer.gain * angular) / (2 * np.pi)
    root_mu = jnp.sqrt(basis.mu)
    even = (basis.turn @ (basis.even @ amplitude[0::2])) / root_mu
    odd = (basis.odd @ amplitude[1::2]) / root_mu
    return Beam(modes.factor.T @ even, modes.inverse @ odd, nu)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _inverse(matrix, positive=True):
    """Inverse, of a symmetric positive definite matrix or of any, whose derivative reuses it."""
    if not positive:
        return jnp.linalg.inv(matrix)
    _, inverse = _square_root(matrix)
    return inverse.T @ inverse


@_inverse.defjvp
def _inverse_jvp(positive, primals, tangents):
    inverse = _inverse(*primals, positive)
    return inverse, -inverse @ tangents[0] @ inverse


def slab(layer: Layer, modes: Modes, beam: Beam | None, endless: bool) -> Slab:
    """Reflection, transmission and sources of a layer, free of cancellation at any thickness.

    R = K1 (Z - Y) K2, T = K1 L sech^2(k h) L^-1 K2, K1 = (1 + Z)^-1, K2 = (1 + Y)^-1,
    Z = L tanh(k h)/k L', Y = L'^-1 k tanh(k h) L^-1.  What leaves an `endless` layer below is 0.
    """
    t = layer.depth

    def apply(functions, vectors, *more):
        return mf.apply_functions(functions, modes.k2, modes.matrix, (t, *more), vectors)

    factor, inverse = modes.factor, modes.inverse
    one = jnp.eye(factor.shape[0], dtype=factor.dtype)
    operands = jnp.stack([factor.T] + [inverse] * (1 if endless else 4))
    right = apply(mf.endless if endless else mf.through, operands)
    z, y = factor @ right[0], inverse.T @ (modes.matrix @ right[1])
    k1, k2 = _inverse(one + z), _inverse(one + y)
    reflect = k1 @ (z - y) @ k2
    transmit = jnp.zeros_like(z) if endless else k1 @ (factor @ right[2]) @ k2
    if beam is None:
        nothing = jnp.zeros_like(modes.k2)
        return Slab(reflect, transmit, nothing, nothing)
    both = jnp.stack([beam.even, beam.odd], axis=1)
    functions = mf.forced_endless if endless else mf.forced
    response = apply(functions, jnp.stack([both] * (2 if endless else 3)), beam.nu)
    symmetric = k2 @ (inverse.T @ (response[0, :, 0] - modes.matrix @ response[1, :, 1]))
    antisymmetric = k1 @ (factor @ (response[0, :, 1] - response[1, :, 0]))
    up = symmetric - antisymmetric
    if endless:
        return Slab(reflect, transmit, up, jnp.zeros_like(up))
    # Their sum loses what a thick layer lets through; solve the lower boundary for it instead:
    # (1 + L'^-1 k coth(k t) L^-1) down = L'^-1 (q_o e^(-nu t) + ... + k/sinh(k t) L^-1 up).
    arriving = response[2] @ jnp.stack([jnp.ones_like(beam.nu), beam.nu]) + right[4] @ up
    arriving = arriving + jnp.exp(-beam.nu * t) * beam.odd
    down = _inverse(one + inverse.T @ right[3]) @ (inverse.T @ arriving)
    return Slab(reflect, transmit, up, down)


class Wall(NamedTuple):
    """What lies below a level: up = reflect down + source."""

    reflect: Array  # (n, n)
    source: Array  # (n,)


class Field(NamedTuple):
    """Diffuse light entering and leaving every layer, in y."""

    top_down: Array  # (layer, n)
    top_up: Array  # (layer, n)
    bottom_down: Array  # (layer, n), 0 if endless
    bottom_up: Array  # (layer, n)


def add_layers(
    slabs: Slab | None,
    bottom: Slab,
    floor: Wall | None,
    surface: Float[Array, "n"] | None,
    sky: Float[Array, "n"] | None,
) -> Field:
    """Join layers with what bounds them, upwards, then fill in downwards.

    `slabs`: all but the lowest (stacked, top first), `bottom`: the lowest, endless if there is no
    `floor`.  `surface` is the reflectance for light from below; `sky` enters through it.
    """
    n = bottom.up.shape[0]
    above, transmit, source = Wall(bottom.reflect, bottom.up), bottom.transmit, bottom.down
    if floor is not None:
        above, (_, transmit, source) = _add(bottom, floor)
    lowest, stages = above, None
    if slabs is not None:
        above, stages = jax.lax.scan(lambda wall, s: _add(s, wall), above, slabs, reverse=True)
    down = jnp.zeros(n, dtype=bottom.up.dtype) if sky is None else sky
    if surface is not None:
        bounced = surface[:, None] * above.reflect
        opened = _inverse(jnp.eye(n, dtype=bounced.dtype) - bounced, False)
        down = opened @ (down + surface * above.source)

    def descend(down, stage):
        wall, transmit, source = stage
        below = transmit @ down + source
        return below, (down, wall.reflect @ down + wall.source, below)

    parts = []
    if stages is not None:
        down, part = jax.lax.scan(descend, down, stages)
        parts.append(part)
    last_down = floor_up = jnp.zeros_like(down)
    if floor is not None:
        last_down = transmit @ down + source
        floor_up = floor.reflect @ last_down + floor.source
    last_up = lowest.reflect @ down + lowest.source
    parts.append((down[None], last_up[None], last_down[None]))
    top_down, top_up, bottom_down = (jnp.concatenate(p) for p in zip(*parts, strict=True))
    return Field(top_down, top_up, bottom_down, jnp.concatenate([top_up[1:], floor_up[None]]))


def _add(slab, below):
    """One layer on top of what lies below: the wall they make, and how light gets to its foot."""
    one = jnp.eye(slab.reflect.shape[0], dtype=slab.reflect.dtype)
    between = _inverse(one - slab.reflect @ below.reflect, False)
    transmit = between @ slab.transmit
    source = between @ (slab.reflect @ below.source + slab.down)
    # A homogeneous layer is the same seen from either side: its transmission upwards is T too.
    back = slab.transmit @ below.reflect
    reflect = slab.reflect + back @ transmit
    up = slab.up + back @ source + slab.transmit @ below.source
    wall = Wall(reflect, up)
    return wall, (wall, transmit, source)


def inside(
    share: Float[Array, ""], layer: Layer, modes: Modes, beam: Beam | None, field: Field
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Diffuse (down, up) at a share of the way from top to bottom of a layer whose boundary
    values are known (`field` without its leading axis).

    u and v obey the same equation, so both are interpolated between their values at top and
    bottom by sinh(k(t - s))/sinh(k t) and sinh(k s)/sinh(k t).  In a thin layer only the
    departure from the straight line is: what the line gives has no cancellation in it.
    """
    t = layer.depth

    def apply(functions, vectors, *more):
        return mf.apply_functions(functions, modes.k2, modes.matrix, (t, *more), vectors)

    def project(down, up):
        return jnp.stack([modes.inverse @ (down + up), modes.factor.T @ (down - up)], axis=1)

    ends = jnp.stack(
        [project(field.top_down, field.top_up), project(field.bottom_down, field.bottom_up)]
    )
    line = jnp.where(t < 1, jnp.stack([1 - share, share]), 0.0)
    if beam is None:
        total = jnp.sum(apply(mf.inside, ends, share), axis=0)
    else:
        source = forcing(modes, beam)
        everything = jnp.concatenate([ends, source[None]])
        total = jnp.sum(apply(mf.forced_inside, everything, share, beam.nu), axis=0)
    total = total - jnp.sum(line[:, None, None] * ends, axis=0)
    sum_, difference = modes.factor @ total[:, 0], modes.inverse.T @ total[:, 1]
    down = (sum_ + difference) / 2 + line[0] * field.top_down + line[1] * field.bottom_down
    up = (sum_ - difference) / 2 + line[0] * field.top_up + line[1] * field.bottom_up
    return down, up


def forcing(modes: Modes, beam: Beam) -> Float[Array, "n 2"]:
    """Coefficients of W in u and v, at the top of the layer."""
    lifted = modes.matrix @ beam.odd + beam.nu * beam.even
    return jnp.stack([beam.even + beam.nu * beam.odd, lifted], axis=1)
