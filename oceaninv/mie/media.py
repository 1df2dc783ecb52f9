"""Media made of particles in a host, after Frisvad, Christensen & Jensen (2007), section 4.

A `Medium` names its substances and the share of the volume that each fills; at given wavelengths
it gives bulk coefficients, an effective index, or the `IOPs` that every transport accepts.  The
printed numbers are used where they are right (ERRATA.md lists the exceptions).
"""

import itertools
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, ScalarLike

from oceaninv.foundation.numerics import linear_interpolation_matrix
from oceaninv.foundation.tables import Wavelengths, check_wavelength, unknown
from oceaninv.mie import _frisvad2007_table, particles
from oceaninv.mie._arguments import is_traced
from oceaninv.water.iops import IOPs
from oceaninv.water.phase import AbstractPhase, HenyeyGreenstein, Mixture, Tabulated

# Volume fractions of algae and minerals of table 1, after Babin et al. (2003).
SEAS = {
    "Atlantic": (1.880e-7, 2.477e-10),
    "Baltic": (1.904e-6, 5.429e-7),
    "Channel": (4.999e-7, 2.300e-7),
    "Mediterranean": (3.878e-7, 3.075e-7),
    "North Sea": (2.171e-6, 2.077e-6),
}

# Angles of tabulated phase functions (degrees): dense in the forward peak, 3 degrees at most.
_ANGLES = np.concatenate([[0.0], np.geomspace(0.02, 10.0, 55), np.arange(12.0, 181.0, 3.0)])


class Inclusion(eqx.Module):
    """One kind of particle: its substance, sizes and share of the volume."""

    substance: str = eqx.field(static=True)
    sizes: particles.AbstractSizes
    volume_fraction: Float[Array, ""]

    def __init__(self, substance: str, sizes: particles.AbstractSizes, volume_fraction: ScalarLike):
        """substance: a column of appendix C, "casein" or "air"; volume_fraction: 0 ... 1."""
        if not is_traced(volume_fraction) and not 0 <= float(np.asarray(volume_fraction)) <= 1:
            raise ValueError(
                f"the volume fraction of {substance} must be between 0 and 1; it is "
                f"{volume_fraction}."
            )
        self.substance, self.sizes = substance, sizes
        self.volume_fraction = jnp.asarray(volume_fraction, dtype=float)

    def population(self, wavelength: np.ndarray, radii: int) -> particles.Population:
        """The population at these wavelengths."""
        index = _index(self.substance, wavelength)
        return particles.Population(index, self.sizes, self.volume_fraction, radii)


def _index(substance: str, wavelength: np.ndarray) -> np.ndarray:
    # Casein only scatters (section 4.1), and air neither absorbs nor refracts.
    if substance in ("casein", "air"):
        return np.full(wavelength.shape, 1.503 + 0j if substance == "casein" else 1.0 + 0j)
    return _frisvad2007_table.index(substance, wavelength)


class Medium(eqx.Module):
    """Inclusions in a host.

    `radii` sets the accuracy of every population (see `particles.Population`).
    """

    host: str = eqx.field(static=True)
    inclusions: tuple[Inclusion, ...]
    radii: int = eqx.field(static=True)

    def host_index(self, wavelength: Wavelengths) -> Complex[np.ndarray, " wl"]:
        """Index of the host at concrete wavelengths (nm), 375-775."""
        return _index(self.host, check_wavelength(wavelength))

    def bulk(self, wavelength: Wavelengths) -> particles.Bulk:
        """a, b, g, ... of host and inclusions together at concrete wavelengths (nm)."""
        wavelength = check_wavelength(wavelength)
        populations = [i.population(wavelength, self.radii) for i in self.inclusions]
        return particles.medium(wavelength, self.host_index(wavelength), populations)

    def effective_index(self, wavelength: Wavelengths) -> Complex[Array, " wl"]:
        """Index of the medium as a whole (eq 33, corrected, and eq 6)."""
        host = self.host_index(wavelength)
        return particles.effective_index(wavelength, host, self.bulk(wavelength))

    def iops(
        self,
        wavelength: Wavelengths,
        shapes: int = 3,
        fit: Callable[[Tabulated], AbstractPhase] | None = None,
    ) -> IOPs:
        """The medium as `IOPs`: one absorption row, and `shapes` scattering rows per inclusion.

        The phase function of each inclusion is computed at `shapes` wavelengths spread evenly over
        the grid, and every other wavelength mixes its two neighbours; weights are never negative
        and every shape is fixed, as transports require.  More shapes cost more and mix better:
        over 400-700 nm the North Sea's bb/b is within 3 % with 2 shapes and 1 % with 3, its phase
        function within 2 % on average (`tests/oceaninv/mie/test_media.py`).  `fit` replaces each
        shape by a simpler function, for example `fit_lobes`: three Henyey-Greenstein lobes of the
        same mean cosine.

        Scattering by the host's molecules is not part of it.
        """
        wavelength = check_wavelength(wavelength)
        if not 1 <= shapes <= max(len(wavelength), 2):
            raise ValueError(
                f"shapes must be between 1 and the number of wavelengths; it is {shapes}."
            )
        host = self.host_index(wavelength)
        populations = [i.population(wavelength, self.radii) for i in self.inclusions]
        total = particles.medium(wavelength, host, populations)
        anchors, mixing = _anchors(wavelength, shapes)
        rows, phases, names = [], [], []
        for inclusion, population in zip(self.inclusions, populations, strict=True):
            b = population.bulk(wavelength, host).b
            rows.append(jnp.asarray(mixing.T, b.dtype) * b[None, :])
            tables = _phases(_some(inclusion).population(anchors, self.radii), anchors, self.host)
            phases.extend(tables if fit is None else map(fit, tables))
            names.extend(f"{inclusion.substance} {anchor:g} nm" for anchor in anchors)
        return IOPs(
            wavelength, total.a[None, :], jnp.concatenate(rows), phases, (self.host,), names
        )


def _some(inclusion: Inclusion) -> Inclusion:
    """The inclusion, or a trace of it if it has no volume: the phase function is the same."""
    fraction = inclusion.volume_fraction
    if is_traced(fraction) or float(np.asarray(fraction)) > 0:
        return inclusion
    return Inclusion(inclusion.substance, inclusion.sizes, 1e-6)


def _anchors(wavelength: np.ndarray, shapes: int) -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths of the fixed shapes, and the weights (wl, shape) that mix them."""
    if shapes == 1 or len(wavelength) == 1:
        return wavelength.mean(keepdims=True), np.ones((len(wavelength), 1))
    anchors = np.linspace(wavelength[0], wavelength[-1], shapes)
    return anchors, linear_interpolation_matrix(wavelength, anchors)


def _phases(population: particles.Population, anchors: np.ndarray, host: str) -> list[Tabulated]:
    cosine = np.cos(np.radians(_ANGLES))
    values = population.phase_function(cosine, anchors, _index(host, anchors))
    return [Tabulated(_ANGLES, column) for column in values.T]


# Candidate lobes of `fit_lobes`: mean cosines.
_LOBES = np.array(
    [-0.6, -0.3, 0.0, 0.3, 0.5, 0.7, 0.8, 0.85, 0.9, 0.93, 0.95, 0.97, 0.98, 0.99, 0.995, 0.998]
)


def fit_lobes(phase: AbstractPhase, lobes: int = 3) -> Mixture:
    """Non-negative mixture of 2 or 3 Henyey-Greenstein lobes with the mean cosine of `phase`.

    Of all sets of lobes out of a fixed list of mean cosines, the one with the least rms relative
    error over 5-175 degrees, evenly in angle.  bb/b is part of the fit but not kept exactly: where
    large smooth spheres scatter less backwards than any mixture of lobes can, it comes out high
    (2.4 times for algae, within 5 % for minerals; p within a factor of 3).
    Concrete phase functions only.
    """
    import scipy.optimize

    cosine = np.cos(np.radians(np.linspace(5.0, 175.0, 86)))
    wanted = np.asarray(phase(jnp.asarray(cosine)), float)
    mean = float(phase.moments(1)[1])
    shapes = (1 - _LOBES**2) / (1 + _LOBES**2 - 2 * _LOBES * cosine[:, None]) ** 1.5 / (4 * np.pi)
    # Two heavy rows hold the sum of the weights and the mean cosine.
    system = np.concatenate(
        [shapes / wanted[:, None], 1e5 * np.stack([np.ones_like(_LOBES), _LOBES])]
    )
    target = np.concatenate([np.ones_like(wanted), [1e5, 1e5 * mean]])
    fits = (
        (*reversed(scipy.optimize.nnls(system[:, chosen], target)), chosen)
        for chosen in map(list, itertools.combinations(range(len(_LOBES)), lobes))
    )
    _, weights, chosen = min(fits, key=lambda fit: fit[0])
    kept = weights > 0
    terms = [HenyeyGreenstein(g) for g in _LOBES[chosen][kept].tolist()]
    return Mixture(jnp.asarray(weights[kept]), terms)


def natural_water(
    region: str | None = None,
    *,
    algae: ScalarLike | None = None,
    minerals: ScalarLike | None = None,
    radii: int = 400,
) -> Medium:
    """Sea water with algae and minerals (section 4.2).

    **Arguments:** one of the five seas of table 1 ("Atlantic", "Baltic", "Channel",
    "Mediterranean", "North Sea"), or the volume fractions of algae and minerals, which also
    replace those of a named sea.

    >>> water = natural_water("Atlantic", radii=50)
    >>> [f"{float(v):.4f}" for v in water.bulk([450.0, 550.0]).b]
    ['0.0454', '0.0413']
    """
    if region is not None and region not in SEAS:
        raise unknown("region", region, SEAS)
    in_region = SEAS[region] if region is not None else (None, None)
    algae = in_region[0] if algae is None else algae
    minerals = in_region[1] if minerals is None else minerals
    if algae is None or minerals is None:
        raise ValueError("natural_water needs a region, or both algae and minerals.")
    inclusions = (
        Inclusion("algae", _algae(), algae),
        Inclusion("mineral", _minerals(), minerals),
    )
    return Medium("brine", inclusions, radii)


def _algae() -> particles.PowerLaw:
    return particles.PowerLaw(3.6, 0.225, 100.0)


def _minerals(exponent: ScalarLike = 3.4) -> particles.PowerLaw:
    return particles.PowerLaw(exponent, 0.01, 100.0)


def milk_volume_fractions(
    fat: ScalarLike, protein: ScalarLike
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Volume fractions of fat and of casein micelles from wt-% (g per 100 g) (eq 36)."""
    fat, protein = jnp.asarray(fat, dtype=float), jnp.asarray(protein, dtype=float)
    return fat * (1.03 / 91.5), protein * (0.76 * 1.03 / 111.0)


def fat_globule_mean(fat: ScalarLike) -> Float[Array, ""]:
    """r_43 of the fat globules in um as a function of wt-% fat (eq 37).

    As printed: it jumps by 2.3 % at 2 wt-%.  Below 0.01 wt-% it stays at its value there.
    """
    fat = jnp.maximum(jnp.asarray(fat, dtype=float), 0.01)
    low = jnp.minimum(fat, 2.0)
    high = jnp.maximum(fat, 2.0)
    return jnp.where(fat < 2.0, low * (1.419 - 0.2528 * low), 1.456 * high**0.36)


# Log-width of r/(r_max - r) of casein micelles.  Not printed: chosen so that their mean cosine is
# that of eq 41 (0.16, 0.11, 0.09 in B, G, R).  They then scatter 1.4-1.6 times as much as eq 40.
CASEIN_LOG_WIDTH = 0.3
_FAT_CV = 0.6


def milk(fat: ScalarLike, protein: ScalarLike, *, radii: int = 200) -> Medium:
    """Milk by its wt-% of fat and protein (section 4.1), 0-10 each.

    Fat globules are log-normal in volume with the mean r_vs = r_43/(1 + cv^2) and cv = 0.6, from
    0.005 to 10 um; casein micelles log-normal in r/(r_max - r), r_vs = 43 nm, r_max = 150 nm.  The
    width of the latter is not printed in the paper: `CASEIN_LOG_WIDTH` is a choice, which matches
    protein's mean cosine to eq 41.  The host is water with riboflavin.
    """
    for name, value in (("fat", fat), ("protein", protein)):
        if not is_traced(value) and not 0 <= float(np.asarray(value)) <= 10:
            raise ValueError(f"{name} must be between 0 and 10 wt-%; it is {value}.")
    fat_fraction, casein_fraction = milk_volume_fractions(fat, protein)
    mean = fat_globule_mean(fat) / (1.0 + _FAT_CV**2)
    globules = particles.LogNormal(mean, _FAT_CV, minimum=0.005, maximum=10.0)
    micelles = particles.BoundedLogNormal(0.043, CASEIN_LOG_WIDTH, maximum=0.15)
    inclusions = (
        Inclusion("milk_fat", globules, fat_fraction),
        Inclusion("casein", micelles, casein_fraction),
    )
    return Medium("milk_host", inclusions, radii)


_MILK_A = np.array([[1.381, -0.008600, 1.209], [2.201, -0.01459, 1.982], [10.13, -0.07048, 4.170]])
_MILK_PROTEIN = np.array([[213.5, 18.63], [338.3, 37.79], [614.0, 96.69]])  # b and g b per wt-%
_MILK_FAT = np.array([[15631.0, 1.24], [18349.0, 1.15], [22585.0, 1.01]])  # factor, exponent
# Coefficients of ascending powers of the logarithm, one row each for R, G, B.
_H1 = np.array([[-0.219, 0.0305, -0.00129], [-0.213, 0.0327, -0.00149], [-0.202, 0.0373, -0.00206]])
_H2 = np.array([[-0.00543, -0.0386], [0.00266, -0.0368], [0.0111, -0.0334]])
_H3 = np.array([[-0.00366, 0.000281], [-0.00401, 0.000379], [-0.00429, 0.000509]])
_G_LOW = np.array([[0.9523, -0.0120], [0.9539, -0.00783], [0.9554, -0.000161]])
_G_HIGH = np.array([[0.9576, 0.00911], [0.9585, 0.00783], [0.9577, 0.00531]])


def milk_fit(
    fat: ScalarLike, protein: ScalarLike
) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """The paper's fitted appearance model of milk: (a, b, g) in R, G, B (eqs 39-46), 1/m.

    fat and protein in wt-%; its authors state errors up to 10 % above 0.05 wt-% of fat.
    """
    fat, protein = jnp.asarray(fat, dtype=float), jnp.asarray(protein, dtype=float)

    def table(values):
        return jnp.asarray(values, fat.dtype)

    def polynomial(rows, x):
        powers = jnp.stack([x ** (k + 2) for k in range(rows.shape[1])])
        return jnp.exp(table(rows) @ powers)

    some = jnp.where(fat > 0, fat, 1.0)  # ln(fat) is replaced by 0 where there is no fat
    a = table(_MILK_A) @ jnp.stack([jnp.ones_like(fat), protein, fat])
    factor, exponent = table(_MILK_FAT).T
    from_fat = jnp.where(fat > 0, factor * some**exponent * polynomial(_H1, jnp.log(some)), 0.0)
    b_protein, gb_protein = protein * table(_MILK_PROTEIN).T
    b = b_protein + from_fat
    low, high = jnp.minimum(some, 0.7), jnp.maximum(some, 0.7)
    g_low = table(_G_LOW[:, 0]) * low ** table(_G_LOW[:, 1]) * polynomial(_H2, -jnp.log(low))
    g_high = table(_G_HIGH[:, 0]) * high ** table(_G_HIGH[:, 1]) * polynomial(_H3, jnp.log(high))
    g_fat = jnp.where(some < 0.7, g_low, g_high)
    empty = b == 0.0
    return a, b, (gb_protein + from_fat * g_fat) / jnp.where(empty, 1.0, b)


def brine_aspect(length: Float[Array, "..."]) -> Float[Array, "..."]:
    """Length over diameter of brine inclusions, 10.3 l^0.67 with l in mm (eq 47), at least 1.

    **Arguments:** length in um.  The printed law falls below 1 just above 0.03 mm.
    """
    return jnp.maximum(10.3 * (length / 1000.0) ** 0.67, 1.0)


def _bubble(length):
    return length / 2.0, jnp.ones_like(length)


def _pocket(length):
    return particles.ellipsoid_spheres(length, brine_aspect(length))


def _tube(length):
    return particles.cylinder_spheres(length, brine_aspect(length))


# Share of the brine volume, lengths (um) and equivalent spheres (Light et al. 2003).  Bubbles have
# no printed lower limit; below 1 um they hold a thousandth of the bubbles' volume.
_BRINE = (
    (0.02, (1.0, 30.0), _bubble),
    (0.06, (30.0, 500.0), _pocket),
    (0.92, (500.0, 14600.0), _tube),
)


def ice(
    air: ScalarLike = 0.0,
    brine: ScalarLike = 0.0,
    minerals: ScalarLike = 0.0,
    algae: ScalarLike = 0.0,
    *,
    mineral_exponent: ScalarLike = 3.4,
    radii: int = 200,
) -> Medium:
    """Ice with air bubbles, brine, minerals and algae, by volume fraction (section 4.3).

    Brine is 2 % spherical bubbles, 6 % ellipsoidal pockets and 92 % cylindrical tubes, whose
    lengths follow l^-1.96; air bubbles of 0.1-2 mm follow r^-1.24.  Minerals and algae are those of
    sea water; the paper's green iceberg has mineral_exponent = 1.5.  Absent kinds (a concrete 0)
    cost nothing.
    """
    found = []
    if is_traced(air) or float(np.asarray(air)) != 0:
        found.append(Inclusion("air", particles.PowerLaw(1.24, 100.0, 2000.0), air))
    if is_traced(brine) or float(np.asarray(brine)) != 0:
        for share, (shortest, longest), spheres in _BRINE:
            lengths = particles.PowerLaw(1.96, shortest, longest)
            sizes = particles.EquivalentSpheres(lengths, spheres)
            found.append(Inclusion("brine", sizes, share * jnp.asarray(brine, dtype=float)))
    if is_traced(minerals) or float(np.asarray(minerals)) != 0:
        found.append(Inclusion("mineral", _minerals(mineral_exponent), minerals))
    if is_traced(algae) or float(np.asarray(algae)) != 0:
        found.append(Inclusion("algae", _algae(), algae))
    return Medium("ice", tuple(found), radii)
