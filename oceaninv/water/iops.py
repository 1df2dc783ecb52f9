"""Inherent optical properties of water, which do not depend on the light field."""

from collections.abc import Iterable

import equinox as eqx
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation.numerics import safe_ratio
from oceaninv.foundation.tables import check_wavelength
from oceaninv.water.phase import AbstractPhase, backscatter_ratio_of, moments_of


def check_concrete(name: str, value, low: float = 0.0, high: float = np.inf) -> None:
    """ValueError unless a concrete `value` is finite and inside [low, high]; traced values pass."""
    if isinstance(value, jax.core.Tracer):
        return
    array = np.asarray(value)
    bad = ~np.isfinite(array) | (array < low) | (array > high)
    if bad.any():
        wanted = f"at least {low:g}" if np.isinf(high) else f"between {low:g} and {high:g}"
        first = array[bad].reshape(-1)[0]
        raise ValueError(
            f"{name} must be finite and {wanted}; {int(bad.sum())} of {array.size} values are not "
            f"(the first is {first:g})."
        )


def check_scalar(name: str, value) -> None:
    """ValueError unless `value`, traced or not, is one number."""
    if np.ndim(value):
        raise ValueError(
            f"{name} must be one number, not an array of shape {np.shape(value)}: for many, build "
            "them one by one or inside jax.vmap."
        )


class IOPs(eqx.Module):
    """Absorption and scattering of a homogeneous water, by component.

    **Arguments:**

    - `wavelength`: (wl,) vacuum nm, strictly increasing, concrete.
    - `a_components`: (component, wl) absorption coefficients in 1/m, or (wl,) for a total.
    - `b_components`: (shape, wl) scattering coefficients in 1/m, one row per phase function, or
      (wl,) for a total.
    - `phases`: one phase function per row of `b_components`.  Shapes are fixed: a phase function
      that varies with wavelength is written as a mixture of shapes.
    - `absorbers`, `scatterers`: names of the rows, for reports and for inelastic terms.

    Negative or non-finite concrete coefficients raise ValueError.
    """

    a_components: Float[Array, "component wl"]
    b_components: Float[Array, "shape wl"]
    phases: tuple[AbstractPhase, ...]
    grid: tuple[float, ...] = eqx.field(static=True)
    absorbers: tuple[str, ...] = eqx.field(static=True)
    scatterers: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self, wavelength, a_components, b_components, phases, absorbers=None, scatterers=None
    ):
        wavelength = check_wavelength(wavelength)
        phases = (phases,) if isinstance(phases, AbstractPhase) else tuple(phases)
        a, b = jnp.asarray(a_components), jnp.asarray(b_components)
        # atleast_2d would compile for every shape, even where it changes nothing.
        a, b = (v if v.ndim == 2 else jnp.atleast_2d(v) for v in (a, b))
        for name, value in (("a_components", a), ("b_components", b)):
            if value.ndim != 2 or value.shape[1] != len(wavelength):
                raise ValueError(
                    f"{name} must have shape (rows, {len(wavelength)}) to match wavelength, "
                    f"not {value.shape}."
                )
            check_concrete(name, value)
        if len(phases) != b.shape[0]:
            raise ValueError(
                f"phases must hold one phase function per row of b_components: {b.shape[0]} rows, "
                f"{len(phases)} phases."
            )
        self.grid = tuple(wavelength.tolist())
        self.a_components = a
        self.b_components = b
        self.phases = phases
        self.absorbers = tuple(absorbers or (f"a{i}" for i in range(a.shape[0])))
        self.scatterers = tuple(scatterers or (f"b{i}" for i in range(b.shape[0])))
        if len(self.absorbers) != a.shape[0] or len(self.scatterers) != b.shape[0]:
            raise ValueError("absorbers and scatterers must name every row of their components.")

    @property
    def wavelength(self) -> np.ndarray:
        """(wl,) vacuum nm, concrete also inside jit."""
        return np.asarray(self.grid)

    @property
    def a(self) -> Float[Array, " wl"]:
        """Total absorption coefficient, 1/m."""
        return jnp.sum(self.a_components, axis=0)

    @property
    def b(self) -> Float[Array, " wl"]:
        """Total scattering coefficient, 1/m."""
        return jnp.sum(self.b_components, axis=0)

    @property
    def c(self) -> Float[Array, " wl"]:
        """Beam attenuation coefficient a + b, 1/m."""
        return self.a + self.b

    @property
    def bb(self) -> Float[Array, " wl"]:
        """Backscattering coefficient, 1/m."""
        ratios = jnp.stack(
            [jnp.asarray(backscatter_ratio_of(p), self.b_components.dtype) for p in self.phases]
        )
        return ratios @ self.b_components

    @property
    def albedo(self) -> Float[Array, " wl"]:
        """Single-scattering albedo b/c, 0 in a vacuum."""
        return safe_ratio(self.b, self.c)

    def scattering_moments(self, order: int) -> Float[Array, "moment wl"]:
        """b times the Legendre moments 0..order of the total phase function, 1/m (no division)."""
        dtype = self.b_components.dtype
        moments = jnp.stack([jnp.asarray(moments_of(p, order), dtype) for p in self.phases])
        return moments.T @ self.b_components

    def volume_scattering(self, cos_theta: Float[Array, " ray"]) -> Float[Array, "ray wl"]:
        """Volume scattering function beta(theta) in 1/m/sr."""
        dtype = self.b_components.dtype
        shapes = jnp.stack([jnp.asarray(p(cos_theta), dtype) for p in self.phases], axis=-1)
        return shapes @ self.b_components

    def __add__(self, other: "IOPs") -> "IOPs":
        """A water with the components of both."""
        if self.grid != other.grid:
            raise ValueError("only IOPs on the same wavelengths can be added.")
        return IOPs(
            self.wavelength,
            jnp.concatenate([self.a_components, other.a_components]),
            jnp.concatenate([self.b_components, other.b_components]),
            self.phases + other.phases,
            self.absorbers + other.absorbers,
            self.scatterers + other.scatterers,
        )


class Layers(eqx.Module):
    """Horizontally uniform water in layers.

    **Arguments:**

    - `interfaces`: (layer-1,) depths in metres that divide the layers, increasing.
    - `iops`: one `IOPs` per layer from the surface down, all on the same wavelengths.
    """

    interfaces: Float[Array, " interface"]
    iops: tuple[IOPs, ...]

    def __init__(self, interfaces, iops):
        several = isinstance(iops, Iterable)
        iops = tuple(iops) if several else ()
        if not several or not all(isinstance(water, IOPs) for water in iops):
            raise ValueError(
                "iops must be a sequence of IOPs, one for each layer from the surface down: "
                "Layers(interfaces, iops), first the depths, then the waters."
            )
        self.interfaces = jnp.asarray(interfaces)
        self.iops = iops
        if self.interfaces.ndim != 1 or len(self.iops) != self.interfaces.shape[0] + 1:
            raise ValueError(
                f"interfaces must have one entry fewer than iops: got shape "
                f"{self.interfaces.shape} for {len(self.iops)} layers."
            )
        if len({water.grid for water in self.iops}) != 1:
            raise ValueError("all layers must share the same wavelengths.")
        check_concrete("interfaces", self.interfaces)
        if not isinstance(self.interfaces, jax.core.Tracer) and np.any(
            np.diff(np.asarray(self.interfaces)) <= 0
        ):
            raise ValueError("interfaces must increase with depth.")

    @property
    def wavelength(self) -> np.ndarray:
        """(wl,) vacuum nm."""
        return self.iops[0].wavelength
