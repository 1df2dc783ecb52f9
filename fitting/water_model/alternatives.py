"""Fixed assumptions of the water model, and alternatives to them.

Each alternative is a coordinate of its own, named `assumed_<alternative>`: 0 is the model as it
is, 1 the alternative.  Waters without such coordinates are computed without the alternatives.
"""

import functools
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv import IOPs
from oceaninv.foundation.tables import load
from oceaninv.water import phase, pure_water
from oceaninv.water.bio_optics import particle_phase

_TABLES = ("PopeFry1997", "WOPPv3", "SmithBaker1981")
# Factors on the ratio bb/b of algae and of other particles: 0.005 and 0.025.
_SPLIT = (0.5, 1.4)
# Exponent of a ratio bb/b that falls with wavelength.
_SLANT = 0.5

# The alternatives by name.
ALTERNATIVES = {
    **{f"a_w_{name}": f"absorption of pure water by {name}, not IOCCG2018" for name in _TABLES},
    "b_w_Morel1974": "scattering of pure sea water by Morel1974, not Zhang2009",
    "algae_Sathyendranath1987": "one spectrum of algal absorption, not one for every chlorophyll",
    "phase_Petzold1972": "particles scatter like Petzold's average as far as their bb/b allows",
    "backscatter_split": "bb/b 0.005 of algae, 0.025 of other particles, not 0.010 and 0.018",
    "backscatter_slant": "bb/b of particles falls as wavelength^-0.5, not constant",
}
PREFIX = "assumed_"

Values = Mapping[str, Float[Array, ""]]


def ratios(values: Values) -> tuple[Array | float, Array | float]:
    """bb/b of algae and of other particles, before the factor that a fit may leave free."""
    share = values.get(PREFIX + "backscatter_split")
    if share is None:
        return 0.010, 0.018
    algae, other = (jnp.asarray(factor, share.dtype) ** share for factor in _SPLIT)
    return 0.010 * algae, 0.018 * other


def assumed(iops: IOPs, values: Values) -> IOPs:
    """The same water with whichever alternatives `values` names."""
    grid = iops.wavelength
    for name in _TABLES:
        share = values.get(f"{PREFIX}a_w_{name}")
        if share is not None:
            other = pure_water.absorption(grid, name) - pure_water.absorption(grid)
            iops = _added(iops, "a_components", share * jnp.asarray(other, share.dtype))
    share = values.get(PREFIX + "b_w_Morel1974")
    if share is not None:
        other = pure_water.scattering(grid, "Morel1974") - pure_water.scattering(grid)
        iops = _added(iops, "b_components", share * jnp.asarray(other, share.dtype))
    share = values.get(PREFIX + "algae_Sathyendranath1987")
    if share is not None and "chlorophyll" in iops.absorbers:
        iops = _one_spectrum(iops, share)
    share = values.get(PREFIX + "backscatter_slant")
    if share is not None:
        iops = _slanted(iops, share)
    share = values.get(PREFIX + "phase_Petzold1972")
    return iops if share is None else _petzold(iops, share)


def _added(iops: IOPs, rows: str, change) -> IOPs:
    # The first row is pure water's.
    now = getattr(iops, rows)
    return eqx.tree_at(lambda i: getattr(i, rows), iops, now.at[0].add(change))


def _one_spectrum(iops: IOPs, share) -> IOPs:
    grid, row = iops.wavelength, iops.absorbers.index("chlorophyll")
    algae = iops.a_components[row]
    shape = load("Gutierrez2008").at(grid, "a_phytoplankton")
    mark = np.array([440.0])
    at_440 = jnp.interp(jnp.asarray(mark, algae.dtype), jnp.asarray(grid, algae.dtype), algae)
    other = at_440 * jnp.asarray(
        shape / load("Gutierrez2008").at(mark, "a_phytoplankton"), algae.dtype
    )
    changed = iops.a_components.at[row].add(share * (other - algae))
    return eqx.tree_at(lambda i: i.a_components, iops, changed)


@functools.cache
def _average() -> phase.AbstractPhase:
    with jax.ensure_compile_time_eval():
        return phase.petzold()


@functools.cache
def _ratios() -> tuple[float, float, float]:
    """bb/b of the two shapes that particles are mixed of, and of Petzold's average."""
    with jax.ensure_compile_time_eval():
        shapes = (*particle_phase(0.01).phases, _average())
        low, high, average = (float(phase.backscatter_ratio_of(shape)) for shape in shapes)
    return low, high, average


def _particles(iops: IOPs) -> tuple[int, int]:
    """Rows of the two shapes that particles are mixed of."""
    # Found by their type: every change of the water makes new objects.
    low, high = (i for i, p in enumerate(iops.phases) if isinstance(p, phase.FournierForand))
    return low, high


def _slanted(iops: IOPs, share) -> IOPs:
    (low, high), (least, most, _) = _particles(iops), _ratios()
    b = iops.b_components
    total = b[low] + b[high]
    factor = jnp.asarray(550.0 / iops.wavelength, b.dtype) ** (_SLANT * share)
    asked = factor * (least * b[low] + most * b[high])
    up = jnp.clip((asked - least * total) / (most - least), 0.0, total)
    changed = b.at[low].set(total - up).at[high].set(up)
    return eqx.tree_at(lambda i: i.b_components, iops, changed)


def _petzold(iops: IOPs, share) -> IOPs:
    """The largest share of the average phase function that keeps b and bb, the rest as before."""
    (low, high), (least, most, ratio) = _particles(iops), _ratios()
    b, other = iops.b_components, _average()
    # An amount p of the average takes the place of these amounts of the two shapes.
    of_high = (ratio - least) / (most - least)
    p = share * jnp.minimum(b[low] / (1.0 - of_high), b[high] / of_high)
    changed = b.at[low].add(-(1.0 - of_high) * p).at[high].add(-of_high * p)
    return IOPs(
        iops.wavelength,
        iops.a_components,
        jnp.concatenate([changed, p[None]]),
        (*iops.phases, other),
        iops.absorbers,
        (*iops.scatterers, "average particle"),
    )
