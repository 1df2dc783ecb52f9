"""Exact light fields in one homogeneous slab, from PythonicDISORT.

PythonicDISORT gives the delta-M field at its quadrature directions.  Two things are added here:

- a flat refracting surface: the beam and the sky are refracted in, and what goes up is reflected
  back by Fresnel's law, iterated as a Dirichlet condition at the top.  Each quadrature direction
  gets the mean reflectance of its cell, so that the jump at the critical angle costs no flux;
- radiance in any direction: the source function is formed from the Fourier modes and integrated
  along the line of sight, with exact-phase single scattering (Nakajima & Tanaka 1988).

Optical depth tau counts from the surface; mu > 0 is light that travels DOWN; radiances leave the
unscattered sunbeam out.
"""

import dataclasses
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import itertools

import numpy as np
from numpy.polynomial import chebyshev
from PythonicDISORT.pydisort import pydisort

_CHEBYSHEV = 24
_RAY = 24


def fresnel_from_water(mu, index):
    """Unpolarised reflectance of the surface for light that travels up with cosine mu."""
    if index is None:
        return np.zeros_like(mu)
    squared = 1 - index**2 * (1 - mu**2)
    air = np.sqrt(np.maximum(squared, 0))
    across = (index * mu - air) / (index * mu + air)
    along = (mu - index * air) / (mu + index * air)
    return np.where(squared > 0, (across**2 + along**2) / 2, 1.0)


def refracted_beam(zenith_deg, index):
    """(cosine in the water, irradiance normal to the beam) below the surface for 1 above it."""
    air = np.cos(np.radians(zenith_deg))
    if index is None:
        return air, 1.0
    mu = np.sqrt(1 - (1 - air**2) / index**2)
    return mu, (1 - fresnel_from_water(mu, index)) * air / mu


class _ByMode(np.ndarray):
    """A (direction, mode) boundary value.  PythonicDISORT 1.8 takes any array with as many entries
    as there are directions for an azimuthally uniform one before it looks at the shape."""

    def __len__(self):
        return self.size


def _cell_means(mu, weight, index):
    """Reflectance of each node: mean over its cell, weighted by the cosine."""
    edges = np.concatenate([[0.0], np.cumsum(weight)])
    x, w = np.polynomial.legendre.leggauss(400)
    means = np.empty_like(mu)
    for i, (low, high) in enumerate(itertools.pairwise(edges)):
        at = low + (high - low) * (x + 1) / 2
        means[i] = np.sum(w * at * fresnel_from_water(at, index)) / np.sum(w * at)
    return means


def _legendre(order, modes, mu):
    """Associated Legendre functions sqrt((l-m)!/(l+m)!) P_l^m(mu), shape (m, l, mu)."""
    table = np.zeros((modes, order, mu.size))
    sine = np.sqrt(1 - mu**2)
    for m in range(modes):
        start = np.ones_like(mu)
        for k in range(1, m + 1):
            start = start * np.sqrt((2 * k - 1) / (2 * k)) * sine
        table[m, m] = start
        if m + 1 < order:
            table[m, m + 1] = np.sqrt(2 * m + 1) * mu * start
        for l in range(m + 2, order):
            a, b = np.sqrt(l**2 - m**2), np.sqrt((l - 1) ** 2 - m**2)
            table[m, l] = ((2 * l - 1) * mu * table[m, l - 1] - b * table[m, l - 2]) / a
    return table


@dataclasses.dataclass
class Slab:
    """The solved field; make one with `solve`."""

    albedo: float
    phase: object
    mu0: float
    beam: float
    thickness: float
    reflectance: float
    index: float | None
    sky: float
    forward: float
    breaks: np.ndarray
    source: list
    fluxes: tuple

    def irradiance(self, tau):
        """Ed, Eu, E0 at optical depths, each (tau,)."""
        up, down, mean, weights = self.fluxes
        tau = np.atleast_1d(np.asarray(tau, float))
        diffuse, direct = down(tau)
        scale = 1 - self.albedo * self.forward
        scalar = 2 * np.pi * weights @ mean(tau) + self.beam * np.exp(-scale * tau / self.mu0)
        return tuple(np.atleast_1d(x) for x in (diffuse + direct, up(tau), scalar))

    def radiance(self, tau, mu, cos_azimuth, length=None):
        """Radiance (scalar) of light that travels with cosine mu > 0 down or < 0 up.

        `length`: optical length of a line of sight that ends at an object (only what is scattered
        into it on the way); None gathers everything.
        """
        if length is not None:
            beyond = self.radiance(tau - mu * length, mu, cos_azimuth)
            return self.radiance(tau, mu, cos_azimuth) - np.exp(-length) * beyond
        if mu > 0:
            path = tau / mu
            value = self._gather(tau, mu, cos_azimuth, path)
            edge = 0.0
            mirror = fresnel_from_water(np.float64(mu), self.index)
            if mirror > 0:
                edge = mirror * self.radiance(0.0, -mu, cos_azimuth)
            edge += (1 - mirror) * (1.0 if self.index is None else self.index**2) * self.sky
        else:
            path = (self.thickness - tau) / -mu
            value = self._gather(tau, mu, cos_azimuth, path)
            edge = self.reflectance * self.irradiance(self.thickness)[0][0] / np.pi
        return value + edge * np.exp(-(1 - self.albedo * self.forward) * path)

    def _gather(self, tau, mu, cos_azimuth, path):
        scale = 1 - self.albedo * self.forward
        cosine = mu * self.mu0 + np.sqrt((1 - mu**2) * (1 - self.mu0**2)) * cos_azimuth
        a, b = scale * tau / self.mu0, scale * ((tau - mu * path) / self.mu0 + path)
        x = b - a
        mean = np.exp(-a) * (-np.expm1(-x) / x if abs(x) > 1e-9 else 1.0)
        single = self.albedo * self.beam * self.phase(cosine) * path * mean
        # Multiple scattering: Gauss-Legendre in the transmittance between the breaks of J.
        total = 0.0
        stops = np.unique(np.clip((tau - self.breaks) / mu, 0, path))
        x, w = np.polynomial.legendre.leggauss(_RAY)
        for low, high in itertools.pairwise(stops):
            if scale * low > 40 or high - low < 1e-13:
                continue
            share = -np.expm1(-scale * (high - low))
            v = share * (x + 1) / 2
            s = low - np.log1p(-v) / scale
            values = self._source_at(tau - mu * s, mu, cos_azimuth)
            total += np.exp(-scale * low) * share / 2 * np.sum(w * values)
        return total + single

    def _source_at(self, tau, mu, cos_azimuth):
        """Diffuse source function per scaled optical depth at depths tau of one panel."""
        panel = int(np.clip(np.searchsorted(self.breaks, tau.mean()) - 1, 0, len(self.source) - 1))
        low, high = self.breaks[panel], self.breaks[panel + 1]
        coefficients = self.source[panel]  # (chebyshev, m, l)
        modes, order = coefficients.shape[1:]
        key = (round(float(mu), 12), modes, order)
        table = _cached_legendre(key)
        azimuth = np.cos(np.arange(modes) * np.arccos(np.clip(cos_azimuth, -1, 1)))
        series = np.einsum("kml,ml,m->k", coefficients, table, azimuth, optimize=True)
        return chebyshev.chebval(2 * (tau - low) / (high - low) - 1, series)


_tables: dict = {}


def _cached_legendre(key):
    if key not in _tables:
        mu, modes, order = key
        # Light that travels down has negative cosine in PythonicDISORT.
        _tables[key] = _legendre(order, modes, np.array([-mu]))[..., 0]
    return _tables[key]


def solve(
    albedo,
    moments,
    phase,
    mu0,
    thickness,
    beam=1.0,
    reflectance=0.0,
    index=None,
    sky=0.0,
    streams=32,
    modes=24,
    breaks=(),
    tolerance=1e-6,
):
    """Field of a slab of optical `thickness` over a Lambertian floor.

    `moments`: Legendre moments chi_0 ... chi_(2 streams) at least; `phase`: the same phase function
    in 1/sr; `mu0`, `beam`: the sun in the water; `index`: of a flat surface or None; `sky`: uniform
    sky radiance above the surface; `streams` per hemisphere; `breaks`: further optical depths
    between which the source is fitted.
    """
    n = 2 * streams
    moments = np.asarray(moments, float)
    forward = float(moments[n]) if moments.size > n else 0.0
    top = np.zeros((streams, modes))
    half_mu, half_weight = _half_nodes(streams)
    mirror = _cell_means(half_mu, half_weight, index)
    refracted = 1.0 if index is None else index**2
    angles = np.pi * np.arange(modes) / (modes - 1)
    for _ in range(60):
        entering = top.copy()
        entering[:, 0] += (1 - mirror) * refracted * sky
        mu, up, down, mean, u = pydisort(
            np.array([thickness]),
            np.array([albedo]),
            n,
            moments[None, : n + 1],
            mu0,
            beam,
            0.0,
            NFourier=modes,
            f_arr=np.array([forward]),
            b_neg=entering.view(_ByMode),
            BDRF_Fourier_modes=[reflectance] if reflectance else [],
            cache_asso_leg="no_mu0",
        )
        assert np.allclose(mu[:streams], half_mu)
        if index is None:
            break
        reflected = mirror[:, None] * _fourier(u(1e-12, angles)[:streams], modes)
        change = np.abs(reflected - top).max() / max(np.abs(reflected).max(), 1e-300)
        top = reflected
        if change < tolerance:
            break
    weights = np.concatenate([half_weight, half_weight])
    table = _legendre(n, modes, mu) * weights
    scaled = (moments[:n] - forward) / (1 - forward)
    strength = albedo * (1 - forward) / (1 - albedo * forward) / 2
    factor = strength * (2 * np.arange(n) + 1) * scaled
    breaks = np.unique(np.concatenate([[0.0], np.asarray(breaks, float), [thickness]]))
    nodes = np.cos(np.pi * (np.arange(_CHEBYSHEV) + 0.5) / _CHEBYSHEV)
    source = []
    for low, high in itertools.pairwise(breaks):
        field = u(low + (high - low) * (nodes + 1) / 2, angles)  # (mu, tau, phi)
        by_mode = _fourier(field, modes)  # (mu, tau, m)
        projected = np.einsum("mlj,jtm->tml", table, by_mode, optimize=True) * factor
        fit = chebyshev.chebvander(nodes, _CHEBYSHEV - 1)
        flat = np.linalg.solve(fit, projected.reshape(_CHEBYSHEV, -1))
        source.append(flat.reshape(projected.shape))
    return Slab(
        albedo,
        phase,
        mu0,
        beam,
        thickness,
        reflectance,
        index,
        sky,
        forward,
        breaks,
        source,
        (up, down, mean, weights),
    )


def _half_nodes(streams):
    x, w = np.polynomial.legendre.leggauss(streams)
    order = np.argsort(x)
    return ((x + 1) / 2)[order], (w / 2)[order]


def _fourier(values, modes):
    """Cosine amplitudes from values at `modes` equally spaced azimuths 0 ... pi (last axis)."""
    k = np.arange(modes)
    ends = np.where((k == 0) | (k == modes - 1), 0.5, 1.0)
    matrix = 2 / (modes - 1) * np.cos(np.pi * np.outer(k, k) / (modes - 1)) * ends[:, None]
    return values @ (matrix * ends[None, :])


def deep_thickness(albedo, asymmetry, deepest):
    """Optical depth below which the floor of a slab no longer matters at `deepest` (5e-6)."""
    absorbed = 1 - albedo
    k = min(1.0, float(np.sqrt(3 * absorbed * (1 - albedo * asymmetry))))
    return deepest + 6.0 / max(k, 1e-3)
