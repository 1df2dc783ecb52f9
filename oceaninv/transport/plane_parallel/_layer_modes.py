"""The numerical core of the plane-parallel solver, on plain arrays, for one wavelength.

Everything is written in y = sqrt(w mu) I at the nodes of one hemisphere, in which every operator
is symmetric.  With S = down + up and D = down - up at optical depth t,

    S' = -S_o D + q_o e^(-nu t),   D' = -S_e S + q_e e^(-nu t),
    S_e = M^-1/2 (1 - sum over even l of A_l omega chi_l A_l') M^-1/2,   S_o: odd l,

A_l the Legendre functions times sqrt(w) (see `Basis`), M = diag(mu).  With S_o = L L' and
B = L' S_e L = V diag(k^2) V', u = L^-1 S and v = L' D obey u'' = B u + ..., v'' = B v + ....
A layer enters only through functions of B that are regular at k = 0 and at k = nu.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation.quadrature import Basis
from oceaninv.transport.plane_parallel import _matrix_functions as mf
from oceaninv.transport.plane_parallel import _small_matrix_factorisations

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
    """A layer's reflection, transmission and source:
    y_out = reflect y_in + transmit y_in' + source."""

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
    gain = basis.from_order(layer.gain)
    root_mu = jnp.sqrt(basis.mu)
    across = basis.turn.T / basis.mu[None, :]
    mean = jnp.where(basis.order == 0, 1.0, 0.0).astype(gain.dtype)
    operators = (gain[0::2], gain[1::2], layer.lost)
    k2, matrix, factor, inverse = _modes(mean, operators, (basis.even, basis.odd, across, root_mu))
    return Modes(jax.lax.stop_gradient(k2), matrix, factor, inverse)


@jax.custom_jvp
def _modes(mean, operators, directions):
    """(k2, matrix, factor, inverse) of `Modes`; `mean` is 1 for azimuth order 0, 0 otherwise."""
    return _modes_in_full(mean, operators, directions)[0]


def _modes_in_full(mean, operators, directions):
    even_gain, odd_gain, lost = operators
    even_basis, odd_basis, across, root_mu = jax.lax.stop_gradient(directions)
    one = jnp.eye(root_mu.shape[0], dtype=root_mu.dtype)
    even = one - (even_basis * even_gain[None, :]) @ even_basis.T
    # The share not scattered, exact: only this element depends on absorption.
    even = even.at[0, 0].set(jnp.where(mean == 1, lost, even[0, 0]))
    root, inverse_root = _small_matrix_factorisations.square_root(
        one - (odd_basis * odd_gain[None, :]) @ odd_basis.T
    )
    fixed = across @ root
    vectors = _small_matrix_factorisations.eigenvectors(fixed.T @ even @ fixed)
    right = root @ vectors
    projected = across @ right
    scattered = even @ projected
    # Rayleigh quotients: right to second order in the error of a vector, so that the smallest
    # eigenvalue, which vanishes with absorption, does not carry the rounding of the largest.
    k2 = jnp.sum(projected * scattered, axis=0)
    left = vectors.T @ inverse_root
    modes = (k2, jnp.diag(k2), right / root_mu[:, None], left * root_mu[None, :])
    return modes, (right, left, projected, scattered)


def _modes_jvp(primals, tangents):
    """In the fixed basis of the modes S_e is diag(k2) and S_o is 1; of the roots of S_o that with
    a symmetric derivative is taken (which one does not matter to the field)."""
    mean, operators, directions = primals
    modes, (right, left, projected, scattered) = _modes_in_full(*primals)
    k2, _, factor, inverse = modes
    even_gain, odd_gain, _ = operators
    deven_gain, dodd_gain, dlost = (
        jnp.zeros_like(v) if mf.is_zero(d) else d
        for v, d in zip(operators, tangents[1], strict=True)
    )
    deven_gain = deven_gain.at[0].set(jnp.where(mean == 1, -dlost, deven_gain[0]))
    even_basis, odd_basis, _, root_mu = directions
    deven, dodd, dacross, droot_mu = tangents[2]

    def change(seen, gain, dgain, turned):
        total = -(seen * dgain[None, :]) @ seen.T
        if turned is None:
            return total
        part = -(seen * gain[None, :]) @ turned.T
        return total + part + part.T

    turned = None if mf.is_zero(deven) else projected.T @ deven
    dmatrix = change(projected.T @ even_basis, even_gain, deven_gain, turned)
    turned = None if mf.is_zero(dodd) else left @ dodd
    half = change(left @ odd_basis, odd_gain, dodd_gain, turned) / 2
    dmatrix = dmatrix + k2[:, None] * half + half * k2[None, :]
    if not mf.is_zero(dacross):
        part = scattered.T @ (dacross @ right)
        dmatrix = dmatrix + part + part.T
    dfactor, dinverse = factor @ half, -half @ inverse
    if not mf.is_zero(droot_mu):
        stretch = droot_mu / root_mu
        dfactor = dfactor - factor * stretch[:, None]
        dinverse = dinverse + inverse * stretch[None, :]
    return modes, (jnp.zeros_like(k2), dmatrix, dfactor, dinverse)


_modes.defjvp(_modes_jvp, symbolic_zeros=True)


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
def inverse_of(matrix, positive=True):
    """Inverse, of a symmetric positive definite matrix or of any, whose derivative reuses it."""
    return (
        _small_matrix_factorisations.inverse_of_positive(matrix)
        if positive
        else _small_matrix_factorisations.inverse(matrix)
    )


@inverse_of.defjvp
def _inverse_jvp(positive, primals, tangents):
    inverse = inverse_of(*primals, positive)
    return inverse, -inverse @ tangents[0] @ inverse


class Operators(NamedTuple):
    """Reflection and transmission of a layer, and intermediate results, each (n, n)."""

    k1: Array
    k2: Array
    reflect: Array
    inner: Array  # L sech^2(k h) L^-1
    transmit: Array
    k3: Array  # (1 + L'^-1 k coth(k t) L^-1)^-1
    csch: Array  # L'^-1 k/sinh(k t) L^-1


def operators(modes: Modes, apply: Callable, endless: bool) -> Operators:
    """Reflection and transmission of a layer, free of cancellation at any thickness; `apply`
    applies `_matrix_functions.through` (`endless`: what there is of it) to as many matrices.

    R = K1 (Z - Y) K2, T = K1 L sech^2(k h) L^-1 K2, K1 = (1 + Z)^-1, K2 = (1 + Y)^-1,
    Z = L tanh(k h)/k L', Y = L'^-1 k tanh(k h) L^-1.  What leaves an `endless` layer below is 0.
    """
    factor, inverse = modes.factor, modes.inverse
    one = jnp.eye(factor.shape[0], dtype=factor.dtype)
    operands = jnp.stack([factor.T] + [inverse] * (1 if endless else 4))
    right = apply(operands)
    z, y = factor @ right[0], inverse.T @ (modes.matrix @ right[1])
    if endless:
        k1, k2 = jax.vmap(inverse_of)(one[None] + jnp.stack([z, y]))
        nothing = jnp.zeros_like(z)
        return Operators(k1, k2, k1 @ (z - y) @ k2, *(nothing,) * 4)
    k1, k2, k3 = jax.vmap(inverse_of)(one[None] + jnp.stack([z, y, inverse.T @ right[3]]))
    inner = factor @ right[2]
    transmit = k1 @ inner @ k2
    return Operators(k1, k2, k1 @ (z - y) @ k2, inner, transmit, k3, inverse.T @ right[4])


class Sent(NamedTuple):
    """The light that the source of a layer sends out at its top and bottom; half the sum and half
    the difference of both."""

    up: Array
    down: Array
    even: Array
    odd: Array


def leaving(layer: Layer, modes: Modes, beam: Beam, own: Operators, response) -> Sent:
    """The light that the source of a layer sends out; `response`: `_matrix_functions.forced` of
    the source."""
    even, odd, arriving = sources(layer, modes, beam, response)
    even, odd = own.k2 @ even, own.k1 @ odd
    up = even - odd
    if arriving is None:
        return Sent(up, jnp.zeros_like(up), even, odd)
    # Their sum loses the light transmitted by a thick layer to rounding; solve the lower boundary
    # for it instead:
    # (1 + L'^-1 k coth(k t) L^-1) down = L'^-1 (q_o e^(-nu t) + ... + k/sinh(k t) L^-1 up).
    return Sent(up, own.k3 @ (arriving + own.csch @ up), even, odd)


def sources(layer, modes, beam, response):
    """Even and odd part of what leaves before it is reflected inside, and what arrives below;
    `response`: `_matrix_functions.forced` of the beam."""
    even = modes.inverse.T @ (response[0, :, 0] - modes.matrix @ response[1, :, 1])
    odd = modes.factor @ (response[0, :, 1] - response[1, :, 0])
    if response.shape[0] == 2:
        return even, odd, None
    below = response[2] @ jnp.stack([jnp.ones_like(beam.nu), beam.nu])
    return even, odd, modes.inverse.T @ (below + jnp.exp(-beam.nu * layer.depth) * beam.odd)


class Wall(NamedTuple):
    """A Lambertian floor: up = share flux (flux . down) + source."""

    share: Array  # ()
    flux: Array  # (n,)
    source: Array  # (n,)


class Field(NamedTuple):
    """Diffuse light entering and leaving every layer, in y."""

    top_down: Array  # (layer, n)
    top_up: Array  # (layer, n)
    bottom_down: Array  # (layer, n), 0 if endless
    bottom_up: Array  # (layer, n)


def inside(
    share: Float[Array, ""], layer: Layer, modes: Modes, beam: Beam | None, field: Field
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Diffuse (down, up) at a share of the way from top to bottom of a layer whose boundary
    values are known (`field` without its leading axis).

    u and v obey the same equation, so both are interpolated between their values at top and
    bottom by sinh(k(t - s))/sinh(k t) and sinh(k s)/sinh(k t).  In a thin layer only
    the departure from the straight line is interpolated so, since the line itself has no
    cancellation.
    """
    t = layer.depth

    def combine(functions, vectors, *more):
        return mf.combine(functions, modes.k2, modes.matrix, (t, *more), vectors)

    def project(down, up):
        return jnp.stack([modes.inverse @ (down + up), modes.factor.T @ (down - up)], axis=1)

    ends = jnp.stack(
        [project(field.top_down, field.top_up), project(field.bottom_down, field.bottom_up)]
    )
    line = jnp.where(t < 1, jnp.stack([1 - share, share]), 0.0)
    if beam is None:
        total = combine(mf.inside_apart, ends, share)
    else:
        source = forcing(modes, beam)
        everything = jnp.concatenate([ends, source[None]])
        total = combine(mf.forced_inside_apart, everything, share, beam.nu)
    sum_, difference = modes.factor @ total[:, 0], modes.inverse.T @ total[:, 1]
    down = (sum_ + difference) / 2 + line[0] * field.top_down + line[1] * field.bottom_down
    up = (sum_ - difference) / 2 + line[0] * field.top_up + line[1] * field.bottom_up
    return down, up


def forcing(modes: Modes, beam: Beam) -> Float[Array, "n 2"]:
    """Coefficients of W in u and v, at the top of the layer."""
    lifted = modes.matrix @ beam.odd + beam.nu * beam.even
    return jnp.stack([beam.even + beam.nu * beam.odd, lifted], axis=1)


def slope(
    layer: Layer, modes: Modes, down: Float[Array, "n"], up: Float[Array, "n"], even, odd
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """d(down, up)/dz (1/m) where light and its source (even, odd; as in `Beam`) are known.

    S_o = L V (L V)' and S_e = (V' L^-1)' B (V' L^-1): the transfer equation, of which no function
    of B is differentiated.
    """
    dsum = modes.factor @ (odd - modes.factor.T @ (down - up))
    ddifference = modes.inverse.T @ (even - modes.matrix @ (modes.inverse @ (down + up)))
    half = layer.extinction / 2
    return half * (dsum + ddifference), half * (dsum - ddifference)
