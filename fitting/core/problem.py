"""The interface of a fit to searches and samplers: a residual, and quantities to report."""

import abc

import equinox as eqx
from jaxtyping import Array, Float

from fitting.core.parameters import Parameters


class AbstractProblem(eqx.Module):
    """A posterior: what a fit minimises and what it derives, as functions of the coordinates."""

    layout: eqx.AbstractVar[Parameters]

    @abc.abstractmethod
    def residual(self, x: Float[Array, " unknown"]) -> Float[Array, " residual"]:
        """Residuals of data and priors: the log density is -|residual|^2 / 2 plus a constant."""

    @abc.abstractmethod
    def quantities(self, x: Float[Array, " unknown"]) -> dict[str, Array]:
        """Derived quantities by name."""
