"""The posterior of a cast's constituents: what the search minimises, and what follows from it."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import oceaninv as oi
from fitting.core.least_squares import covariance, least_squares, value_and_jacobian
from fitting.core.parameters import Parameters, Prior
from fitting.core.problem import AbstractProblem
from fitting.core.program_cache import cached_jit
from fitting.water_model.layered_water import interfaces, layer_quantities, water_of
from fitting.water_model.quantities import water_quantities
from oceaninv.transport.base import AbstractTransport


class Samples(eqx.Module):
    """The arrays that a constituent fit sees, padded."""

    depth: Float[Array, " depth"]
    Ed: Float[Array, "depth wl"]
    sd: Float[Array, "depth wl"]
    mask: Bool[Array, "depth wl"]
    ratio: Float[Array, "depth wl"]  # of the light to that of the transport


class CastProblem(AbstractProblem):
    """The posterior of a cast's constituents.

    Where the water has layers, `reach` (wl,) is the deepest sample of each band and `rounding`
    (interface,) the half-widths over which interfaces are rounded, m; None for one water.
    """

    layout: Parameters = eqx.field(static=True)
    grid: tuple[float, ...] = eqx.field(static=True)
    transport: AbstractTransport
    prior: Prior
    samples: Samples
    reach: Float[Array, " wl"] | None
    rounding: Float[Array, " interface"] | None

    def residual(self, x: Float[Array, " unknown"]) -> Float[Array, " residual"]:
        """Samples, then priors, in standard deviations."""
        seen = self.samples
        model = seen.ratio * model_ed(
            self.layout, self.grid, self.transport, x, seen.depth, self.rounding
        )
        data = jnp.where(seen.mask, (seen.Ed - model) / seen.sd, 0.0)
        return jnp.concatenate([data.reshape(-1), self.prior.residual(x)])

    def quantities(self, x: Float[Array, " unknown"]) -> dict[str, Array]:
        """See `fitting.water_model.quantities.UNITS` and
        `fitting.water_model.layered_water.layer_units`."""
        values, wavelength = self.layout.values(x), np.asarray(self.grid)
        if self.reach is None:
            return water_quantities(values, wavelength, self.transport)
        return layer_quantities(values, wavelength, self.transport, self.reach)


def model_ed(parameters: Parameters, grid, transport: AbstractTransport, x, depth, rounding=None):
    """(depth, wl) Ed of the water and surface light at coordinates `x`.

    `rounding`: half-widths over which interfaces are rounded, see `_unrounded`.
    """
    values = parameters.values(x)
    water = water_of(values, np.asarray(grid))
    sun = jnp.ones(len(grid), dtype=x.dtype)
    zenith = jnp.minimum(values["solar_zenith"], 89.0)
    scene = oi.Scene(water, oi.Light(zenith, sun), oi.FlatSurface())
    error = 1.0 + values["kd_model_error"]

    def light(depths):
        asked = jnp.concatenate([jnp.zeros_like(depth[:1]), *depths]) * error
        return transport.irradiance(scene, asked, None).Ed.value

    surface = jnp.stack([values[f"Ed0_{wl:g}"] for wl in grid])
    if rounding is None:
        down = light([depth])
        return surface[None, :] * down[1:] / down[:1]
    interface = interfaces(values)
    width = jnp.minimum(rounding, 0.5 * interface)
    down = light([depth, interface - width, interface, interface + width])
    about = jnp.log(down[len(depth) + 1 :]).reshape(3, -1, len(grid))
    too_much = _unrounded(depth, interface, width, about)
    return surface[None, :] * down[1 : len(depth) + 1] / down[:1] * jnp.exp(-too_much)


def _unrounded(depth, interface, width, about):
    """(depth, wl) ln Ed at sharp interfaces less that at rounded ones.

    Without rounding the sum of squares has a crease wherever an interface meets a sample, and a
    search may stop in one for good.  About an interface ln Ed is the mean of both K times the
    distance u, and half their difference times |u|; the latter is averaged over +- the width.
    `about` (3, interface, wl): ln Ed a width above, at and a width below.
    """
    more = (2.0 * about[1] - about[0] - about[2]) / width[:, None]  # of K below than above
    away = jnp.abs(depth[:, None] - interface[None, :]) / width[None, :]
    return 0.25 * (width[None, :] * jnp.maximum(1.0 - away, 0.0) ** 2) @ more


def solve_cast(problem: CastProblem, start, solver: Any = None):
    """The optimum, its covariance and the model at the samples, NaN at those left out.

    `solver`: as for `fitting.core.least_squares.least_squares`.
    """
    if solver is None:
        return _solve_cast(problem, start, None)
    # A solver may hold functions that cannot be stored with the program.
    return _solve_cast.jitted(problem, start, solver)


@cached_jit
def _solve_cast(problem: CastProblem, start, solver):
    def residual(x, problem):
        return problem.residual(x)

    optimum = least_squares(residual, start, problem, problem.prior.scale, solver=solver)
    seen = problem.samples
    data = optimum.residual[: seen.Ed.size].reshape(seen.Ed.shape)
    model = jnp.where(seen.mask, seen.Ed - data * seen.sd, jnp.nan)
    return optimum, covariance(optimum.jacobian), model


@cached_jit
def describe_cast(problem: CastProblem, x):
    """The quantities and their slopes: not of the search, so it compiles beside it."""
    return value_and_jacobian(problem.quantities, x)


@cached_jit
def lights(layout: Parameters, grid, transports, x, depth):
    """(depth, wl) Ed through each transport."""
    return tuple(model_ed(layout, grid, transport, x, depth) for transport in transports)
