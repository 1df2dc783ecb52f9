"""Lorenz-Mie scattering by a homogeneous sphere, in a transparent or an absorbing host.

Conventions: time factor exp(-i w t), so an absorbing index is n + ik with k >= 0; radius in um,
vacuum wavelength in nm, cross sections in um2; cos_theta = +1 is forward.

Equation numbers are those of Frisvad, Christensen & Jensen (2007), ACM TOG 26(3):60, with the
slips corrected (ERRATA.md).  In float64 extinction, scattering and asymmetry are good to 1e-12
relative from x = 1e-6 to 1e4 wherever the index differs from the host's by 0.03 or more (1e-11 at
1.0001), in float32 to 1e-5 up to x = 100 and 1e-4 up to 1000.  All functions broadcast, take mixed
sizes in one batch, and are differentiable in forward and reverse mode in every real and imaginary
part: the derivatives come in closed form out of the same sweep.

The absorbing-host cross sections (eqs 22-24) are an approximation for a distant observer.  They
lose their meaning when the host absorbs noticeably across one particle, alpha =
4 pi r Im(host)/lambda > 1: `AbsorbingHostWarning`.  Below that, extinction may rightly be negative
or less than scattering: it is relative to the host that the particle displaces.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, Num

from oceaninv.foundation.numerics import exp_moment, safe_ratio
from oceaninv.mie import _arguments, _series_sums
from oceaninv.mie._angular_sums import AngleSums, angle_sums
from oceaninv.mie._arguments import AbsorbingHostWarning

__all__ = [
    "AbsorbingHostWarning",
    "CrossSections",
    "amplitudes",
    "cross_sections",
    "efficiencies",
    "phase_function",
    "sections_and_forward",
]

# Below these size parameters the exact leading powers of x are used instead of the series.
_SMALLEST = {"float64": 1e-25, "float32": 1e-8}


class CrossSections(NamedTuple):
    """Cross sections of one sphere in um2, and its mean cosine of scattering."""

    extinction: Float[Array, "..."]
    scattering: Float[Array, "..."]
    asymmetry: Float[Array, "..."]


class _Spheres(NamedTuple):
    """A broadcast batch of spheres, its size parameters kept away from zero."""

    x: Array  # size parameter in the host, |x| at least the smallest of the dtype
    m: Array  # particle index over host index
    tiny: Array  # true |x| over the |x| used: 1 for nearly all, NaN out of the domain


def _spheres(size: Array, direction: Array, m: Array, rows: int) -> _Spheres:
    """Spheres of size parameter size * direction, |direction| = 1."""
    smallest = _SMALLEST[size.dtype.name]
    # A sphere outside the domain becomes NaN and does not lengthen the loops of the others.
    bad = ~((size >= 0) & (size <= _series_sums.largest_size(rows)) & jnp.isfinite(m))
    near_zero = size < smallest
    tiny = jnp.where(near_zero, size / smallest, 1.0)
    used = jnp.where(bad, 1.0, jnp.where(near_zero, smallest, size))
    return _Spheres(
        direction * used.astype(direction.dtype),
        jnp.where(bad, 1.5, m),
        jnp.where(bad, jnp.nan, tiny),
    )


def _sums(spheres: _Spheres, rows: int) -> _series_sums.Sums:
    """Series sums; below the smallest x they follow their leading powers, x and x^4."""
    amplitude, power, cosine = _series_sums.series_sums(spheres.x, spheres.m, rows)
    tiny = spheres.tiny
    return _series_sums.Sums(
        amplitude * tiny.astype(amplitude.dtype), power * tiny**4, cosine * tiny**6
    )


def _asymmetry(sums: _series_sums.Sums) -> Array:
    """Eq 26; 0 where nothing is scattered, NaN for spheres out of range."""
    ratio = safe_ratio(2.0 * sums.cosine, sums.power)
    return jnp.where(jnp.isnan(sums.power), jnp.nan, ratio)


def efficiencies(
    x: Num[ArrayLike, "..."], m: Num[ArrayLike, "..."], max_size: float | None = None
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Extinction and scattering efficiency and mean cosine of a sphere in a transparent host.

    **Arguments:** size parameter x = 2 pi r n_host / lambda >= 0, and the particle's index over
    the host's, m = n + ik, n > 0, k >= 0 (real or complex); they broadcast.  `max_size`: a bound of
    x, needed where x is traced.

    **Returns:** (q_ext, q_sca, g), each in the precision of x.

    Raises ValueError for a negative x, Im m < 0, NaN, shapes that do not match.  Inside jit such
    an element becomes NaN.

    >>> q_ext, q_sca, g = efficiencies(1.0, 1.5 + 1.0j)
    >>> [f"{float(v):.4f}" for v in (q_ext, q_sca, g)]
    ['2.3363', '0.6635', '0.1921']
    """
    shape = _arguments.common_shape(x=x, m=m)
    _arguments.check("x", x)
    _arguments.check_index("m", m)
    largest = None
    if not _arguments.is_traced(x):
        largest = float(np.max(np.asarray(x), initial=0.0))
    rows = _arguments.scratch_rows(largest, max_size)
    batch = _arguments.batch((x, m), (0.0, 1.5), shape, _arguments.float_type(x), rows)
    q_ext, q_sca, g = _efficiencies(batch.arrays, rows)
    return batch.restore(q_ext), batch.restore(q_sca), batch.restore(g)


@functools.partial(jax.jit, static_argnames="rows")
def _efficiencies(arrays, rows):
    x, m = arrays
    sums = _sums(_spheres(x, jnp.ones_like(x), m, rows), rows)
    return 2.0 * jnp.real(sums.amplitude), 2.0 * sums.power, _asymmetry(sums)


def cross_sections(
    radius: Num[ArrayLike, "..."],
    wavelength: Num[ArrayLike, "..."],
    particle_index: Num[ArrayLike, "..."],
    host_index: Num[ArrayLike, "..."],
    max_size: float | None = None,
) -> CrossSections:
    """Extinction and scattering cross section (um2) and mean cosine of a sphere (eqs 21-26).

    **Arguments:** radius (um, >= 0), vacuum wavelength (nm, > 0), and the indices n + ik (k >= 0)
    of particle and host, real or complex; they broadcast.  A host given as real numbers takes the
    cheaper real arithmetic.  `max_size`: a bound of |x| = 2 pi r |host| / lambda, needed where
    radius, wavelength or host are traced.

    In an absorbing host extinction is relative to the host: add the host's own absorption (eq 30).
    Warns with `AbsorbingHostWarning` where alpha = 4 pi r Im(host)/lambda exceeds 1.

    Raises ValueError for a negative radius, a wavelength that is not positive, Im < 0, NaN, shapes
    that do not match, and Im x so large that extinction overflows.  Inside jit such an element
    becomes NaN.

    >>> c = cross_sections(1.0, 550.0, 1.58 + 1e-4j, 1.34)
    >>> f"{float(c.extinction):.5f} {float(c.scattering):.5f} {float(c.asymmetry):.5f}"
    '9.15647 9.14342 0.91302'
    """
    arguments = (radius, wavelength, particle_index, host_index)
    return sections_and_forward(*arguments, max_size=max_size)[0]


def sections_and_forward(
    radius: Num[ArrayLike, "..."],
    wavelength: Num[ArrayLike, "..."],
    particle_index: Num[ArrayLike, "..."],
    host_index: Num[ArrayLike, "..."],
    max_size: float | None = None,
) -> tuple[CrossSections, Complex[Array, "..."]]:
    """`cross_sections`, and the forward amplitude S(0)/k^2 in um2 out of the same sums (eq 21).

    Extinction is 4 pi times its real part; its imaginary part is the input of the effective index.
    """
    batch = _arguments.sphere_batch(radius, wavelength, particle_index, host_index, max_size)
    extinction, scattering, asymmetry, refraction = map(
        batch.restore, _cross_sections(batch.arrays, batch.rows)
    )
    sections = CrossSections(extinction, scattering, asymmetry)
    return sections, jax.lax.complex(extinction / (4.0 * math.pi), refraction)


class _Optics(NamedTuple):
    spheres: _Spheres
    direction: Array  # host / |host|
    area: Array  # pi r^2, um2
    alpha: Array  # 4 pi r Im(host) / lambda = 2 Im x


def _optics(arrays, rows) -> _Optics:
    radius, wavelength, particle, host = arrays
    vacuum = 2000.0 * math.pi * radius / wavelength
    modulus = jnp.abs(host)
    direction = host / modulus.astype(host.dtype)
    common = np.result_type(host.dtype, particle.dtype)
    m = particle.astype(common) / host.astype(common)
    return _Optics(
        _spheres(vacuum * modulus, direction, m, rows),
        direction,
        math.pi * radius * radius,
        2.0 * vacuum * jnp.imag(host),
    )


def _forward(sums: _series_sums.Sums, optics: _Optics) -> Array:
    """2 S(0)/x^2, that is sum (2n+1)(a_n + b_n) |x|^-2 (|host|/host)^2 (eqs 21 and 22)."""
    turn = optics.direction.astype(sums.amplitude.dtype)
    return sums.amplitude / (turn * turn) * jnp.exp(optics.alpha).astype(turn.dtype)


@functools.partial(jax.jit, static_argnames="rows")
def _cross_sections(arrays, rows):
    optics = _optics(arrays, rows)
    sums = _sums(optics.spheres, rows)
    forward = _forward(sums, optics)
    return (
        2.0 * optics.area * jnp.real(forward),
        # With coefficients scaled by e^-alpha the factor e^-alpha/gamma of eq 23 turns into
        # 1/(gamma e^-alpha), gamma e^-alpha = 2 (e^-alpha - 1 + alpha)/alpha^2: no overflow.
        optics.area * sums.power / (exp_moment(0, optics.alpha) - exp_moment(1, optics.alpha)),
        _asymmetry(sums),
        optics.area / (2.0 * math.pi) * jnp.imag(forward),
    )


def amplitudes(
    cos_theta: Num[ArrayLike, "..."],
    radius: Num[ArrayLike, "..."],
    wavelength: Num[ArrayLike, "..."],
    particle_index: Num[ArrayLike, "..."],
    host_index: Num[ArrayLike, "..."],
    max_size: float | None = None,
) -> tuple[Complex[Array, "..."], Complex[Array, "..."]]:
    """Scattering amplitudes S1, S2 (eqs 2 and 3) at the cosine of the scattering angle.

    All arguments broadcast, as in `cross_sections`.  The series of a sphere is summed once for all
    angles that lie along an axis of their own.
    """
    spheres = (radius, wavelength, particle_index, host_index)
    batch, cosine, lay_out = _angle_batch(cos_theta, spheres, max_size)
    first, second = _amplitudes(batch.arrays, cosine, batch.rows)
    return lay_out(first), lay_out(second)


def phase_function(
    cos_theta: Num[ArrayLike, "..."],
    radius: Num[ArrayLike, "..."],
    wavelength: Num[ArrayLike, "..."],
    particle_index: Num[ArrayLike, "..."],
    host_index: Num[ArrayLike, "..."],
    max_size: float | None = None,
) -> Float[Array, "..."]:
    """Phase function of unpolarised light in 1/sr (eq 25), integral 1 over 4 pi.

    **Arguments:** cosine of the scattering angle, -1 ... 1, then as in `cross_sections`; all
    broadcast.  For many angles and many spheres give the angles an axis of their own, for example
    cos_theta of shape (angle, 1) and radius of shape (radius,): each sphere is then summed once.

    Raises ValueError as `cross_sections`, and for a cosine beyond 1.

    >>> p = phase_function(np.array([-1.0, 1.0]), 1.0, 550.0, 1.58, 1.34)
    >>> [f"{float(v):.4f}" for v in p]
    ['0.0028', '14.5333']
    """
    spheres = (radius, wavelength, particle_index, host_index)
    batch, cosine, lay_out = _angle_batch(cos_theta, spheres, max_size)
    return lay_out(_phase(batch.arrays, cosine, batch.rows))


def _angle_sums(spheres: _Spheres, cosine: Array, rows: int) -> AngleSums:
    sums = angle_sums(spheres.x, spheres.m, cosine, rows)
    return sums._replace(power=jnp.where(jnp.isnan(spheres.tiny), jnp.nan, sums.power))


@functools.partial(jax.jit, static_argnames="rows")
def _amplitudes(arrays, cosine, rows):
    optics = _optics(arrays, rows)
    spheres = optics.spheres
    sums = _angle_sums(spheres, cosine, rows)
    grown = jnp.abs(spheres.x) * spheres.tiny**3 * jnp.exp(optics.alpha)
    return tuple(s * grown.astype(s.dtype)[None, :] for s in (sums.s1, sums.s2))


@functools.partial(jax.jit, static_argnames="rows")
def _phase(arrays, cosine, rows):
    sums = _angle_sums(_optics(arrays, rows).spheres, cosine, rows)
    square = sum(jnp.real(s) ** 2 + jnp.imag(s) ** 2 for s in (sums.s1, sums.s2))
    power = jnp.where(sums.power == 0.0, 1.0, sums.power)
    return square / (4.0 * math.pi * power[None, :])


def _angle_batch(cos_theta, spheres: tuple, max_size):
    """The batch of spheres, cosines of shape (angle, sphere), and how to restore the full shape.

    Axes along which only the angle varies become "angle", so that each sphere is summed once.
    """
    if not _arguments.is_traced(cos_theta) and not np.all(np.abs(np.asarray(cos_theta)) <= 1.0):
        raise ValueError("cos_theta must be a cosine, between -1 and 1, without NaN.")
    batch = _arguments.sphere_batch(*spheres, max_size=max_size)
    spheres_only = np.broadcast_to(0.0, batch.shape)
    shape = _arguments.common_shape(cos_theta=cos_theta, spheres=spheres_only)
    sphere_shape = (1,) * (len(shape) - len(batch.shape)) + batch.shape
    cosine_shape = (1,) * (len(shape) - np.ndim(cos_theta)) + np.shape(cos_theta)
    angles = [i for i in range(len(shape)) if sphere_shape[i] == 1 and cosine_shape[i] > 1]
    order = angles + [i for i in range(len(shape)) if i not in angles]
    wide = tuple(max(c, s) for c, s in zip(cosine_shape, sphere_shape, strict=True))
    cosine = jnp.asarray(cos_theta).astype(batch.arrays[0].dtype).reshape(cosine_shape)
    cosine = jnp.transpose(jnp.broadcast_to(cosine, wide), order)
    cosine = cosine.reshape(math.prod(shape[i] for i in angles), -1)
    padding = batch.arrays[0].shape[0] - cosine.shape[1]
    cosine = jnp.pad(cosine, ((0, 0), (0, padding)))

    def lay_out(values):
        kept = values[:, : values.shape[1] - padding]
        return jnp.transpose(
            kept.reshape([shape[i] for i in order]), [order.index(i) for i in range(len(order))]
        )

    return batch, cosine, lay_out
