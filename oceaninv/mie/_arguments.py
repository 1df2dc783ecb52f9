"""Checks, casts and padding of the arguments of the Lorenz-Mie functions."""

import math
import warnings
from typing import NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from oceaninv.mie._series_sums import buffer_rows


class AbsorbingHostWarning(UserWarning):
    """The host absorbs so much across one particle (alpha > 1) that eqs 22-24 mean little."""


class Batch(NamedTuple):
    """Arguments of one precision, each of shape (sphere,), and the caller's shape."""

    arrays: tuple[Array | np.ndarray, ...]
    shape: tuple[int, ...]
    rows: int  # static scratch space of the series

    def restore(self, values: Array) -> Array:
        """(..., sphere) -> (..., *shape)"""
        values = values[..., : math.prod(self.shape)]
        return values.reshape(values.shape[:-1] + self.shape)


def is_traced(*values) -> bool:
    return any(isinstance(v, jax.core.Tracer) for v in values)


def check(name: str, value, positive: bool = False) -> None:
    """ValueError unless a concrete real value is finite and positive, or at least 0."""
    if is_traced(value):
        return
    array = np.asarray(value)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite; it has a NaN or an infinity.")
    if np.any(array <= 0 if positive else array < 0):
        wanted = "positive" if positive else "at least 0"
        raise ValueError(f"{name} must be {wanted}; the smallest value given is {array.min():g}.")


def check_index(name: str, value) -> None:
    if is_traced(value):
        return
    real, imaginary = np.real(value), np.imag(value)
    check(name, real, positive=True)
    if not np.all(imaginary >= 0) or not np.all(np.isfinite(imaginary)):
        raise ValueError(
            f"{name} must be n + ik with k >= 0 (time factor exp(-i w t): a positive "
            f"imaginary part absorbs); the smallest imaginary part given is "
            f"{np.min(imaginary):g}."
        )


def common_shape(**arguments) -> tuple[int, ...]:
    try:
        return np.broadcast_shapes(*(np.shape(v) for v in arguments.values()))
    except ValueError:
        listing = ", ".join(f"{k} {np.shape(v)}" for k, v in arguments.items())
        raise ValueError(f"the shapes of these arguments do not broadcast: {listing}.") from None


def float_type(value) -> np.dtype:
    """The real dtype in which a result is returned; integers count as default floats."""
    dtype = jnp.asarray(value).dtype
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.zeros(()).dtype


def scratch_rows(largest: float | None, max_size: float | None) -> int:
    """Static scratch space for sizes up to max_size, or up to the largest concrete size."""
    if max_size is None:
        if largest is None:
            raise ValueError(
                "max_size, an upper bound of the size parameters |x| = 2 pi r |host| / lambda as "
                "a plain number, is needed when the size of the particles is traced by jax "
                "(jit, grad or vmap): scratch space must have a fixed size."
            )
        max_size = largest
    # Rounding in either number is allowed for: the scratch space is a little larger than needed.
    if not (largest or 0.0) * (1 - 1e-6) <= max_size < 1e8:
        raise ValueError(
            f"max_size must be at least the largest size parameter, {largest or 0.0:g}, and below "
            f"1e8; it is {max_size:g}."
        )
    return buffer_rows(max_size)


def batch(arguments: tuple, idle: tuple, shape: tuple[int, ...], dtype, rows: int) -> Batch:
    """Cast, broadcast and flatten; `idle` spheres pad concrete batches to a power of 4.

    Padding keeps the number of compiled programs small: one serves all batches of up to 16
    particles, one of up to 64, and so on.  Idle spheres are tiny and cost almost nothing.
    """
    ctype = np.result_type(dtype, np.complex64)
    count = math.prod(shape)
    width = 4 ** math.ceil(math.log(max(count, 16), 4))

    def flat(value, fill):
        if is_traced(*arguments):
            value = jnp.asarray(value)
            value = value.astype(ctype if jnp.iscomplexobj(value) else dtype)
            return jnp.broadcast_to(value, shape).reshape(-1)
        value = np.asarray(value)
        value = np.broadcast_to(value.astype(ctype if np.iscomplexobj(value) else dtype), shape)
        padded = np.full(width, fill, value.dtype)
        padded[:count] = value.reshape(-1)
        return padded

    arrays = tuple(flat(v, f) for v, f in zip(arguments, idle, strict=True))
    return Batch(arrays, shape, rows)


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


def sphere_batch(radius, wavelength, particle_index, host_index, max_size) -> Batch:
    """Check the arguments of functions of radius and wavelength, and arrange them as a batch."""
    shape = common_shape(
        radius=radius,
        wavelength=wavelength,
        particle_index=particle_index,
        host_index=host_index,
    )
    check("radius", radius)
    check("wavelength", wavelength, positive=True)
    check_index("particle_index", particle_index)
    check_index("host_index", host_index)
    dtype = float_type(radius)
    largest = None
    if not is_traced(radius, wavelength, host_index):
        x = 2000 * np.pi * np.asarray(radius) / np.asarray(wavelength) * np.asarray(host_index)
        largest = float(np.max(np.abs(x), initial=0.0))
        _check_alpha(2.0 * float(np.max(np.imag(x), initial=0.0)), dtype)
    arguments = (radius, wavelength, particle_index, host_index)
    rows = scratch_rows(largest, max_size)
    return batch(arguments, (0.0, 500.0, 1.5, 1.0), shape, dtype, rows)
