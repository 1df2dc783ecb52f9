"""Constituents of many casts at once: each cast reduced to a few numbers per band, one program.

A band of a cast tells of the water only through the curve ln Ed(z)/Ed(0-), which is smooth: its
values at a few depths fix it between them.  What all samples of a band say about these values is
a small triangular matrix, found once; the search then knows nothing of the samples.  Ed(0-), whose
logarithm enters linearly, is eliminated in the same step.
"""

import functools
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import oceaninv as oi
from fitting._programs import kept
from fitting.parameters import Parameters, Prior, water_iops
from fitting.quantities import water_quantities
from fitting.solve import covariance, least_squares, value_and_jacobian
from oceaninv.transport.base import AbstractTransport

# Chebyshev's nodes in the square root of depth: denser near the surface, where K changes.
NODES = 12
# The sum of squares is expanded about the last model: the second round's is the answer's own.
_ROUNDS = 2
# Casts of one compiled call: few, because the slowest search of a call holds the others.
CHUNK = 16


# On the host until many are stacked.
Numbers = Array | np.ndarray


class Spectra(eqx.Module):
    """What the search sees of one cast.

    `nodes`: m, the first 0; `basis`: what the curve at each sample takes from the nodes; `light`,
    `sd`, `used`, `start`: readings less darkness, their deviations, which count, and a model to
    begin with; `reflectance`, `weight`: ln R at 0-, and one over its deviation, 0 where absent.
    """

    nodes: Float[Numbers, "*cast node"]
    basis: Float[Numbers, "*cast depth node"]
    light: Float[Numbers, "*cast depth wl"]
    sd: Float[Numbers, "*cast depth wl"]
    used: Bool[Numbers, "*cast depth wl"]
    start: Float[Numbers, "*cast depth wl"]
    reflectance: Float[Numbers, "*cast wl"]
    weight: Float[Numbers, "*cast wl"]


class Water(eqx.Module):
    """Where the searches ended: `x`, `covariance`, `code` as in `fitting.solve`, quantities with
    their slopes, and the model at the samples."""

    x: Float[Array, "*cast unknown"]
    covariance: Float[Array, "*cast unknown unknown"]
    code: Array
    values: Mapping[str, Array]
    slopes: Mapping[str, Array]
    model: Float[Array, "*cast depth wl"]


def nodes_and_basis(depth: np.ndarray, deepest: float) -> tuple[np.ndarray, np.ndarray]:
    """(node,) depths down to `deepest`, and (depth, node) Lagrange's polynomials at `depth`."""
    roots = 0.5 * (1.0 - np.cos(np.pi * np.arange(NODES) / (NODES - 1)))
    place = np.sqrt(np.clip(depth, 0.0, deepest) / deepest)
    sign = np.where(np.arange(NODES) % 2, -1.0, 1.0)
    sign[[0, -1]] *= 0.5
    gap = place[:, None] - roots[None, :]
    hit = np.abs(gap) < 1e-12
    share = sign / np.where(hit, 1.0, gap)
    basis = share / share.sum(axis=1, keepdims=True)
    return deepest * roots**2, np.where(hit.any(axis=1, keepdims=True), hit, basis)


def curve(values, grid, transport, nodes):
    """ln Ed(z)/Ed(0-) at nodes, (node, wl), and ln R at 0-, (wl,), of the water with `values`."""
    wavelength = np.asarray(grid)
    sun = jnp.ones(len(grid), dtype=nodes.dtype)
    zenith = jnp.minimum(values["solar_zenith"], 89.0)
    water = water_iops(values, wavelength)
    scene = oi.Scene(water, oi.Light(zenith, sun), oi.FlatSurface())
    field = transport.irradiance(scene, nodes * (1.0 + values["closure"]), None)
    down, up = field.Ed.value, field.Eu.value
    return jnp.log(down / down[:1]), jnp.log(up[0] / down[0])


def _rows(data: Spectra, model):
    """(wl, row, 1 + node + 1) triangles of [ln Ed(0-) | nodes | target] in standard deviations."""
    weight = jnp.where(data.used, model / data.sd, 0.0)
    target = jnp.log(model) + (data.light - model) / model

    def one(weight, target):
        columns = [weight[:, None], weight[:, None] * data.basis, (weight * target)[:, None]]
        return jnp.linalg.qr(jnp.concatenate(columns, axis=1), mode="r")

    return jax.vmap(one, in_axes=1)(weight, target)


def _solve(layout: Parameters, grid, transport: AbstractTransport, prior: Prior, data: Spectra):
    def residual(x, args):
        rows, prior, nodes, reflectance, weight = args
        shape, reflected = curve(layout.values(x), grid, transport, nodes)
        light = jnp.einsum("wrn,nw->wr", rows[:, 1:-1, 1:-1], shape) - rows[:, 1:-1, -1]
        up = weight * (reflected - reflectance)
        return jnp.concatenate([light.reshape(-1), up, prior.residual(x)])

    def refine(carry, _):
        x, model = carry
        rows = _rows(data, model)
        args = (rows, prior, data.nodes, data.reflectance, data.weight)
        optimum = least_squares(residual, x, args, prior.scale)
        shape, _ = curve(layout.values(optimum.x), grid, transport, data.nodes)
        first = rows[:, 0]
        # A band without a sample has a row of zeros.
        scale = jnp.where(first[:, 0] == 0.0, 1.0, first[:, 0])
        surface = (first[:, -1] - jnp.sum(first[:, 1:-1] * shape.T, axis=1)) / scale
        fitted = jnp.exp(jnp.clip(surface[None, :] + data.basis @ shape, -100.0, 100.0))
        return (optimum.x, fitted), (covariance(optimum.jacobian), optimum.code)

    (x, model), (cov, code) = jax.lax.scan(refine, (prior.centre, data.start), length=_ROUNDS)

    def outcome(x):
        return water_quantities(layout.values(x), np.asarray(grid), transport)

    values, slopes = value_and_jacobian(outcome, x)
    return Water(x, cov[-1], code[-1], values, slopes, jnp.asarray(model))


@kept
def _solve_all(layout: Parameters, prior: Prior, grid, transport, data: Spectra) -> Water:
    return jax.vmap(functools.partial(_solve, layout, grid, transport))(prior, data)


def solve_waters(
    parameters: Sequence[Parameters], grid, transport, data: Sequence[Spectra]
) -> list[Water]:
    """Searches of casts that share bands, unknowns and the length of their padding."""
    layout, found = parameters[0].layout(), []
    priors = [jax.tree.map(np.asarray, one.prior()) for one in parameters]
    for at in range(0, len(data), CHUNK):
        part = list(range(at, min(at + CHUNK, len(data))))
        filled = part + part[-1:] * (CHUNK - len(part)) if len(data) > 1 else part

        def stacked(items, filled=filled):
            return jax.tree.map(lambda *leaves: np.stack(leaves), *[items[i] for i in filled])

        arrays = jax.device_put((stacked(priors), stacked(data)))
        done = jax.tree.map(np.asarray, _solve_all(layout, arrays[0], grid, transport, arrays[1]))
        found += [jax.tree.map(lambda leaf, k=k: leaf[k], done) for k in range(len(part))]
    return found
