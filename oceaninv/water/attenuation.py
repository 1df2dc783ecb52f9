"""Models of the diffuse attenuation coefficient Kd of downward irradiance, and of R = Eu/Ed.

K = -d ln(Ed)/dz changes with depth even in homogeneous water, so that "Kd" names several numbers
that differ by up to a third: every function says which one it returns.  All are pure functions of
a, b, bb in 1/m that work under jit and do not check their input; they take spectra (wl,), and
their value and gradient are finite for a, b, bb >= 0 unless said otherwise.

mu0 is the cosine of the sun's zenith angle in the water (`oceaninv.optics.refracted_cosine`).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike
from numpy.typing import ArrayLike

from oceaninv.foundation import tables
from oceaninv.foundation.numerics import exp_moment, safe_power, safe_ratio, safe_sqrt


def kd_gordon1989(
    a: Float[Array, " wl"], bb: Float[Array, " wl"], mu0: ScalarLike
) -> Float[Array, " wl"]:
    """Kd just below the surface, 1/m: 1.0395 (a + bb)/mu0.

    Gordon, 1989, Limnology and Oceanography 34:1389, with the distribution function of a black
    sky, D0 = 1/mu0.  Within 5.4 % of the exact value for single-scattering albedos 0.3-0.95; the
    mean over depth is larger by up to a third.
    """
    return 1.0395 * (a + bb) / jnp.asarray(mu0, a.dtype)


def kd_kirk1984(
    a: Float[Array, " wl"], b: Float[Array, " wl"], mu0: ScalarLike
) -> Float[Array, " wl"]:
    """Mean Kd from the surface to the 1 % level, 1/m: sqrt(a^2 + (0.425 mu0 - 0.19) a b)/mu0.

    Kirk, 1984, Limnology and Oceanography 29:350.  It depends on b, not on bb.  Made for
    Petzold's harbour particles, it is within 6 % of the exact value at bb/b = 0.018, but 31 % high
    at bb/b = 0.005 and albedo 0.9.  At a = 0 the value is 0 and the derivative, truly infinite, is
    returned as 0.
    """
    mu0 = jnp.asarray(mu0, a.dtype)
    return safe_sqrt(a * (a + (0.425 * mu0 - 0.19) * b)) / mu0


def kd_lee2005(
    a: Float[Array, " wl"], bb: Float[Array, " wl"], zenith: ScalarLike
) -> Float[Array, " wl"]:
    """Mean Kd from the surface to the 10 % level, 1/m.

    Kd = (1 + 0.005 zenith) a + 4.18 (1 - 0.52 e^(-10.8 a)) bb, with the zenith angle of the sun in
    air in degrees and a in 1/m.  Lee, Du & Arnone, 2005, Journal of Geophysical Research
    110:C02016, from Hydrolight runs with the average particle phase function and the sun at 0-60
    degrees.  Within 12 % of the exact value for single-scattering albedos 0.3-0.95.
    """
    return _lee(a, 4.18 * bb, zenith)


def kd_lee2013(
    a: Float[Array, " wl"],
    bb: Float[Array, " wl"],
    bb_water: Float[Array, " wl"],
    zenith: ScalarLike,
) -> Float[Array, " wl"]:
    """Mean Kd from the surface to the 10 % level, 1/m, with separate terms for water and particles.

    Kd = (1 + 0.005 zenith) a + 4.259 (1 - 0.265 bb_water/bb) (1 - 0.52 e^(-10.8 a)) bb; zenith of
    the sun in air in degrees, bb_water the part of bb that is sea water's.  Lee et al., 2013,
    Journal of Geophysical Research Oceans 118:4241.  Regular at bb = 0.
    """
    return _lee(a, 4.259 * (bb - 0.265 * bb_water), zenith)


def _lee(a, scattering, zenith):
    sun = 1 + 0.005 * jnp.asarray(zenith, a.dtype)
    return sun * a + (1 - 0.52 * jnp.exp(-10.8 * a)) * scattering


def kd_morel_maritorena2001(
    chlorophyll: Float[Array, ""], wavelength: ArrayLike
) -> Float[Array, " wl"]:
    """Mean Kd over the euphotic layer of open-ocean (case 1) water, 1/m: Kw + chi C^e.

    chlorophyll C in mg/m3 (0.02-30); wavelength concrete, nm, 350-700.  Morel & Maritorena, 2001,
    Journal of Geophysical Research 106:7163, table 2.  Below 1e-6 mg/m3 the power is continued
    linearly to C = 0.  ValueError for a wavelength outside the table.

    >>> import jax.numpy as jnp
    >>> [f"{k:.4f}" for k in kd_morel_maritorena2001(jnp.asarray(1.0), [440.0, 550.0])]
    ['0.1185', '0.0986']
    """
    table = tables.load("MorelMaritorena2001")
    water, factor, exponent = (
        jnp.asarray(table.at(wavelength, name), chlorophyll.dtype) for name in ("Kw", "chi", "e")
    )
    return water + factor * safe_power(jnp.full_like(exponent, chlorophyll), exponent)


def kd_jerlov1976(water_type: str, wavelength: ArrayLike) -> Float[Array, " wl"]:
    """Mean Kd from 0 to 10 m, 1/m, of a Jerlov type, interpolated linearly, default dtype.

    water_type: "I", "IA", "IB", "II", "III" (ocean), "1C", "3C", "5C", "7C", "9C" (coast);
    wavelength concrete, nm, 310-700.  Jerlov, 1976, Marine Optics, table XXVII.  ValueError for an
    unknown type and outside the table.
    """
    return jnp.asarray(tables.load("Jerlov1976").at(wavelength, water_type), dtype=float)


def kd_mean(
    a: Float[Array, " wl"],
    b: Float[Array, " wl"],
    bb: Float[Array, " wl"],
    mu0: ScalarLike,
    depth: Float[Array, "*depth"],
    sky_fraction: ScalarLike | Float[Array, " wl"] = 0.0,
) -> Float[Array, "*depth wl"]:
    """Mean Kd from the surface to each depth (m >= 0), 1/m, so that Ed = Ed(0-) e^(-Kd depth).

    K = K_deep + (K_0 - K_deep)(1 - e^-q)/q with, for c = a + b and w = b/c,
    K_0 = (1.005 a + 2.407 bb)/mu, 1/mu = (1 - sky_fraction)/mu0 + 1.162 sky_fraction,
    K_deep = (1 + 0.634 w) sqrt(a (a + 0.569 w a + 1.163 bb + 0.032 w b)) and
    q = (0.003 w + 1.758 bb/b) c depth; sky_fraction is the share of Ed(0-) that is sky light.

    This project's own fit to discrete ordinates for endlessly deep water under a flat surface:
    w 0.2-0.98, bb/b 0.005-0.05 of particles, sun 0-60 degrees in air, down to 1 % of the light.
    Error of K at most 2.1 % to the 10 % level, 2.4 % to the 1 % level and 6 % nearer the surface
    in nine waters up to w = 0.95 (13 % just below the surface at w = 0.95).  In the waters of
    `jerlov` with less than 30 % of bb from sea water (II to 9C, w up to 0.98) at most 4.8, 4.1 and
    14 % (to the 50 % level).  Molecules scatter back otherwise than the fit's particles do: where
    sea water has more of bb (I, IA, IB; red light elsewhere), up to 12 % to the 10 % level and
    16 % to the 1 % level.  All in `tests/oceaninv/water/test_attenuation.py`.
    K_deep is an effective constant, not the asymptotic K.  Without scattering K = 1.005 a/mu0; at
    a = 0 the derivative of K_deep with respect to a, truly infinite, counts as 0.
    """
    mu0 = jnp.asarray(mu0, a.dtype)
    sky = jnp.broadcast_to(jnp.asarray(sky_fraction, a.dtype), a.shape)
    c = a + b
    w = safe_ratio(b, c)
    surface = (1.005 * a + 2.407 * bb) * ((1 - sky) / mu0 + 1.162 * sky)
    deep = (1 + 0.634 * w) * safe_sqrt(a * (a + 0.569 * w * a + 1.163 * bb + 0.032 * w * b))
    rate = (0.003 * w + 1.758 * safe_ratio(bb, b)) * c
    leading = (1,) * depth.ndim + a.shape
    near = exp_moment(0, rate.reshape(leading) * depth[..., None])
    return deep.reshape(leading) + (surface - deep).reshape(leading) * near


def irradiance_reflectance(
    a: Float[Array, " wl"], bb: Float[Array, " wl"], mu0: ScalarLike
) -> Float[Array, " wl"]:
    """R = Eu/Ed just below the surface of endlessly deep water, dimensionless.

    R = u (0.293 + 0.96 u - 1.151 u^2)/mu0^1.314 with u = bb/(a + bb).  This project's own fit,
    same domain as `kd_mean`; error at most 10 % in the waters of
    `tests/oceaninv/water/test_attenuation.py`.
    """
    u = safe_ratio(bb, a + bb)
    return u * (0.293 + 0.96 * u - 1.151 * u**2) / jnp.asarray(mu0, a.dtype) ** 1.314
