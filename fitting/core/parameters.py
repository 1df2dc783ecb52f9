"""Unknowns of a fit: names, transforms to the real line, priors."""

import abc
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class AbstractTransform(abc.ABC):
    """A monotonic map from the real line, where the solver works, to the physical range."""

    @abc.abstractmethod
    def physical(self, x: Any) -> Any:
        """Physical value of the coordinate x, numpy or JAX."""

    @abc.abstractmethod
    def coordinate(self, value: float) -> float:
        """Coordinate of a concrete physical value."""


@dataclasses.dataclass(frozen=True)
class Identity(AbstractTransform):
    """Any real number; a spread is in the parameter's own unit."""

    def physical(self, x: Any) -> Any:
        return x

    def coordinate(self, value: float) -> float:
        return float(value)


@dataclasses.dataclass(frozen=True)
class Log(AbstractTransform):
    """Positive numbers; a spread is of the natural logarithm (0.1 is about 10 %)."""

    def physical(self, x: Any) -> Any:
        # Values beyond e^+-46 are not physical and overflow float32: limit the solver's trials.
        return jnp.exp(jnp.clip(x, -46.0, 46.0)) if isinstance(x, jax.Array) else np.exp(x)

    def coordinate(self, value: float) -> float:
        if not value > 0:
            raise ValueError(f"a parameter on a log scale must be positive, not {value:g}.")
        return math.log(value)


@dataclasses.dataclass(frozen=True)
class Logit(AbstractTransform):
    """Numbers between two bounds; a spread is of the log-odds."""

    low: float
    high: float

    def physical(self, x: Any) -> Any:
        odds = jax.nn.sigmoid(x) if isinstance(x, jax.Array) else 1.0 / (1.0 + np.exp(-x))
        return self.low + (self.high - self.low) * odds

    def coordinate(self, value: float) -> float:
        if not self.low < value < self.high:
            raise ValueError(f"{value:g} is not between {self.low:g} and {self.high:g}.")
        return math.log((value - self.low) / (self.high - value))


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One unknown.

    - `name`, `unit`: for tables and files.
    - `centre`: physical value at which the prior is centred and the search starts.
    - `spread`: standard deviation of the prior in the transform's coordinate; `None` is flat.
    - `nuisance`: it is not asked for, but its uncertainty must widen the intervals of others.
    - What it belongs to, where it belongs to one of several: `layer` of water, from 1 at the top;
      `photograph` and `chart` of it, from 0; `channel` of the camera; `wavelength`, nm.
    - `kind`: what it is, without what it belongs to ("cdom" of cdom_2); its name unless given.
    """

    name: str
    centre: float
    spread: float | None = None
    transform: AbstractTransform = Log()
    unit: str = "1"
    nuisance: bool = False
    kind: str = ""
    layer: int | None = None
    photograph: int | None = None
    chart: int | None = None
    channel: str | None = None
    wavelength: float | None = None

    def __post_init__(self):
        if not self.kind:
            object.__setattr__(self, "kind", self.name)
        self.transform.coordinate(self.centre)
        if self.spread is not None and not self.spread > 0:
            raise ValueError(f"spread of {self.name} must be positive or None, not {self.spread}.")


class Prior(eqx.Module):
    """The numbers of a set of priors: arrays, so that one program serves all their values.

    `centre`: coordinates; `weight`: 1/spread, 0 where flat; `scale`: expected size of each
    coordinate's change, the spread or 1 where flat.
    """

    centre: Float[Array, " unknown"]
    weight: Float[Array, " unknown"]
    scale: Float[Array, " unknown"]

    def residual(self, x: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """(x - centre)/spread, 0 where the prior is flat."""
        return (x - self.centre) * self.weight


class Parameters(tuple[Parameter, ...]):
    """An ordered set of unknowns, and the vector of their coordinates."""

    def __new__(cls, parameters: Sequence[Parameter]):
        names = [p.name for p in parameters]
        if len(set(names)) != len(names):
            raise ValueError(f"parameter names must differ: {', '.join(names)}.")
        return super().__new__(cls, parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(p.name for p in self)

    def values(self, x: Float[Array, " unknown"]) -> dict[str, Float[Array, ""]]:
        """Physical values by name."""
        return {p.name: p.transform.physical(x[i]) for i, p in enumerate(self)}

    def prior(self) -> Prior:
        """Centres and spreads as arrays; the search starts at the centres."""
        spreads = [p.spread for p in self]
        rows = (
            [p.transform.coordinate(p.centre) for p in self],
            [0.0 if s is None else 1.0 / s for s in spreads],
            [1.0 if s is None else s for s in spreads],
        )
        return Prior(*jax.device_put([np.asarray(row, dtype=float) for row in rows]))

    def layout(self) -> "Parameters":
        """Names and transforms alone: what a compiled program depends on."""
        return Parameters(
            [
                Parameter(p.name, float(p.transform.physical(np.float64(0.0))), None, p.transform)
                for p in self
            ]
        )

    def replace(self, changes: Mapping[str, Parameter]) -> "Parameters":
        """The same set with some parameters exchanged by name.

        The new ones belong to the layer, photograph, ... of those that they replace.
        """
        for name in changes:
            if name not in self.names:
                from oceaninv.foundation.tables import unknown

                raise unknown("parameter", name, sorted(self.names))
        return Parameters([_placed(changes[p.name], p) if p.name in changes else p for p in self])


def _placed(new: Parameter, old: Parameter) -> Parameter:
    """The new parameter in the place of the old one."""
    places = ("kind", "layer", "photograph", "chart", "channel", "wavelength")
    return dataclasses.replace(new, **{name: getattr(old, name) for name in places})
