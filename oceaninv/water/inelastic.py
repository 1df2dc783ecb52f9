"""Light that changes its wavelength: Raman scattering, fluorescence of chlorophyll and of CDOM.

An inelastic term takes light out of an excitation band and emits some of it, isotropically or
nearly so, in emission bands.  Everything is written for energy: `shares` gives the part of the
energy taken from one band that is emitted in another, as a mean over both bands, not a point
sample.  Energy emitted beyond the grid is counted, but not returned.  Bands are those of
`spectrum.band_edges`.

The light that these processes take is part of the measured absorption: do not add the
coefficients here to a or b.  Raman scattering towards shorter waves is left out: at 20
degrees C it is 6e-8 of that towards longer ones.
"""

import abc
import functools
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from oceaninv.foundation import tables
from oceaninv.foundation.numerics import gauss_legendre
from oceaninv.foundation.spectrum import band_edges
from oceaninv.water.iops import IOPs, check_concrete
from oceaninv.water.phase import AbstractPhase, Isotropic, Seawater

_EMISSION = (200.0, 1500.0)  # nm; no process here emits beyond these
_PIECE, _NODES = 4.0, 6  # nm and nodes of each piece of a quadrature


class Shares(eqx.Module):
    """Where the energy (or the photons) taken from each excitation band is emitted.

    - `inside`: (wl, wl) share of the energy from excitation band i that is emitted in band j.
    - `outside`: (wl,) share that is emitted beyond the grid.

    Each row of `inside` and its `outside` add up to the yield of the process in that band.
    """

    inside: Float[np.ndarray, "excitation wl"]
    outside: Float[np.ndarray, " excitation"]


class AbstractInelastic(eqx.Module):
    """One inelastic process."""

    @abc.abstractmethod
    def coefficient(self, iops: IOPs) -> Float[Array, " wl"]:
        """Absorption of exciting light, 1/m, times the yield as far as it is a parameter."""

    @abc.abstractmethod
    def shares(self, wavelength: tables.Wavelengths, photons: bool = False) -> Shares:
        """Spectral redistribution between the bands around `wavelength`, of energy or photons.

        A parameter that multiplies it, such as a quantum yield, is in `coefficient` instead.
        """

    @property
    @abc.abstractmethod
    def phase(self) -> AbstractPhase:
        """Phase function of the emission."""


class Raman(AbstractInelastic):
    """Raman scattering by water.

    The coefficient is 2.6e-4 (488/wl)^5.5 1/m (Bartlett et al. 1998, Applied Optics 37:3324: 2.7
    +- 0.2; Desiderio 2000: 2.4), in its form for energy; the shift is that of Walrafen 1967, whose
    integral over emission is 1.  In this form it conserves energy.

    - `coefficient_at_488`: 1/m.
    - `exponent`: 5.5 +- 0.4 against the wavelength of excitation.
    """

    coefficient_at_488: Float[Array, ""]
    exponent: float = eqx.field(static=True)

    def __init__(self, coefficient_at_488: ScalarLike = 2.6e-4, exponent: float | int = 5.5):
        check_concrete("coefficient_at_488", coefficient_at_488)
        self.coefficient_at_488 = jnp.asarray(coefficient_at_488, dtype=float)
        self.exponent = float(exponent)

    def coefficient(self, iops: IOPs) -> Float[Array, " wl"]:
        """Scattering coefficient, mean over each excitation band, 1/m."""
        node, weight = _quadrature(band_edges(iops.wavelength), ())
        shape = np.sum(weight * (488.0 / node) ** self.exponent, axis=1)
        shape = jnp.asarray(shape, dtype=iops.a_components.dtype)
        return self.coefficient_at_488.astype(shape.dtype) * shape

    def shares(self, wavelength: tables.Wavelengths, photons: bool = False) -> Shares:
        """See `AbstractInelastic.shares`; of energy only, which its form conserves."""
        if photons:
            raise ValueError("Raman scattering is defined for energy: use photons=False.")
        return _raman_shares(tuple(tables.check_wavelength(wavelength).tolist()), self.exponent)

    @property
    def phase(self) -> AbstractPhase:
        """3 (1 + 0.53 cos^2)/(4 pi (3 + 0.53)): depolarisation 0.17-0.18."""
        return Seawater(0.53)


class ChlorophyllFluorescence(AbstractInelastic):
    """Fluorescence of chlorophyll: light absorbed by algae at 370-690 nm, emitted about 685 nm.

    The emission is a Gaussian of standard deviation 10.6 nm (Mobley 1994, Light and Water, eqs
    5.102-5.104), the same for every excitation.

    - `quantum_yield`: photons emitted per photon absorbed; 0.003-0.06 in daylight, 0.1 at most.
    """

    quantum_yield: Float[Array, ""]

    def __init__(self, quantum_yield: ScalarLike = 0.02):
        check_concrete("quantum_yield", quantum_yield, 0.0, 1.0)
        self.quantum_yield = jnp.asarray(quantum_yield, dtype=float)

    def coefficient(self, iops: IOPs) -> Float[Array, " wl"]:
        """Quantum yield times absorption by phytoplankton, 1/m."""
        absorbed = _absorber(iops, "chlorophyll", "phytoplankton")
        return self.quantum_yield.astype(absorbed.dtype) * absorbed

    def shares(self, wavelength: tables.Wavelengths, photons: bool = False) -> Shares:
        """See `AbstractInelastic.shares`; per photon that is emitted at all."""
        grid = tuple(tables.check_wavelength(wavelength).tolist())
        return _fluorescence_shares(_chlorophyll, (370.0, 690.0), grid, photons)

    @property
    def phase(self) -> AbstractPhase:
        """Isotropic."""
        return Isotropic()


class CDOMFluorescence(AbstractInelastic):
    """Fluorescence of coloured dissolved organic matter, excited at 310-490 nm.

    Quantum yields of 0.009-0.019 and emission spectra of Hawes 1992, sample FA7 (fulvic acid),
    with no emission at wavelengths shorter than the excitation's.

    - `efficiency`: multiplies the yield.
    """

    efficiency: Float[Array, ""]

    def __init__(self, efficiency: ScalarLike = 1.0):
        check_concrete("efficiency", efficiency)
        self.efficiency = jnp.asarray(efficiency, dtype=float)

    def coefficient(self, iops: IOPs) -> Float[Array, " wl"]:
        """Efficiency times absorption by CDOM, 1/m."""
        absorbed = _absorber(iops, "cdom")
        return self.efficiency.astype(absorbed.dtype) * absorbed

    def shares(self, wavelength: tables.Wavelengths, photons: bool = False) -> Shares:
        """See `AbstractInelastic.shares`."""
        grid = tuple(tables.check_wavelength(wavelength).tolist())
        knots = tuple(tables.load("Hawes1992").wavelength.tolist())
        return _fluorescence_shares(_cdom, knots, grid, photons)

    @property
    def phase(self) -> AbstractPhase:
        """Isotropic."""
        return Isotropic()


class Inelastic(eqx.Module):
    """The inelastic processes of a scene; one that is None does not exist.

    **Arguments:** `raman`: `Raman`; `chlorophyll`: `ChlorophyllFluorescence`, which needs water
    with an absorber "chlorophyll" or "phytoplankton"; `cdom`: `CDOMFluorescence`, which needs an
    absorber "cdom".

    Only light at the scene's own wavelengths excites; light at other wavelengths is missing.  Begin
    them at 310 nm for CDOM, 370 nm for chlorophyll (see `Phytoplankton(extension=...)`) and, for
    Raman, at 1/(1/wl + 3.7e-4/nm) of the shortest emission wl that matters (340 nm for 390 nm).
    On 10 nm bands from 400 nm on, daylight excites no Raman emission below 450 nm, .1 of that at
    450, .87 at 460 and all from 470 nm on; of CDOM's emission .20 is left at 440, .52 at 500 and
    .71 at 600 nm; of chlorophyll's .95 (`test_what_a_grid_from_400_nm_leaves_out`).
    """

    raman: Raman | None = None
    chlorophyll: ChlorophyllFluorescence | None = None
    cdom: CDOMFluorescence | None = None

    @property
    def terms(self) -> tuple[AbstractInelastic, ...]:
        """The processes that exist."""
        return tuple(t for t in (self.raman, self.chlorophyll, self.cdom) if t is not None)


def sources(
    inelastic: Inelastic, iops: IOPs
) -> tuple[tuple[Float[Array, "excitation wl"], AbstractPhase], ...]:
    """Emission of each process per scalar irradiance: (matrix in 1/m, phase function) of each.

    E0 (W m-2 nm-1, by excitation band) @ matrix is the power emitted per volume, W m-3 nm-1, by
    emission band; the widths of the bands are in the matrix.  Divided by 4 pi (or times the phase
    function) it is the source of radiance per metre.

    Raises ValueError for water without the absorber that a process needs, and for a single
    wavelength, whose band has no width.
    """
    width = np.diff(band_edges(iops.wavelength))

    def matrix(term):
        share = term.shares(iops.wavelength).inside * width[:, None] / width[None, :]
        coefficient = term.coefficient(iops)
        return coefficient[:, None] * jnp.asarray(share, dtype=coefficient.dtype)

    return tuple((matrix(term), term.phase) for term in inelastic.terms)


def _absorber(iops: IOPs, *names: str) -> Float[Array, " wl"]:
    """Absorption by the constituent of one of these names, 1/m."""
    rows = [i for i, name in enumerate(iops.absorbers) if name in names]
    if not rows:
        raise ValueError(
            f"fluorescence needs an absorber named {' or '.join(map(repr, names))}; this water has "
            f"{', '.join(iops.absorbers)}: leave the process out, or name the row in absorbers."
        )
    return jnp.sum(iops.a_components[np.array(rows)], axis=0)


@functools.cache
def _raman_shares(grid: tuple[float, ...], exponent: float) -> Shares:
    """A Gaussian in wavenumber has its integral over a band in closed form."""
    from scipy.special import erf

    table = tables.load("Walrafen1967")
    shift, weight, width = (table.columns[k] for k in ("shift", "weight", "width"))
    edges = band_edges(grid)
    excitation, share = _quadrature(edges, ())
    share = share / excitation**exponent
    share = share / share.sum(axis=1, keepdims=True)
    deviation = width / np.sqrt(8 * np.log(2))
    # Shift in 1/cm of an emission at each edge: larger at longer waves.
    shifts = 1e7 * (1 / excitation[..., None] - 1 / edges)
    scaled = (shifts[..., None] - shift) / (np.sqrt(2) * deviation)
    below = (1 + erf(scaled)) / 2 @ (weight / weight.sum())
    inside = np.sum(share[..., None] * np.diff(below, axis=-1), axis=1)
    outside = np.sum(share * (1 - (below[..., -1] - below[..., 0])), axis=1)
    return Shares(inside, outside)


@functools.cache
def _fluorescence_shares(emission, knots, grid: tuple[float, ...], photons: bool) -> Shares:
    """By quadrature; `emission(w, v)` is in photons per photon and nm, smooth between `knots` of
    excitation and at v > w."""
    edges = band_edges(grid)
    excitation, share = _quadrature(edges, knots)
    first, last = _EMISSION
    low, high = min(first, edges[0] / 2), max(last, 2 * edges[-1])
    bounds = np.concatenate([[low], edges, [high]])
    emitted = np.empty((*excitation.shape, bounds.size - 1))
    for j in range(bounds.size - 1):
        # From the excitation on, where the emission may begin with a jump.
        start = np.clip(excitation, bounds[j], bounds[j + 1])
        emitted[..., j] = sum(
            _integral(emission, excitation, a, b, photons)
            for a, b in (
                (np.full_like(start, bounds[j]), start),
                (start, bounds[j + 1] + 0 * start),
            )
        )
    total = np.sum(share[..., None] * emitted, axis=1)
    return Shares(total[:, 1:-1], total[:, 0] + total[:, -1])


def _integral(emission, excitation, low, high, photons):
    """Integral of the emission over low..high, each of the shape of excitation."""
    pieces = max(1, int(np.ceil(np.max(high - low) / _PIECE)))
    node, weight = gauss_legendre(_NODES, 0.0, 1.0)
    places = ((np.arange(pieces)[:, None] + node) / pieces).ravel()
    v = low[..., None] + (high - low)[..., None] * places
    w = np.broadcast_to(excitation[..., None], v.shape)
    density = emission(w, v) * (1.0 if photons else w / v)
    return (high - low) * (density @ (np.tile(weight, pieces) / pieces))


def _quadrature(edges, knots) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (band, node) in each excitation band and their weights, which add up to 1 (to the
    share of the band between the first and the last knot), never across a knot."""
    node, weight = gauss_legendre(_NODES, 0.0, 1.0)
    knots = np.asarray(knots)
    nodes, weights = [], []
    for low, high in itertools.pairwise(edges):
        inner = [low, *knots[(knots > low) & (knots < high)], high]
        parts = [
            np.linspace(a, b, int(np.ceil((b - a) / _PIECE)) + 1)
            for a, b in itertools.pairwise(inner)
            if not knots.size or (a >= knots[0] and b <= knots[-1])
        ]
        start = np.concatenate([p[:-1] for p in parts] or [[]])
        size = np.concatenate([np.diff(p) for p in parts] or [[]])
        nodes.append((start[:, None] + size[:, None] * node).ravel())
        weights.append((size[:, None] * weight).ravel() / (high - low))
    most = max(n.size for n in nodes)
    middle = (edges[:-1] + edges[1:]) / 2
    filled = [
        np.pad(n, (0, most - n.size), constant_values=m) for n, m in zip(nodes, middle, strict=True)
    ]
    return np.stack(filled), np.stack([np.pad(w, (0, most - w.size)) for w in weights])


def _chlorophyll(w, v):
    """A Gaussian about 685 nm, independent of the excitation."""
    return np.exp(-(((v - 685.0) / 10.6) ** 2) / 2) / (10.6 * np.sqrt(2 * np.pi)) + 0 * w


def _cdom(w, v):
    """Hawes 1992 with the constants of its sample FA7."""
    table = tables.load("Hawes1992")
    height = np.interp(w, table.wavelength, table.columns["A0"])
    width = 0.6 * (0.407 / w - 4.57e-4)
    return np.where(v > w, height * np.exp(-(((1 / v - 0.470 / w - 8.077e-4) / width) ** 2)), 0.0)
