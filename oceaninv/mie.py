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
import warnings
from typing import NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, Num

from oceaninv import _mie_sums
from oceaninv._mie_angles import AngleSums, angle_sums
from oceaninv._numerics import exp_moment

# Below these size parameters the exact leading powers of x are used instead of the series.
_SMALLEST = {"float64": 1e-25, "float32": 1e-8}


class AbsorbingHostWarning(UserWarning):
    """The host absorbs so much across one particle (alpha > 1) that eqs 22-24 mean little."""


class CrossSections(NamedTuple):
    """Cross sections of one sphere in um2, and its mean cosine of scattering."""

    extinction: Float[Array, "..."]
    scattering: Float[Array, "..."]
    asymmetry: Float[Array, "..."]


def _is_traced(*values) -> bool:
    return any(isinstance(v, jax.core.Tracer) for v in values)


def _check(name: str, value, positive: bool = False) -> None:
    """ValueError unless a concrete value is finite and has no negative part where none may be."""
    if _is_traced(value):
        return
    array = np.asarray(value)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite; it has a NaN or an infinity.")
    wanted = "positive" if positive else "at least 0"
    low = array.real <= 0 if positive else array.real < 0
    if low.any():
        raise ValueError(
            f"{name} must be {wanted}; the smallest value given is {array.real.min():g}."
        )


def _check_index(name: str, value) -> None:
    _check(name, value if _is_traced(value) else np.real(value), positive=True)
    if not _is_traced(value) and not np.all(np.imag(value) >= 0):
        raise ValueError(
            f"{name} must be n + ik with k >= 0 (time factor exp(-i w t): a positive imaginary "
            f"part absorbs); the smallest imaginary part given is {np.min(np.imag(value)):g}."
        )


def _check_shapes(**arguments) -> tuple[int, ...]:
    try:
        return np.broadcast_shapes(*(np.shape(v) for v in arguments.values()))
    except ValueError:
        listing = ", ".join(f"{k} {np.shape(v)}" for k, v in arguments.items())
        raise ValueError(f"the shapes of these arguments do not broadcast: {listing}.") from None


def _scratch_rows(largest: float | None, max_size: float | None) -> int:
    """Static scratch space for sizes up to max_size, or up to the largest concrete size."""
    if max_size is None:
        if largest is None:
            raise ValueError(
                "max_size, an upper bound of the size parameters |x| = 2 pi r |host| / lambda as "
                "a plain number, is needed when the size of the particles is traced by jax "
                "(jit, grad or vmap): scratch space must have a fixed size."
            )
        max_size = largest
    if not (largest or 0.0) <= max_size < 1e8:
        raise ValueError(
            f"max_size must be at least the largest size parameter, {largest or 0.0:g}, and below "
            f"1e8; it is {max_size:g}."
        )
    return _mie_sums.buffer_rows(max_size)


class _Spheres(NamedTuple):
    """A broadcast batch of spheres, its size parameters kept away from zero."""

    x: Array  # size parameter in the host, |x| at least the smallest of the dtype
    m: Array  # particle index over host index
    tiny: Array  # true |x| over the |x| used: 1 for nearly all, NaN out of the domain


def _spheres(size: Array, direction: Array, m: Array, rows: int) -> _Spheres:
    """Spheres of size parameter size * direction, |direction| = 1."""
    smallest = _SMALLEST[size.dtype.name]
    # A lane outside the domain becomes NaN, and does not lengthen the loops of the others.
    bad = ~((size >= 0) & (size <= _mie_sums.largest_size(rows)) & jnp.isfinite(m))
    near_zero = size < smallest
    tiny = jnp.where(near_zero, size / smallest, 1.0)
    used = jnp.where(bad, 1.0, jnp.where(near_zero, smallest, size))
    return _Spheres(
        direction * used.astype(direction.dtype),
        jnp.where(bad, 1.5, m),
        jnp.where(bad, jnp.nan, tiny),
    )


def _sums(spheres: _Spheres, rows: int) -> _mie_sums.Sums:
    """Series sums; below the smallest x they follow their leading powers, x and x^4."""
    flat = _mie_sums.series_sums(spheres.x.reshape(-1), spheres.m.reshape(-1), rows)
    amplitude, power, cosine = (v.reshape(spheres.x.shape) for v in flat)
    tiny = spheres.tiny
    return _mie_sums.Sums(
        amplitude * tiny.astype(amplitude.dtype), power * tiny**4, cosine * tiny**6
    )


def _asymmetry(sums: _mie_sums.Sums) -> Array:
    """Eq 26; 0 where nothing is scattered."""
    nothing = sums.power == 0.0
    return 2.0 * sums.cosine / jnp.where(nothing, 1.0, sums.power)


def efficiencies(
    x: Num[ArrayLike, "*#s"], m: Num[ArrayLike, "*#s"], max_size: float | None = None
) -> tuple[Float[Array, "*s"], Float[Array, "*s"], Float[Array, "*s"]]:
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
    shape = _check_shapes(x=x, m=m)
    _check("x", x)
    _check_index("m", m)
    dtype = _float_type(x)
    largest = None if _is_traced(x) else float(np.max(np.asarray(x), initial=0.0))
    return _efficiencies(
        jnp.asarray(x).astype(dtype), _cast(m, dtype), shape, _scratch_rows(largest, max_size)
    )


@functools.partial(jax.jit, static_argnames=("shape", "rows"))
def _efficiencies(x, m, shape, rows):
    x, m = jnp.broadcast_to(x, shape), jnp.broadcast_to(m, shape)
    sums = _sums(_spheres(x, jnp.ones_like(x), m, rows), rows)
    return 2.0 * jnp.real(sums.amplitude), 2.0 * sums.power, _asymmetry(sums)


def _float_type(value) -> np.dtype:
    """The real dtype in which a result is returned; integers count as default floats."""
    dtype = jnp.asarray(value).dtype
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.zeros(()).dtype


def _cast(value, dtype) -> Array:
    value = jnp.asarray(value)
    if jnp.iscomplexobj(value):
        return value.astype(np.result_type(dtype, np.complex64))
    return value.astype(dtype)


def _prepare(radius, wavelength, particle_index, host_index, max_size):
    """Check the arguments and cast them to one precision; also the shape and scratch rows."""
    arguments = {
        "radius": radius,
        "wavelength": wavelength,
        "particle_index": particle_index,
        "host_index": host_index,
    }
    shape = _check_shapes(**arguments)
    _check("radius", radius)
    _check("wavelength", wavelength, positive=True)
    _check_index("particle_index", particle_index)
    _check_index("host_index", host_index)
    dtype = _float_type(radius)
    largest = None
    if not _is_traced(radius, wavelength, host_index):
        x = 2000 * np.pi * np.asarray(radius) / np.asarray(wavelength) * np.asarray(host_index)
        largest = float(np.max(np.abs(x), initial=0.0))
        _check_alpha(2.0 * float(np.max(x.imag, initial=0.0)), dtype)
    arrays = (
        jnp.asarray(radius).astype(dtype),
        jnp.asarray(wavelength).astype(dtype),
        _cast(particle_index, dtype),
        _cast(host_index, dtype),
    )
    return arrays, shape, _scratch_rows(largest, max_size)


def _check_alpha(largest: float, dtype) -> None:
    limit = math.log(float(jnp.finfo(dtype).max)) - 8.0
    if largest > limit:
        raise ValueError(
            f"the host absorbs too much for radius and host_index: extinction grows like "
            f"exp(2 Im x) and overflows {dtype.name} at Im x = {largest / 2:g} "
            f"(limit {limit / 2:.0f})."
        )
    if largest > 1.0:
        warnings.warn(
            f"the host absorbs across one particle (alpha = 4 pi r Im(host)/lambda up to "
            f"{largest:.3g} > 1): the far-field cross sections of eqs 22-24 mean little there.",
            AbsorbingHostWarning,
            stacklevel=4,
        )


class _Optics(NamedTuple):
    spheres: _Spheres
    direction: Array  # host / |host|
    area: Array  # pi r^2, um2
    alpha: Array  # 4 pi r Im(host) / lambda = 2 Im x


def _optics(arrays, shape, rows) -> _Optics:
    radius, wavelength, particle, host = (jnp.broadcast_to(v, shape) for v in arrays)
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


def cross_sections(
    radius: Num[ArrayLike, "*#s"],
    wavelength: Num[ArrayLike, "*#s"],
    particle_index: Num[ArrayLike, "*#s"],
    host_index: Num[ArrayLike, "*#s"],
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
    arrays, shape, rows = _prepare(radius, wavelength, particle_index, host_index, max_size)
    return _cross_sections(arrays, shape, rows)


@functools.partial(jax.jit, static_argnames=("shape", "rows"))
def _cross_sections(arrays, shape, rows):
    optics = _optics(arrays, shape, rows)
    sums = _sums(optics.spheres, rows)
    return CrossSections(
        2.0 * optics.area * jnp.real(_forward(sums, optics)),
        # With coefficients scaled by e^-alpha the factor e^-alpha/gamma of eq 23 turns into
        # 1/(gamma e^-alpha), gamma e^-alpha = 2 (e^-alpha - 1 + alpha)/alpha^2: no overflow.
        optics.area * sums.power / (exp_moment(0, optics.alpha) - exp_moment(1, optics.alpha)),
        _asymmetry(sums),
    )


def _forward(sums: _mie_sums.Sums, optics: _Optics) -> Array:
    """2 S(0)/x^2, that is sum (2n+1)(a_n + b_n) |x|^-2 (|host|/host)^2 (eqs 21 and 22)."""
    turn = optics.direction.astype(sums.amplitude.dtype)
    return sums.amplitude / (turn * turn) * jnp.exp(optics.alpha).astype(turn.dtype)


def forward_amplitude(
    radius: Num[ArrayLike, "*#s"],
    wavelength: Num[ArrayLike, "*#s"],
    particle_index: Num[ArrayLike, "*#s"],
    host_index: Num[ArrayLike, "*#s"],
    max_size: float | None = None,
) -> Complex[Array, "*s"]:
    """S(0)/k^2 in um2 (eq 21), the input of the effective index; arguments as `cross_sections`.

    Extinction is 4 pi times its real part.
    """
    arrays, shape, rows = _prepare(radius, wavelength, particle_index, host_index, max_size)
    return _forward_amplitude(arrays, shape, rows)


@functools.partial(jax.jit, static_argnames=("shape", "rows"))
def _forward_amplitude(arrays, shape, rows):
    optics = _optics(arrays, shape, rows)
    forward = _forward(_sums(optics.spheres, rows), optics)
    return forward * (optics.area / (2.0 * math.pi)).astype(forward.dtype)


def amplitudes(
    cos_theta: Num[ArrayLike, "*#s"],
    radius: Num[ArrayLike, "*#s"],
    wavelength: Num[ArrayLike, "*#s"],
    particle_index: Num[ArrayLike, "*#s"],
    host_index: Num[ArrayLike, "*#s"],
    max_size: float | None = None,
) -> tuple[Complex[Array, "*s"], Complex[Array, "*s"]]:
    """Scattering amplitudes S1, S2 (eqs 2 and 3) at the cosine of the scattering angle.

    All arguments broadcast, as in `cross_sections`.  The series of a sphere is summed once for all
    angles that lie along an axis of their own.
    """
    sums, optics, lanes_last = _at_angles(
        cos_theta, radius, wavelength, particle_index, host_index, max_size
    )
    spheres = optics.spheres
    grown = jnp.abs(spheres.x) * spheres.tiny**3 * jnp.exp(optics.alpha)
    return tuple(
        lanes_last(s * grown.reshape(-1).astype(s.dtype)[None, :]) for s in (sums.s1, sums.s2)
    )


def phase_function(
    cos_theta: Num[ArrayLike, "*#s"],
    radius: Num[ArrayLike, "*#s"],
    wavelength: Num[ArrayLike, "*#s"],
    particle_index: Num[ArrayLike, "*#s"],
    host_index: Num[ArrayLike, "*#s"],
    max_size: float | None = None,
) -> Float[Array, "*s"]:
    """Phase function of unpolarised light in 1/sr (eq 25), integral 1 over 4 pi.

    **Arguments:** cosine of the scattering angle, -1 ... 1, then as in `cross_sections`; all
    broadcast.  For many angles and many spheres give the angles an axis of their own, for example
    cos_theta of shape (angle, 1) and radius of shape (radius,): each sphere is then summed once.

    Raises ValueError as `cross_sections`, and for a cosine beyond 1.

    >>> p = phase_function(np.array([-1.0, 1.0]), 1.0, 550.0, 1.58, 1.34)
    >>> [f"{float(v):.4f}" for v in p]
    ['0.0028', '14.5333']
    """
    sums, _, lanes_last = _at_angles(
        cos_theta, radius, wavelength, particle_index, host_index, max_size
    )
    square = sum(jnp.real(s) ** 2 + jnp.imag(s) ** 2 for s in (sums.s1, sums.s2))
    power = jnp.where(sums.power == 0.0, 1.0, sums.power)
    return lanes_last(square / (4.0 * math.pi * power[None, :]))


def _at_angles(cos_theta, radius, wavelength, particle_index, host_index, max_size):
    """Angle sums of shape (angle, lane), the optics of the lanes, and the way back to the shape."""
    particle_shape = _check_shapes(
        radius=radius,
        wavelength=wavelength,
        particle_index=particle_index,
        host_index=host_index,
    )
    shape = _check_shapes(cos_theta=cos_theta, particles=np.empty(particle_shape))
    if not _is_traced(cos_theta) and not np.all(np.abs(np.asarray(cos_theta)) <= 1.0):
        raise ValueError("cos_theta must be a cosine, between -1 and 1, without NaN.")
    arrays, _, rows = _prepare(radius, wavelength, particle_index, host_index, max_size)
    optics = _optics(arrays, particle_shape, rows)
    padded = (1,) * (len(shape) - len(particle_shape)) + particle_shape
    cosine_shape = (1,) * (len(shape) - np.ndim(cos_theta)) + np.shape(cos_theta)
    # Axes along which only the angle varies come first, the lanes of spheres after them.
    angles = [i for i in range(len(shape)) if padded[i] == 1 and cosine_shape[i] > 1]
    lanes = [i for i in range(len(shape)) if i not in angles]
    order = angles + lanes
    cosine = jnp.asarray(cos_theta).astype(arrays[0].dtype).reshape(cosine_shape)
    wide = tuple(cosine_shape[i] if i in angles else shape[i] for i in range(len(shape)))
    cosine = jnp.broadcast_to(cosine, wide)
    count = math.prod(shape[i] for i in angles)
    lane_shape = tuple(shape[i] for i in lanes)
    cosine = jnp.transpose(cosine, order).reshape(count, -1)

    def lanes_last(values):
        moved = values.reshape(tuple(shape[i] for i in angles) + lane_shape)
        return jnp.transpose(moved, np.argsort(order))

    spheres = optics.spheres
    sums = angle_sums(spheres.x.reshape(-1), spheres.m.reshape(-1), cosine, rows)
    tiny = spheres.tiny.reshape(-1)
    # An element out of the domain is NaN.
    power = jnp.where(jnp.isnan(tiny), jnp.nan, sums.power)
    return AngleSums(sums.s1, sums.s2, power), optics, lanes_last
