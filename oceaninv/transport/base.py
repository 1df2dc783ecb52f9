"""The interface of every transport, and the form of its results."""

import abc
import warnings
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from oceaninv.foundation.interface_optics import Rays
from oceaninv.scene.scene import Scene
from oceaninv.water.iops import IOPs


class Estimate(eqx.Module):
    """A computed quantity and its error, as far as that is known.

    - `value`: the quantity.
    - `stderr`: standard error of a random estimate; 0 for a deterministic one.
    - `bias`: bound on the part that was neglected or truncated; nan where no bound is known.
    """

    value: Float[Array, "..."]
    stderr: Float[Array, "..."]
    bias: Float[Array, "..."]


def deterministic(value: Float[Array, "..."]) -> Estimate:
    """An estimate without random error and without a bound on its bias."""
    return Estimate(value, jnp.zeros_like(value), jnp.full_like(value, jnp.nan))


class Irradiance(eqx.Module):
    """Irradiances at depths, each an `Estimate` of shape (depth, wl), in the light's unit.

    - `Ed`, `Eu`: downward and upward plane irradiance.
    - `E0`: scalar irradiance (all directions).
    """

    Ed: Estimate
    Eu: Estimate
    E0: Estimate


def homogeneous(scene: Scene) -> IOPs:
    """The water of a scene that has only one; ValueError for `Layers`."""
    if not isinstance(scene.water, IOPs):
        raise ValueError(
            "this closed form solves one homogeneous water, not Layers: take PlaneParallel or "
            "MonteCarlo (on the command line --transport plane-parallel)."
        )
    return scene.water


class AbstractTransport(eqx.Module):
    """A model of the light field; its fields set its accuracy.

    Subclasses are final; call them through the front ends `radiance`, `irradiance` and
    `photograph`, which check their input.

    `draws_objects`: whether it honours the objects and lamps of a scene by itself.
    `inelastic`: whether it honours its inelastic processes.
    `in_pieces`: whether a ray costs the same in a small batch as in a large one, so that pictures
    can be computed in pieces that fit the memory.
    `any_sky`: whether it honours a sky that is not uniform.
    """

    draws_objects: ClassVar[bool] = False
    inelastic: ClassVar[bool] = False
    in_pieces: ClassVar[bool] = False
    any_sky: ClassVar[bool] = False

    @abc.abstractmethod
    def radiance(self, scene: Scene, rays: Rays, key: Key[Array, ""] | None) -> Estimate:
        """Radiance that reaches the eye along each ray, (ray, wl); see `oceaninv.radiance`."""

    @abc.abstractmethod
    def irradiance(
        self, scene: Scene, depths: Float[Array, " depth"], key: Key[Array, ""] | None
    ) -> Irradiance:
        """Irradiances at depths; see `oceaninv.irradiance`."""


def inelastic_orders_of(inelastic_orders: int, generations: int | None) -> int:
    """`inelastic_orders`, or the argument `generations`, its former name, if that is given."""
    if generations is None:
        return inelastic_orders
    warnings.warn("generations is now inelastic_orders.", DeprecationWarning, stacklevel=5)
    return generations


def check_transport(transport) -> None:
    """ValueError for what is no transport, such as its class."""
    if isinstance(transport, type):
        raise ValueError(
            f"transport is the class {transport.__name__}: write {transport.__name__}(), with its "
            "arguments where it has any."
        )
    if not isinstance(transport, AbstractTransport):
        raise ValueError(
            f"transport is {transport!r:.80}; it must be a model such as oi.TwoStream() or "
            "oi.PlaneParallel(16)."
        )
    base = getattr(transport, "base", None)
    if base is not None:
        check_transport(base)
