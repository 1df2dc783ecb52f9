"""Constituents of many casts at once: each cast reduced to a few numbers per band, one program.

A band of a cast tells of the water only through the curve ln Ed(z)/Ed(0-), which is smooth: its
values at a few depths fix it between them.  What all samples of a band say about these values is
a small triangular matrix, found once; the search then knows nothing of the samples.  Ed(0-), whose
logarithm enters linearly, is eliminated in the same step.
"""

import functools
import threading
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import oceaninv as oi
from fitting.core.batched_least_squares import (
    FIRST_DAMPING,
    levenberg_marquardt_steps,
    solve_in_chunks,
)
from fitting.core.diagnostics import Status
from fitting.core.least_squares import covariance, value_and_jacobian
from fitting.core.parameters import Parameters, Prior
from fitting.core.program_cache import cached_jit
from fitting.water_model.quantities import water_quantities
from fitting.water_model.unknowns import water_iops
from oceaninv.transport.base import AbstractTransport

# Chebyshev's nodes in the square root of depth: denser near the surface, where K changes.
NODES = 12
# The sum of squares is expanded about the last model: the second round's is the answer's own.
_ROUNDS = 2
# Largest change of a coordinate in a step, in units of the prior's scale.
_LONGEST = 3.0


# On the host until many are stacked.
Numbers = Array | np.ndarray


class Spectra(eqx.Module):
    """What the search sees of one cast.

    `nodes`: m, the first 0; `basis`: what the curve at each sample takes from the nodes; `light`,
    `sd`, `used`, `start`: readings less darkness, their deviations, which count, and a model to
    begin with; `reflectance`, `weight`: ln R at 0-, and one over its deviation, 0 where absent;
    `beam`, `beam_weight`: a and c without pure water's, 1/m, and one over their deviations.
    """

    nodes: Float[Numbers, "*cast node"]
    basis: Float[Numbers, "*cast depth node"]
    light: Float[Numbers, "*cast depth wl"]
    sd: Float[Numbers, "*cast depth wl"]
    used: Bool[Numbers, "*cast depth wl"]
    start: Float[Numbers, "*cast depth wl"]
    reflectance: Float[Numbers, "*cast wl"]
    weight: Float[Numbers, "*cast wl"]
    beam: Float[Numbers, "*cast 2 beam"]
    beam_weight: Float[Numbers, "*cast 2 beam"]


class Water(eqx.Module):
    """Where the searches ended: `x`, `covariance`, `code` as in `fitting.core.least_squares`,
    quantities with their slopes, the model at the samples, and its ln R at 0-."""

    x: Float[Array, "*cast unknown"]
    covariance: Float[Array, "*cast unknown unknown"]
    code: Array
    values: Mapping[str, Array]
    slopes: Mapping[str, Array]
    model: Float[Array, "*cast depth wl"]
    reflected: Float[Array, "*cast wl"]


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


def _optics(values, grid):
    """What light sees of the water with `values`: a (wl,), b (shape, wl), the sun's zenith, and by
    how much depths are stretched; and the shapes' phase functions."""
    water = water_iops(values, np.asarray(grid))
    zenith = jnp.minimum(values["solar_zenith"], 89.0)
    return (water.a, water.b_components, zenith, values["kd_model_error"]), water.phases


def _light(optics, phases, grid, transport, nodes):
    """(node + 1, wl) ln Ed(z)/Ed(0-) at nodes, then ln R at 0-."""
    a, b, zenith, kd_model_error = optics
    water = oi.IOPs(np.asarray(grid), a, b, phases)
    sun = jnp.ones(len(grid), dtype=nodes.dtype)
    scene = oi.Scene(water, oi.Light(zenith, sun), oi.FlatSurface())
    field = transport.irradiance(scene, nodes * (1.0 + kd_model_error), None)
    down, up = field.Ed.value, field.Eu.value
    return jnp.concatenate([jnp.log(down / down[:1]), jnp.log(up[:1] / down[:1])])


def curve(values, grid, transport, nodes):
    """ln Ed(z)/Ed(0-) at nodes, (node, wl), and ln R at 0-, (wl,), of the water with `values`."""
    optics, phases = _optics(values, grid)
    found = _light(optics, phases, grid, transport, nodes)
    return found[:-1], found[-1]


def _curve_and_slopes(layout: Parameters, grid, transport, nodes, x):
    """(node + 1, wl) of `_light` and its slopes (node + 1, wl, unknown).

    Bands are independent of each other, so light need be differentiated only by the few numbers
    that it sees of a band, whatever their number of unknowns: half the work.
    """
    optics, slopes = value_and_jacobian(lambda x: _optics(layout.values(x), grid)[0], x)
    phases = _optics(layout.values(x), grid)[1]
    shapes = len(phases)

    def moved(by):
        a, b, zenith, kd_model_error = optics
        seen = (a + by[0], b + by[1 : shapes + 1, None], zenith + by[-2], kd_model_error + by[-1])
        return _light(seen, phases, grid, transport, nodes)

    value, inner = value_and_jacobian(moved, jnp.zeros(shapes + 3, x.dtype))
    of_a, of_b, of_zenith, of_closure = slopes
    scalars = jnp.broadcast_to(
        jnp.stack([of_zenith, of_closure])[:, None, :], (2, len(grid), x.shape[0])
    )
    outer = jnp.concatenate([of_a[None], of_b, scalars])
    return value, jnp.einsum("nwk,kwu->nwu", inner, outer)


def _beam(values, wavelength: np.ndarray):
    """(2, beam) a and c of the water with `values` without those of pure water."""
    water, pure = water_iops(values, wavelength), water_iops({}, wavelength)
    return jnp.stack([water.a - pure.a, water.c - pure.c])


def _rows(data: Spectra, model):
    """(wl, row, 1 + node + 1) triangles of [ln Ed(0-) | nodes | target] in standard deviations."""
    weight = jnp.where(data.used, model / data.sd, 0.0)
    target = jnp.log(model) + (data.light - model) / model

    def one(weight, target):
        columns = [weight[:, None], weight[:, None] * data.basis, (weight * target)[:, None]]
        return jnp.linalg.qr(jnp.concatenate(columns, axis=1), mode="r")

    return jax.vmap(one, in_axes=1)(weight, target)


class Search(eqx.Module):
    """Where the search of a cast stands: the coordinates, the damping of its next step, and the
    model about which its sum of squares is expanded."""

    x: Float[Numbers, "*cast unknown"]
    damping: Float[Numbers, "*cast"]
    model: Float[Numbers, "*cast depth wl"]


def _misfit(layout, grid, beam, transport, prior: Prior, data: Spectra, rows):
    """The function (unknown,) -> residual and Jacobian, in units of the prior's scale."""

    def of_beam(x):
        left = data.beam_weight * (_beam(layout.values(x), np.asarray(beam)) - data.beam)
        return left.reshape(-1)

    def both(x):
        value, slope = _curve_and_slopes(layout, grid, transport, data.nodes, x)
        light = jnp.einsum("wrn,nw->wr", rows[:, 1:-1, 1:-1], value[:-1]) - rows[:, 1:-1, -1]
        of_light = jnp.einsum("wrn,nwu->wru", rows[:, 1:-1, 1:-1], slope[:-1])
        up = data.weight * (value[-1] - data.reflectance)
        of_up = data.weight[:, None] * slope[-1]
        residual = [light.reshape(-1), up, prior.residual(x)]
        slopes = [of_light.reshape(-1, x.shape[0]), of_up, jnp.diag(prior.weight)]
        if beam:
            left, slope = value_and_jacobian(of_beam, x)
            residual, slopes = [*residual, left], [*slopes, slope]
        residual, jacobian = jnp.concatenate(residual), jnp.concatenate(slopes)
        return residual, jacobian * prior.scale[None, :]

    return both


def _pass(layout: Parameters, grid, beam, transport: AbstractTransport, prior, data, search):
    """A few steps of the search from where it stands."""
    rows = _rows(data, search.model)
    both = _misfit(layout, grid, beam, transport, prior, data, rows)
    at = levenberg_marquardt_steps(
        both, jnp.asarray(search.x), search.damping, prior.scale, _LONGEST
    )
    usable = jnp.where(at.code == Status.MODEL_NOT_FINITE, 0.0, at.jacobian / prior.scale[None, :])
    water = _described(layout, grid, transport, data, rows, at.x, usable, at.code)
    return water, Search(at.x, at.damping, search.model), at.ended


def _described(layout, grid, transport, data: Spectra, rows, x, jacobian, code) -> Water:
    """Water, quantities and model at `x`, the Jacobian there 0 where it is not finite."""
    shape, up = curve(layout.values(x), grid, transport, data.nodes)
    first = rows[:, 0]
    # A band without a sample has a row of zeros.
    scale = jnp.where(first[:, 0] == 0.0, 1.0, first[:, 0])
    surface = (first[:, -1] - jnp.sum(first[:, 1:-1] * shape.T, axis=1)) / scale
    model = jnp.exp(jnp.clip(surface[None, :] + data.basis @ shape, -100.0, 100.0))

    def outcome(x):
        return water_quantities(layout.values(x), np.asarray(grid), transport)

    values, slopes = value_and_jacobian(outcome, x)
    return Water(x, covariance(jacobian), code, values, slopes, model, up)


# One program takes every core.  Several at a time, as the threads of a cluster's worker would
# start them, could deadlock: see
# `oceaninv/transport/plane_parallel/_small_matrix_factorisations.py`.
_ONE_AT_A_TIME = threading.Lock()


@cached_jit
def _pass_all(layout: Parameters, prior: Prior, grid, beam, transport, data: Spectra, at: Search):
    return jax.vmap(functools.partial(_pass, layout, grid, beam, transport))(prior, data, at)


def solve_waters(
    parameters: Sequence[Parameters], grid, transport, data: Sequence[Spectra], beam=()
) -> list[Water]:
    """Searches of casts that share bands, unknowns, the length of their padding and the `beam`
    wavelengths of a and c.

    Shared out by `fitting.core.batched_least_squares.solve_in_chunks`.
    """
    layout = parameters[0].layout()
    priors = [jax.tree.map(np.asarray, one.prior()) for one in parameters]
    damping = np.asarray(FIRST_DAMPING, np.asarray(priors[0].centre).dtype)
    start = [Search(p.centre, damping, d.start) for p, d in zip(priors, data, strict=True)]

    def advance(problems, at):
        (prior, seen), at = jax.device_put((problems, at))
        with _ONE_AT_A_TIME:
            done = _pass_all(layout, prior, grid, beam, transport, seen, at)
            return jax.tree.map(np.asarray, done)

    return solve_in_chunks(
        list(zip(priors, data, strict=True)),
        start,
        advance,
        lambda water: Search(water.x, damping, water.model),
        _ROUNDS,
    )
