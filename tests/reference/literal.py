"""The two-stream closed form written down term by term in mpmath, singularities and all.

An independent reading of the formula: optical depths instead of metres, plain quotients instead
of divided differences.  Evaluate it a little off a removable singularity, at high precision.
"""

import mpmath
from mpmath import mpf

mpmath.mp.dps = 80


def _mean(a, b):
    """(e^-A - e^-B)/(B - A)."""
    return (mpmath.exp(-a) - mpmath.exp(-b)) / (b - a)


def fresnel_from_water(mu, index):
    squared = 1 - index**2 * (1 - mu**2)
    if squared <= 0:
        return mpf(1)
    air = mpmath.sqrt(squared)
    across = (index * mu - air) / (index * mu + air)
    along = (mu - index * air) / (mu + index * air)
    return (across**2 + along**2) / 2


def radiance(
    a, b, g, mu0, z, mu, cosine, floor=None, reflectance=0, index=None, sky=0, mirrored=None
):
    """Radiance of light that travels with cosine mu (> 0 down) at depth z, for a beam of 1 just
    below the surface and Henyey-Greenstein scattering.

    `cosine`: of the scattering angle; `mirrored`: the same for the ray mirrored in the surface.
    """
    a, b, g, mu0, z, mu, cosine = (mpf(x) for x in (a, b, g, mu0, z, mu, cosine))
    c = a + b
    w = b / c
    chi1, chi2 = g, g**2
    s = 1 - w * chi2
    ws = w * (1 - chi2) / s
    gs = (chi1 - chi2) / (1 - chi2)
    k = mpmath.sqrt(3 * (1 - ws) * (1 - ws * gs))
    h = k / (3 * (1 - ws * gs))
    k0 = 1 / mu0
    beam = mpf(1)
    scalar = -3 * ws * beam * (1 + gs - ws * gs) / (k0**2 - k**2)
    flux = ((1 - ws) * scalar - ws * beam) / k0
    inner, outer = mpf(0), mpf(0)
    root3 = mpmath.sqrt(3)
    if index is not None:
        index = mpf(index)
        outer = mpf(DIFFUSE_FROM_AIR)
        inner = 1 - (1 - outer) / index**2
    top = 2 * mpmath.pi * root3 * (1 - outer) * mpf(sky)
    top -= (1 - inner) * scalar + root3 * (1 + inner) * flux
    top_decay = (1 - inner) + root3 * (1 + inner) * h
    floor_radiance = mpf(0)
    if floor is None:
        decay, grow, depth = top / top_decay, mpf(0), mpf(0)
    else:
        rho = mpf(reflectance)
        depth = s * c * mpf(floor)
        across, sun = mpmath.exp(-k * depth), mpmath.exp(-k0 * depth)
        rows = mpmath.matrix(2, 2)
        rows[0, 0], rows[0, 1] = top_decay, ((1 - inner) - root3 * (1 + inner) * h) * across
        rows[1, 0] = ((1 - rho) - root3 * (1 + rho) * h) * across
        rows[1, 1] = (1 - rho) + root3 * (1 + rho) * h
        known = 2 * root3 * rho * mu0 * beam * sun
        known -= ((1 - rho) * scalar - root3 * (1 + rho) * flux) * sun
        determinant = rows[0, 0] * rows[1, 1] - rows[0, 1] * rows[1, 0]
        decay = (top * rows[1, 1] - rows[0, 1] * known) / determinant
        grow = (rows[0, 0] * known - rows[1, 0] * top) / determinant
        e = decay * across + grow + scalar * sun
        f = h * (decay * across - grow) + flux * sun
        floor_radiance = rho * ((e / root3 + f) / 2 + mu0 * beam * sun) / mpmath.pi

    def phase(x):
        return (1 - g**2) / (1 + g**2 - 2 * g * x) ** mpf(1.5)

    def gathered(tau, mu, path, x):
        """S(tau, mu, P): multiple plus single scattering along the path."""
        t, p, d = s * tau, s * path, -mu
        a_k = p * _mean(k * t, k * (t + d * p) + p)
        a_0 = p * _mean(k0 * t, k0 * (t + d * p) + p)
        total = (scalar + 3 * gs * mu * flux) * a_0 + decay * (1 + 3 * gs * mu * h) * a_k
        if grow:
            up = p * _mean(k * (depth - t), k * (depth - t - d * p) + p)
            total += grow * (1 - 3 * gs * mu * h) * up
        total *= ws / (4 * mpmath.pi)
        angle = mpmath.sqrt((1 - x) / 2)
        s1 = 1 - w * min(chi2, mpf("0.995")) * (1 - mpmath.exp(-2 * angle / mpf("0.138")))
        single = path * _mean(tau * s1 / mu0, ((tau + d * path) / mu0 + path) * s1)
        return total + w * beam * phase(x) / (4 * mpmath.pi) * single

    def looking_down(tau, mu, x):
        path = mpf(10) ** 9 if floor is None else (c * mpf(floor) - tau) / -mu
        return gathered(tau, mu, path, x) + floor_radiance * mpmath.exp(-s * path)

    tau = c * z
    if mu < 0:
        return looking_down(tau, mu, cosine)
    path = tau / mu
    edge = mpf(sky)
    if index is not None:
        r = fresnel_from_water(mu, index)
        edge = r * looking_down(mpf(0), -mu, mpf(mirrored)) + (1 - r) * index**2 * mpf(sky)
    return gathered(tau, mu, path, cosine) + edge * mpmath.exp(-s * path)


def _diffuse_from_air():
    """Flux reflectance of the surface n = 1.34 under a uniform sky."""
    n = mpf(1.34)
    with mpmath.workdps(30):

        def integrand(mu):
            water = mpmath.sqrt(1 - (1 - mu**2) / n**2)
            return 2 * mu * fresnel_from_water(water, n)

        return mpmath.quad(integrand, [0, mpf("0.01"), mpf("0.1"), mpf("0.5"), 1])


DIFFUSE_FROM_AIR = _diffuse_from_air()
