"""Size distributions of particles, and spheres equivalent to other shapes.

Radii and lengths in um.  Equation numbers are those of Frisvad, Christensen & Jensen (2007).
"""

import abc
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num, ScalarLike

from oceaninv.mie._arguments import is_traced

# Orders k of the radius-weighted means r_(k+1,k) = integral r^(k+1) N / integral r^k N.
_MEANS = {"number": 0, "surface": 2, "volume": 3}


class AbstractSizes(eqx.Module):
    """A distribution of sphere radii, up to a factor that the volume fraction fixes."""

    @abc.abstractmethod
    def nodes(self, count: int) -> tuple[Float[Array, " radius"], Float[Array, " radius"]]:
        """`count` radii (um) and their weights: sum w f(r) is proportional to integral f N dr."""

    @property
    @abc.abstractmethod
    def largest(self) -> float:
        """The largest radius, um."""


def _limits(minimum: float, maximum: float) -> tuple[float, float]:
    if not 0 < minimum < maximum < np.inf:
        raise ValueError(
            f"minimum and maximum must be radii with 0 < minimum < maximum, in um; they are "
            f"{minimum:g} and {maximum:g}."
        )
    return minimum, maximum


def _positive(name: str, value: ScalarLike) -> Float[Array, ""]:
    if not is_traced(value) and not 0.0 < float(np.asarray(value)) < np.inf:
        raise ValueError(f"{name} must be finite and positive; it is {value}.")
    value = jnp.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(float)


def _log_grid(minimum: float, maximum: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Radii evenly spaced in ln r, and the trapezoid weights dr."""
    if count < 3:
        raise ValueError(f"the number of radii must be at least 3; it is {count}.")
    radius = np.geomspace(minimum, maximum, count)
    weight = radius * (np.log(maximum / minimum) / (count - 1))
    weight[[0, -1]] /= 2
    return radius, weight


class LogNormal(AbstractSizes):
    """Log-normal sizes by mean and coefficient of variation (eqs 49 and 50).

    If the number N(r) is log-normal so is the volume r^3 N(r), with the same width.  `mean_of` says
    which mean is given: "number" (the plain mean radius), "surface" (r_32 = r_vs, volume over
    surface) or "volume" (r_43, the mean of the volume distribution, the paper's mu).

    Radii run from `minimum` to `maximum`, by default as far as 1e-8 of the volume lies beyond;
    they are fixed numbers, needed where the parameters are traced.

    >>> sizes = LogNormal(1.0, 0.5, mean_of="surface")
    >>> round(float(sizes.mean("volume")), 9)  # r_43 = r_32 (1 + cv^2), eq 38
    1.25
    """

    log_median: Float[Array, ""]  # of the number distribution
    log_width: Float[Array, ""]
    minimum: float = eqx.field(static=True)
    maximum: float = eqx.field(static=True)

    def __init__(
        self,
        mean: ScalarLike,
        cv: ScalarLike,
        mean_of: str = "volume",
        minimum: float | None = None,
        maximum: float | None = None,
    ):
        """mean in um; cv = standard deviation over mean, the same for number and volume."""
        order = _mean_order(mean_of)
        mean, cv = _positive("mean", mean), _positive("cv", cv)
        variance = jnp.log1p(cv * cv)
        self.log_width = jnp.sqrt(variance)
        self.log_median = jnp.log(mean) - (order + 0.5) * variance
        if minimum is None or maximum is None:
            if is_traced(mean, cv):
                raise ValueError("minimum and maximum (um) are needed where mean or cv is traced.")
            width = float(self.log_width)
            middle = float(self.log_median) + 3 * width**2
            minimum = float(np.exp(middle - 5.6 * width)) if minimum is None else minimum
            maximum = float(np.exp(middle + 5.6 * width)) if maximum is None else maximum
        self.minimum, self.maximum = _limits(minimum, maximum)

    def nodes(self, count: int) -> tuple[Float[Array, " radius"], Float[Array, " radius"]]:
        radius, weight = _log_grid(self.minimum, self.maximum, count)
        dtype = self.log_width.dtype
        # Relative to the middle of the volume distribution, so that r^-4 stays in range.
        middle = self.log_median + 3.0 * self.log_width**2
        offset = jnp.asarray(np.log(radius), dtype) - middle
        density = jnp.exp(-((offset / self.log_width) ** 2) / 2.0 - 3.0 * offset)
        return jnp.asarray(radius, dtype), density * jnp.asarray(weight / radius, dtype)

    def mean(self, mean_of: str = "volume") -> Float[Array, ""]:
        """Mean radius r_(k+1,k) of the distribution without its limits, um."""
        return jnp.exp(self.log_median + (_mean_order(mean_of) + 0.5) * self.log_width**2)

    @property
    def largest(self) -> float:
        return self.maximum


def _mean_order(name: str) -> int:
    if name not in _MEANS:
        raise ValueError(f"mean_of must be one of {', '.join(_MEANS)}; it is {name!r}.")
    return _MEANS[name]


class BoundedLogNormal(AbstractSizes):
    """Volume distribution log-normal in r/(maximum - r) (Schmidt et al. 1973, casein micelles).

    Given by the volume-to-surface mean r_vs (um) and the log-width of r/(maximum - r).
    """

    mean: Float[Array, ""]
    log_width: Float[Array, ""]
    maximum: float = eqx.field(static=True)

    def __init__(self, mean: ScalarLike, log_width: ScalarLike, maximum: float):
        """mean (r_vs) and maximum in um, mean < maximum."""
        self.mean, self.log_width = _positive("mean", mean), _positive("log_width", log_width)
        self.maximum = _limits(1e-3 * maximum, maximum)[1]
        if not is_traced(mean) and not float(np.asarray(mean)) < maximum:
            raise ValueError(f"mean must be below maximum, {maximum:g}; it is {mean}.")

    def nodes(self, count: int) -> tuple[Float[Array, " radius"], Float[Array, " radius"]]:
        # Trapezoid in s = ln(r/(maximum - r)), over 6 widths about its median.
        half = jnp.asarray(np.linspace(-6.0, 6.0, count), self.mean.dtype)
        # With t = e^s, E[1/r] = (1 + E[1/t])/maximum and E[1/t] = exp(-median + width^2/2).
        median = self.log_width**2 / 2.0 - jnp.log(self.maximum / self.mean - 1.0)
        radius = self.maximum * jax.nn.sigmoid(median + self.log_width * half)
        return radius, jnp.exp(-(half**2) / 2.0) * (self.mean / radius) ** 3

    @property
    def largest(self) -> float:
        return self.maximum


class PowerLaw(AbstractSizes):
    """N(r) proportional to r^-exponent between two radii (appendix A)."""

    exponent: Float[Array, ""]
    minimum: float = eqx.field(static=True)
    maximum: float = eqx.field(static=True)

    def __init__(self, exponent: ScalarLike, minimum: float, maximum: float):
        """minimum and maximum in um."""
        self.exponent = _positive("exponent", exponent)
        self.minimum, self.maximum = _limits(minimum, maximum)

    def nodes(self, count: int) -> tuple[Float[Array, " radius"], Float[Array, " radius"]]:
        radius, weight = _log_grid(self.minimum, self.maximum, count)
        dtype = self.exponent.dtype
        relative = jnp.asarray(radius / self.maximum, dtype)
        return jnp.asarray(radius, dtype), relative**-self.exponent * jnp.asarray(weight, dtype)

    @property
    def largest(self) -> float:
        return self.maximum


class Tabulated(AbstractSizes):
    """A measured distribution, interpolated linearly over ln r between its concrete radii.

    `density_of` says what is given per um of radius: "number" N(r), or "volume" r^3 N(r).
    """

    density: Float[Array, " knot"]
    radius: tuple[float, ...] = eqx.field(static=True)
    density_of: str = eqx.field(static=True)

    def __init__(
        self,
        radius: Float[np.ndarray, "..."] | Sequence[float],
        density: Num[ArrayLike, "..."],
        density_of: str = "number",
    ):
        """radius in um, positive, strictly rising; density >= 0, in any unit."""
        knots = np.asarray(radius, float)
        density = jnp.asarray(density)
        if knots.ndim != 1 or len(knots) < 2 or knots[0] <= 0 or not np.all(np.diff(knots) > 0):
            raise ValueError("radius must be at least two positive numbers that rise strictly.")
        if density.shape != knots.shape:
            raise ValueError(f"density must be one per radius, {knots.shape}; got {density.shape}.")
        if not is_traced(density) and not (bool((density >= 0).all()) and float(density.max()) > 0):
            raise ValueError("density must be at least 0, with a positive value among them.")
        if density_of not in ("number", "volume"):
            raise ValueError(f"density_of must be 'number' or 'volume'; it is {density_of!r}.")
        self.density, self.radius, self.density_of = density, tuple(knots.tolist()), density_of

    def nodes(self, count: int) -> tuple[Float[Array, " radius"], Float[Array, " radius"]]:
        radius, weight = _log_grid(self.radius[0], self.radius[-1], count)
        dtype = self.density.dtype
        knots = jnp.asarray(np.log(self.radius), dtype)
        density = jnp.interp(jnp.asarray(np.log(radius), dtype), knots, self.density)
        if self.density_of == "volume":
            weight = weight * (self.radius[-1] / radius) ** 3
        return jnp.asarray(radius, dtype), density * jnp.asarray(weight, dtype)

    @property
    def largest(self) -> float:
        return self.radius[-1]


def ellipsoid_spheres(
    length: Float[Array, "..."], aspect: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Volume-to-area equivalent spheres of a prolate ellipsoid (eqs 34, 35, appendix B.1).

    **Arguments:** length (um) and length over diameter, >= 1.  **Returns:** the radius 3 V/A of
    the spheres, um, and how many of them hold one ellipsoid's volume.
    """
    e2 = 1.0 - 1.0 / (aspect * aspect)
    # asin(e)/e, with its series where the ellipsoid is nearly a sphere.
    near = e2 < 1e-3
    e = jnp.sqrt(jnp.where(near, 0.25, e2))
    series = 1.0 + e2 / 6.0 + 3.0 * e2**2 / 40.0 + 5.0 * e2**3 / 112.0 + 35.0 * e2**4 / 1152.0
    arc = jnp.where(near, series, jnp.arcsin(e) / e)
    radius = length / (1.0 + aspect * arc)
    return radius, length**3 / (8.0 * aspect**2 * radius**3)


def cylinder_spheres(
    length: Float[Array, "..."], aspect: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Volume-to-area equivalent spheres of a circular cylinder (eqs 34, 35, appendix B.2).

    Arguments and results as `ellipsoid_spheres`.
    """
    radius = 3.0 * length / (2.0 + 4.0 * aspect)
    return radius, 3.0 * length**3 / (16.0 * aspect**2 * radius**3)


class EquivalentSpheres(AbstractSizes):
    """Particles of other shapes, each replaced by spheres with its ratio of volume to area.

    `lengths` is the distribution of their lengths (um); `spheres(length)` gives the radius of the
    equivalent spheres and their number per particle, for example `ellipsoid_spheres` at an aspect
    ratio that depends on length; the radius must not fall with length.
    """

    lengths: AbstractSizes
    spheres: Callable = eqx.field(static=True)

    def nodes(self, count: int) -> tuple[Float[Array, " radius"], Float[Array, " radius"]]:
        length, weight = self.lengths.nodes(count)
        radius, number = self.spheres(length)
        return radius, weight * number

    @property
    def largest(self) -> float:
        with jax.ensure_compile_time_eval():
            return float(jnp.max(self.nodes(64)[0])) * (1 + 1e-6)
