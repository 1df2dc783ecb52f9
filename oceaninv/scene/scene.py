"""A scene: water, light, surface, floor and objects.  A term that is None does not exist."""

from collections.abc import Iterable

import equinox as eqx
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation.interface_optics import fresnel_from_air, refracted_cosine
from oceaninv.scene.light import AbstractLamp, Light
from oceaninv.scene.objects import AbstractObject
from oceaninv.scene.waves import Waves
from oceaninv.water.inelastic import Inelastic
from oceaninv.water.iops import IOPs, Layers, check_concrete, check_scalar


class FlatSurface(eqx.Module):
    """An air-water interface that is flat on average.

    **Arguments:** `index`: refractive index of the water, >= 1; `waves`: they cause caustics on the
    floor; for everything else the surface is flat.  `None`: calm.
    """

    index: Float[Array, ""]
    waves: Waves | None

    def __init__(self, index=1.34, waves=None):
        check_scalar("index", index)
        check_concrete("index", index, 1.0, 2.0)
        self.waves = waves
        self.index = jnp.asarray(index, dtype=jnp.result_type(float, index))


class Floor(eqx.Module):
    """A horizontal Lambertian floor.

    **Arguments:**

    - `depth`: metres, > 0.
    - `reflectance`: (wl,) between 0 and 1.
    """

    depth: Float[Array, ""]
    reflectance: Float[Array, " wl"]

    def __init__(self, depth, reflectance):
        check_scalar("depth", depth)
        check_concrete("depth", depth, float(np.finfo(np.float32).tiny))
        check_concrete("reflectance", reflectance, 0.0, 1.0)
        self.reflectance = jnp.asarray(reflectance)
        self.depth = jnp.asarray(depth, dtype=self.reflectance.dtype)


def _each(things) -> tuple:
    return tuple(things) if isinstance(things, Iterable) else (things,)


def _check_types(*arguments) -> None:
    """ValueError for an argument of another kind, such as one that was swapped with its neighbour;
    each is (name, value, kinds)."""
    for name, value, kinds in arguments:
        if isinstance(value, kinds):
            continue
        wanted = " or ".join("None" if kind is type(None) else kind.__name__ for kind in kinds)
        wanted = {"AbstractObject": "a Sphere, Box or HeightField",
                  "AbstractLamp": "a PointLamp or SpotLamp"}.get(wanted, wanted)  # fmt: skip
        came = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
        raise ValueError(
            f"{name} must be {wanted}, but came as {came}; the order is Scene(water, light, "
            "surface, floor, objects, lamps, inelastic)."
        )


class Scene(eqx.Module):
    """Horizontally uniform water under a sun, with surface, floor, objects and lamps.

    **Arguments:**

    - `water`: `IOPs`, or `Layers` of them.
    - `light`: the sun and sky; its spectra are on the water's wavelengths.
    - `surface`: `FlatSurface` or `None` (light enters unrefracted, nothing is reflected back).
    - `floor`: `Floor` or `None` (endlessly deep water).
    - `objects`: solids, `Sphere`, `Box` or `HeightField`, under the surface.
    - `lamps`: `PointLamp` or `SpotLamp`, in the water.
    - `inelastic`: `Inelastic` processes, or `None`.

    Spectra whose length differs from the water's wavelengths raise ValueError, as do objects and
    lamps out of the water and arguments of another kind.
    """

    water: IOPs | Layers
    light: Light
    surface: FlatSurface | None
    floor: Floor | None
    objects: tuple[AbstractObject, ...]
    lamps: tuple[AbstractLamp, ...]
    inelastic: Inelastic | None

    def __init__(
        self, water, light, surface=None, floor=None, objects=(), lamps=(), inelastic=None
    ):
        objects, lamps = _each(objects), _each(lamps)
        _check_types(
            ("water", water, (IOPs, Layers)),
            ("light", light, (Light,)),
            ("surface", surface, (FlatSurface, type(None))),
            ("floor", floor, (Floor, type(None))),
            *((f"objects[{i}]", thing, (AbstractObject,)) for i, thing in enumerate(objects)),
            *((f"lamps[{i}]", lamp, (AbstractLamp,)) for i, lamp in enumerate(lamps)),
            ("inelastic", inelastic, (Inelastic, type(None))),
        )
        n = len(water.wavelength)
        for name, value in (
            ("light.direct", light.direct),
            ("floor.reflectance", None if floor is None else floor.reflectance),
            *((f"objects[{i}].reflectance", thing.reflectance) for i, thing in enumerate(objects)),
            *((f"lamps[{i}].intensity", lamp.intensity) for i, lamp in enumerate(lamps)),
        ):
            if value is not None and value.shape != (n,):
                raise ValueError(
                    f"{name} must have one value per wavelength of the water, shape ({n},), "
                    f"not {value.shape}."
                )
        self.water = water
        self.light = light
        self.surface = surface
        self.floor = floor
        self.objects = objects
        self.lamps = lamps
        self.inelastic = inelastic
        for i, thing in enumerate(objects):
            self._check_extent(f"objects[{i}]", *thing.extent())
        for i, lamp in enumerate(lamps):
            self._check_extent(f"lamps[{i}]", lamp.position[2], lamp.position[2])

    def _check_extent(self, name: str, top, bottom) -> None:
        """ValueError for a concrete object or lamp out of the water; it may be partly buried."""
        bounds = (top, bottom, None if self.floor is None else self.floor.depth)
        if any(isinstance(bound, jax.core.Tracer) for bound in bounds):
            return
        if float(top) < 0:
            raise ValueError(f"{name} reaches {-float(top):g} m above the surface (depth 0).")
        if self.floor is not None and float(top) >= float(self.floor.depth):
            raise ValueError(
                f"{name} begins at {float(top):g} m, below the floor at "
                f"{float(self.floor.depth):g} m."
            )

    @property
    def wavelength(self) -> np.ndarray:
        """(wl,) vacuum nm."""
        return self.water.wavelength

    def beam(self) -> tuple[Float[Array, ""], Float[Array, " wl"]]:
        """The sunbeam just below the surface: (cosine of its zenith, irradiance normal to it)."""
        cos_air = self.light.cosine
        if self.surface is None:
            return cos_air, self.light.direct
        index = self.surface.index.astype(cos_air.dtype)
        cos_water = refracted_cosine(cos_air, index)
        transmitted = 1.0 - fresnel_from_air(cos_air, index)
        return cos_water, self.light.direct * (transmitted * cos_air / cos_water)

    def check_depths(self, depths) -> None:
        """ValueError if a concrete depth lies above the surface or below the floor."""
        check_concrete("depths", depths)
        if self.floor is None or isinstance(depths, jax.core.Tracer):
            return
        if isinstance(self.floor.depth, jax.core.Tracer):
            return
        deepest = float(np.max(np.asarray(depths)))
        if deepest > float(self.floor.depth) * (1 + 1e-6):
            raise ValueError(
                f"depths reach {deepest:g} m, below the floor at {float(self.floor.depth):g} m."
            )
