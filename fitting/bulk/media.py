"""Models of media: unknowns to absorption and scattering, by Lorenz-Mie theory."""

import abc
import math
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from fitting.core.parameters import Identity, Parameter
from oceaninv.mie import media, particles
from oceaninv.water import pure_water

Values = Mapping[str, Float[Array, ""]]
_DECADES = 2.3


class AbstractMedium(eqx.Module):
    """A model of a medium: named unknowns, and the absorption and scattering that they cause."""

    @abc.abstractmethod
    def unknowns(self) -> tuple[Parameter, ...]:
        """The unknowns with their priors."""

    @abc.abstractmethod
    def coefficients(
        self, values: Values, wavelength: Float[np.ndarray, " wl"]
    ) -> tuple[Float[Array, " wl"], Float[Array, " wl"]]:
        """(a, b) in 1/m at concrete wavelengths (nm), differentiable in `values`."""


class Milk(AbstractMedium):
    """Milk by its wt-% of fat and protein (`oceaninv.media.milk`).

    Nuisances, each a factor on what the recipe fixes and dairies do not:

    - `globule_size`: on r_43 of the fat globules, which homogenisation halves or more (Olson et
      al. 2004); 30 %.
    - `micelle_size`: on r_vs of the casein micelles, 43 nm in Schmidt et al. (1973); 15 %.  At a
      given volume they scatter as r^2 to r^3: protein is known no better than that allows.
    - `riboflavin`: on the absorption of the host, which vitamin B2 dominates; 30 %.
    """

    radii: int = eqx.field(static=True, default=60)

    def unknowns(self) -> tuple[Parameter, ...]:
        return (
            Parameter("fat", 2.0, _DECADES, unit="g/(100 g)"),
            Parameter("protein", 3.0, _DECADES, unit="g/(100 g)"),
            Parameter("globule_size", 1.0, 0.3, nuisance=True),
            Parameter("micelle_size", 1.0, 0.15, nuisance=True),
            Parameter("riboflavin", 1.0, 0.3, nuisance=True),
        )

    def coefficients(self, values, wavelength):
        medium = media.milk(values["fat"], values["protein"], radii=self.radii)
        globules, micelles = medium.inclusions
        globules = eqx.tree_at(
            lambda i: i.sizes.log_median,
            globules,
            replace_fn=lambda median: median + jnp.log(values["globule_size"]),
        )
        micelles = eqx.tree_at(
            lambda i: i.sizes.mean, micelles, replace_fn=lambda mean: mean * values["micelle_size"]
        )
        host = medium.host_index(wavelength)
        own = particles.absorption_from_index(np.imag(host), wavelength)
        populations = [i.population(wavelength, self.radii) for i in (globules, micelles)]
        a, b = _totals(populations, wavelength, host)
        return a + values["riboflavin"] * own, b


def _totals(
    populations: Sequence[particles.Population], wavelength: np.ndarray, host
) -> tuple[Float[Array, " wl"], Float[Array, " wl"]]:
    """(a, b) of populations, without their host."""
    first, *others = [p.bulk(wavelength, host) for p in populations]
    return sum((p.a for p in others), start=first.a), sum((p.b for p in others), start=first.b)


class NaturalWater(AbstractMedium):
    """Algae and minerals in sea water (`oceaninv.media.natural_water`), with dissolved colour.

    - `total`: whether the readings hold the water itself.  False for instruments that are
      calibrated in pure water (AC-9, ac-s).
    - `cdom`: whether coloured dissolved matter is an unknown: a = cdom e^(-slope (wl - 440 nm)).

    Unknowns: volume fractions `algae` and `minerals`, `cdom` at 440 nm (1/m).  Nuisances: the
    exponents of both power laws of sizes, 0.3 about those of the recipe; factors on the
    imaginary parts of both indices, whose tables are examples (pigment per cell and iron per grain
    vary several-fold); the slope of CDOM.
    """

    total: bool = eqx.field(static=True, default=True)
    cdom: bool = eqx.field(static=True, default=True)
    radii: int = eqx.field(static=True, default=60)

    def unknowns(self) -> tuple[Parameter, ...]:
        found = [
            Parameter("algae", 5e-7, _DECADES),
            Parameter("minerals", 3e-7, _DECADES),
            Parameter("algae_exponent", 3.6, 0.3, Identity(), nuisance=True),
            Parameter("mineral_exponent", 3.4, 0.3, Identity(), nuisance=True),
            Parameter("algae_absorption", 1.0, 0.5, nuisance=True),
            Parameter("mineral_absorption", 1.0, 0.7, nuisance=True),
        ]
        if self.cdom:
            found.append(Parameter("cdom", 0.05, _DECADES, unit="m-1"))
            found.append(Parameter("cdom_slope", 0.0176, 0.25, unit="nm-1", nuisance=True))
        return tuple(found)

    def coefficients(self, values, wavelength):
        medium = media.natural_water(
            algae=values["algae"], minerals=values["minerals"], radii=self.radii
        )
        populations = []
        for inclusion, kind in zip(medium.inclusions, ("algae", "mineral"), strict=True):
            population = inclusion.population(wavelength, self.radii)
            index = jax.lax.complex(
                jnp.real(population.index),
                jnp.imag(population.index) * values[f"{kind}_absorption"],
            )
            populations.append(
                eqx.tree_at(
                    lambda p: (p.index, p.sizes.exponent),
                    population,
                    (index, values[f"{kind}_exponent"]),
                )
            )
        host = medium.host_index(wavelength)
        a, b = _totals(populations, wavelength, host)
        if self.total:
            own = particles.absorption_from_index(np.imag(host), wavelength)
            a, b = a + own, b + jnp.asarray(pure_water.scattering(wavelength), b.dtype)
        if self.cdom:
            distance = jnp.asarray(wavelength - 440.0, a.dtype)
            a = a + values["cdom"] * jnp.exp(-values["cdom_slope"] * distance)
        return a, b


class Populations(AbstractMedium):
    """Populations of spheres in a host, by name.

    Unknown of each: `<name>_fraction` of the volume, within decades of the one given.  With
    `sizes` also, as nuisances, what its distribution has: `<name>_exponent` of a power law (0.3
    about the one given); `<name>_mean` (r_43, um; 50 %) and `<name>_cv` (30 %) of a log-normal.
    The limits of the radii are fixed: choose them wide enough.  To change a prior, exchange its
    `Parameter`.
    """

    populations: dict[str, particles.Population]
    host_index: Num[Array, "..."]
    sizes: bool = eqx.field(static=True)

    def __init__(
        self,
        populations: Mapping[str, particles.Population] | Sequence[particles.Population],
        host_index: Num[ArrayLike, "..."],
        sizes: bool = True,
    ):
        """A sequence gets the names population_1, population_2, ...; host_index: n + ik."""
        if not isinstance(populations, Mapping):
            populations = {f"population_{i + 1}": p for i, p in enumerate(populations)}
        if not populations:
            raise ValueError("populations must hold at least one population.")
        for name, population in populations.items():
            if not isinstance(population, particles.Population):
                raise ValueError(
                    f"{name} must be an oceaninv.particles.Population, not "
                    f"{type(population).__name__}."
                )
            if not float(population.volume_fraction) > 0:
                raise ValueError(
                    f"volume_fraction of {name} must be positive: the search starts there."
                )
        self.populations = dict(populations)
        self.host_index = jnp.asarray(host_index)
        self.sizes = sizes

    def unknowns(self) -> tuple[Parameter, ...]:
        found = []
        for name, population in self.populations.items():
            fraction = float(population.volume_fraction)
            found.append(Parameter(f"{name}_fraction", fraction, _DECADES))
            if self.sizes:
                found += _size_unknowns(name, population.sizes)
        return tuple(found)

    def coefficients(self, values, wavelength):
        populations = [
            eqx.tree_at(
                lambda p: (p.volume_fraction, p.sizes),
                population,
                (values[f"{name}_fraction"], self._sizes(name, population.sizes, values)),
            )
            for name, population in self.populations.items()
        ]
        bulk = particles.medium(wavelength, self.host_index, populations)
        return bulk.a, bulk.b

    def _sizes(self, name: str, sizes: particles.AbstractSizes, values: Values):
        if self.sizes and isinstance(sizes, particles.PowerLaw):
            return particles.PowerLaw(values[f"{name}_exponent"], sizes.minimum, sizes.maximum)
        if self.sizes and isinstance(sizes, particles.LogNormal):
            return particles.LogNormal(
                values[f"{name}_mean"],
                values[f"{name}_cv"],
                minimum=sizes.minimum,
                maximum=sizes.maximum,
            )
        return sizes


def _size_unknowns(name: str, sizes: particles.AbstractSizes) -> list[Parameter]:
    if isinstance(sizes, particles.PowerLaw):
        exponent = float(sizes.exponent)
        return [Parameter(f"{name}_exponent", exponent, 0.3, Identity(), nuisance=True)]
    if isinstance(sizes, particles.LogNormal):
        cv = math.sqrt(math.expm1(float(sizes.log_width) ** 2))
        return [
            Parameter(f"{name}_mean", float(sizes.mean()), 0.5, unit="um", nuisance=True),
            Parameter(f"{name}_cv", cv, 0.3, nuisance=True),
        ]
    return []
