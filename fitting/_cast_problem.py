"""The posterior of a cast's constituents: what the search minimises, and what follows from it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import oceaninv as oi
from fitting._programs import kept
from fitting.layered import layer_quantities, water_of
from fitting.parameters import Parameters, Prior
from fitting.quantities import water_quantities
from fitting.sampling import AbstractProblem
from fitting.solve import covariance, least_squares, value_and_jacobian
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
        """See `fitting.quantities.UNITS` and `fitting.layered.layer_units`."""
        values, wavelength = self.layout.values(x), np.asarray(self.grid)
        if self.reach is None:
            return water_quantities(values, wavelength, self.transport)
        return layer_quantities(values, wavelength, self.transport, self.reach)


def model_ed(parameters: Parameters, grid, transport: AbstractTransport, x, depth, rounding=None):
    """(depth, wl) Ed of the water and surface light at coordinates `x`.

    `rounding`: without it, the sum of squares has a crease wherever an interface meets a sample,
    and a search may stop in one for good.  ln Ed is (K_above + K_below)/2 times the distance u from
    the interface and half their difference times |u|; the latter is averaged over +- the width.
    """
    values = parameters.values(x)
    water = water_of(values, np.asarray(grid))
    sun = jnp.ones(len(grid), dtype=x.dtype)
    zenith = jnp.minimum(values["solar_zenith"], 89.0)
    scene = oi.Scene(water, oi.Light(zenith, sun), oi.FlatSurface())
    asked = [jnp.zeros_like(depth[:1]), depth]
    if rounding is not None:
        interface = water.interfaces / (1.0 + values["closure"])
        width = jnp.minimum(rounding, 0.5 * interface)
        asked += [interface - width, interface, interface + width]
    field = transport.irradiance(scene, jnp.concatenate(asked) * (1.0 + values["closure"]), None)
    relative = field.Ed.value[1 : len(depth) + 1] / field.Ed.value[:1]
    if rounding is not None:
        above, at, below = jnp.log(field.Ed.value[len(depth) + 1 :]).reshape(3, -1, len(grid))
        more = (2.0 * at - above - below) / width[:, None]  # of K below than above
        away = jnp.abs(depth[:, None] - interface[None, :]) / width[None, :]
        lifted = width[None, :] * jnp.maximum(1.0 - away, 0.0) ** 2
        relative *= jnp.exp(-0.25 * lifted @ more)
    surface = jnp.stack([values[f"Ed0_{wl:g}"] for wl in grid])
    return surface[None, :] * relative


@kept
def solve_cast(problem: CastProblem, start):
    """The optimum, its covariance and the model at the samples, NaN at those left out."""

    def residual(x, problem):
        return problem.residual(x)

    optimum = least_squares(residual, start, problem, problem.prior.scale)
    seen = problem.samples
    data = optimum.residual[: seen.Ed.size].reshape(seen.Ed.shape)
    model = jnp.where(seen.mask, seen.Ed - data * seen.sd, jnp.nan)
    return optimum, covariance(optimum.jacobian), model


@kept
def describe_cast(problem: CastProblem, x):
    """The quantities and their slopes: not of the search, so it compiles beside it."""
    return value_and_jacobian(problem.quantities, x)


@kept
def lights(layout: Parameters, grid, transports, x, depth):
    """(depth, wl) Ed through each transport."""
    return tuple(model_ed(layout, grid, transport, x, depth) for transport in transports)
