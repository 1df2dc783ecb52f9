"""Scattering phase functions: the angular distribution of light scattered once.

Everywhere: 1/sr, integral over all 4 pi directions 1, cos_theta = +1 forward.  The Legendre moments
are chi_l = 2 pi * integral of p P_l d(cos_theta): chi_0 = 1, p = sum (2l+1) chi_l P_l / (4 pi).

Measured particle functions rise without bound towards 0 degrees (integrably).  `FournierForand` and
`Tabulated` therefore return, inside a cone of 0.1 degree half-angle around the forward direction,
the mean over that cone: every value is finite and the integral is still exactly 1.  Their moments
are those of the function itself, which differs from the flattened one by about l^2 * 3e-8.
"""

import abc
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike
from numpy.typing import ArrayLike

from oceaninv.foundation import tables
from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.water import _phase_integrals

_CAP_DEGREES = 0.1


class AbstractPhase(eqx.Module):
    """A phase function p(cos_theta), 1/sr."""

    @abc.abstractmethod
    def __call__(self, cos_theta: Float[Array, "..."]) -> Float[Array, "..."]:
        """Phase function (1/sr) at the cosine of the scattering angle, in its dtype."""

    @abc.abstractmethod
    def moments(self, order: int) -> Float[Array, " moment"]:
        """Legendre moments chi_0 ... chi_order, in the dtype of the parameters; order is static."""

    @property
    @abc.abstractmethod
    def backscatter_ratio(self) -> Float[Array, ""]:
        """Fraction bb/b scattered by more than 90 degrees."""

    @property
    def asymmetry(self) -> Float[Array, ""]:
        """Mean cosine of the scattering angle, chi_1."""
        return self.moments(1)[1]


class Isotropic(AbstractPhase):
    """The same in all directions: 1/(4 pi)."""

    def __call__(self, cos_theta: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.full_like(cos_theta, 1 / (4 * np.pi))

    def moments(self, order: int) -> Float[Array, " moment"]:
        return jnp.zeros(order + 1).at[0].set(1.0)

    @property
    def backscatter_ratio(self) -> Float[Array, ""]:
        return jnp.asarray(0.5, dtype=float)


class HenyeyGreenstein(AbstractPhase):
    """Henyey & Greenstein (1941): one parameter, the mean cosine g, -1 < g < 1.

    >>> bool(abs(HenyeyGreenstein(0.9).asymmetry - 0.9) < 1e-6)
    True
    """

    g: Float[Array, ""]

    def __init__(self, g: ScalarLike):
        """Raises ValueError if a concrete g is not between -1 and 1."""
        self.g = _parameter("g", g, -1, 1)

    def __call__(self, cos_theta: Float[Array, "..."]) -> Float[Array, "..."]:
        g = self.g.astype(cos_theta.dtype)
        # 1 + g^2 - 2 g cos, written without cancellation at the peak of either sign of g.
        forward = (1 - g) ** 2 + 2 * g * (1 - cos_theta)
        backward = (1 + g) ** 2 - 2 * g * (1 + cos_theta)
        distance = jnp.where(g >= 0, forward, backward)
        return (1 - g) * (1 + g) / (4 * np.pi * distance * jnp.sqrt(distance))

    def moments(self, order: int) -> Float[Array, " moment"]:
        """chi_l = g^l, as a running product: its reverse derivative at g = 0 is finite."""
        return jnp.cumprod(jnp.full((order + 1,), self.g).at[0].set(1.0))

    @property
    def backscatter_ratio(self) -> Float[Array, ""]:
        return _phase_integrals.hg_backscatter(self.g)


class TwoTermHenyeyGreenstein(AbstractPhase):
    """weight * HG(g1) + (1 - weight) * HG(g2), with 0 <= weight <= 1 (Kattawar 1975)."""

    g1: Float[Array, ""]
    g2: Float[Array, ""]
    weight: Float[Array, ""]

    def __init__(self, g1: ScalarLike, g2: ScalarLike, weight: ScalarLike):
        """Raises ValueError if a concrete g is outside (-1, 1) or the weight outside [0, 1]."""
        self.g1 = _parameter("g1", g1, -1, 1)
        self.g2 = _parameter("g2", g2, -1, 1)
        self.weight = _parameter("weight", weight, 0, 1, closed=True)

    def _mix(self, first, second):
        weight = self.weight.astype(first.dtype)
        return weight * first + (1 - weight) * second

    def __call__(self, cos_theta: Float[Array, "..."]) -> Float[Array, "..."]:
        first, second = HenyeyGreenstein(self.g1), HenyeyGreenstein(self.g2)
        return self._mix(first(cos_theta), second(cos_theta))

    def moments(self, order: int) -> Float[Array, " moment"]:
        first, second = HenyeyGreenstein(self.g1), HenyeyGreenstein(self.g2)
        return self._mix(first.moments(order), second.moments(order))

    @property
    def backscatter_ratio(self) -> Float[Array, ""]:
        first, second = HenyeyGreenstein(self.g1), HenyeyGreenstein(self.g2)
        return self._mix(first.backscatter_ratio, second.backscatter_ratio)


def fit_two_term(phase: AbstractPhase) -> TwoTermHenyeyGreenstein:
    """The two-term function with the same mean cosine and bb/b as a concrete `phase`.

    Of all that match both exactly, the one with the least rms difference of ln p over 5-175
    degrees, evenly in angle.  That difference is 0.13 (0.6 at most, at 5 degrees) for `petzold()`
    and 0.10-0.14 for Fournier-Forand functions of bb/b 0.005-0.1; chi_2 comes out 0.0007-0.008 low.
    Within 5 degrees the measured peak is not reproduced.

    Raises ValueError where no mixture can match: bb/b below that of the one-term function.
    """
    angles = np.linspace(5.0, 175.0, 86)
    cosine = np.cos(np.radians(angles))
    with jax.ensure_compile_time_eval():
        dtype = phase.moments(1).dtype
        target = np.log(np.asarray(phase(jnp.asarray(cosine, dtype)), float))
        mean, back = float(phase.asymmetry), float(phase.backscatter_ratio)
    g1, g2, weight = _phase_integrals.two_term_parameters(cosine, target, mean, back)
    return TwoTermHenyeyGreenstein(*(jnp.asarray(v, dtype) for v in (g1, g2, weight)))


class Seawater(AbstractPhase):
    """Molecular scattering, 3 (1 + k cos^2)/(4 pi (3 + k)).

    k = (1 - depolarisation)/(1 + depolarisation): 0.835 is pure sea water (Morel 1974), 1 Rayleigh
    scattering, 0.53 Raman scattering; 0 <= k <= 1.
    """

    k: Float[Array, ""]

    def __init__(self, k: ScalarLike = 0.835):
        """Raises ValueError if a concrete k is outside [0, 1]."""
        self.k = _parameter("k", k, 0, 1, closed=True)

    def __call__(self, cos_theta: Float[Array, "..."]) -> Float[Array, "..."]:
        k = self.k.astype(cos_theta.dtype)
        return 3 / (4 * np.pi) * (1 + k * cos_theta**2) / (3 + k)

    def moments(self, order: int) -> Float[Array, " moment"]:
        """Only chi_0 = 1 and chi_2 = 2 k/(5 (3 + k)) differ from zero."""
        second = 2 * self.k / (5 * (3 + self.k))
        return (
            jnp.zeros(max(order + 1, 3), second.dtype).at[0].set(1.0).at[2].set(second)[: order + 1]
        )

    @property
    def backscatter_ratio(self) -> Float[Array, ""]:
        return jnp.full_like(self.k, 0.5)


class FournierForand(AbstractPhase):
    """Fournier & Forand (1994) in the form of Fournier & Jonasz (1999, SPIE 3761:62).

    A size distribution N(r) dr proportional to r^-slope, 3 < slope < 5 (their mu; the slope of
    the numbers per radius, as of `oceaninv.particles.PowerLaw`, not of the numbers larger than r,
    which is less by 1), of particles of relative refractive index `index` > 1, in an approximation
    to anomalous diffraction.

    The function is as published, with bb/b as in Mobley et al. 2002.  It is not Lorenz-Mie theory:
    for index 1.05-1.15 and slope 3.5-4.3 it is 0.49 to 2.1 times that of such a population from 1
    to 30 degrees, and its bb/b is 1.1 to 4.7 times as large (0.029 instead of 0.0071 for 1.05 and
    4), as `test_a_population_of_the_same_index_and_slope` measures.  Give bb/b where it is known;
    for particles of known index and sizes take `oceaninv.particles.Population`.
    """

    index: Float[Array, ""]
    slope: Float[Array, ""]

    def __init__(
        self,
        backscatter_ratio: ScalarLike | None = None,
        *,
        index: ScalarLike | None = None,
        slope: ScalarLike | None = None,
    ):
        """From bb/b alone or from index and slope; ValueError for anything else.

        With 1e-5 < bb/b < 0.49 alone, index = 1.01 + 0.1542 (slope - 3) (Mobley et al. 2002,
        Appl. Opt. 41:1035).
        """
        if backscatter_ratio is not None and index is None and slope is None:
            ratio = _parameter("backscatter_ratio", backscatter_ratio, 1e-5, 0.49)
            find = (
                _phase_integrals.concrete_slope
                if _concrete(ratio)
                else _phase_integrals.slope_from_backscatter
            )
            self.slope = jnp.asarray(find(ratio), ratio.dtype)
            self.index = _phase_integrals.index_from_slope(self.slope)
        elif backscatter_ratio is None and index is not None and slope is not None:
            self.index = _parameter("index", index, 1, np.inf)
            self.slope = _parameter("slope", slope, 3, 5)
        else:
            raise ValueError(
                "FournierForand takes either backscatter_ratio alone or both index and slope; got "
                f"backscatter_ratio={backscatter_ratio}, index={index}, slope={slope}."
            )

    @eqx.filter_jit
    def __call__(self, cos_theta: Float[Array, "..."]) -> Float[Array, "..."]:
        half = (1 - cos_theta) / 2  # sin^2(theta/2)
        cap = math.sin(math.radians(_CAP_DEGREES) / 2) ** 2
        shape = self._shape(cos_theta.dtype)
        outside, cone = _phase_integrals.ff_density(jnp.clip(half, cap, 1.0), cap, *shape)
        return jnp.where(half < cap, cone / cap, outside) / (4 * np.pi)

    def moments(self, order: int) -> Float[Array, " moment"]:
        angles, weights = _phase_integrals.angular_quadrature(_phase_integrals.log_panels(order))
        half, solid = np.sin(angles / 2) ** 2, weights * np.sin(angles) / 2
        # chi_0 is 1 to rounding; exactly 1 spares solvers a renormalisation.
        if _concrete(self.index) and _concrete(self.slope):
            values = _phase_integrals.concrete_moments(half, solid, self.index, self.slope, order)
            return jnp.asarray(np.append(1.0, values[1:]), self.index.dtype)
        return self._moments(half, solid, order)

    @eqx.filter_jit
    def _moments(self, half, solid, order: int):
        half, solid = (jnp.asarray(v, self.index.dtype) for v in (half, solid))
        smallest = math.sin(_phase_integrals.SMALLEST_ANGLE / 2) ** 2
        density, forward = _phase_integrals.ff_density(half, smallest, *self._shape(half.dtype))
        return (
            (_phase_integrals.legendre_sums(half, solid * density, order) + forward).at[0].set(1.0)
        )

    @property
    @eqx.filter_jit
    def backscatter_ratio(self) -> Float[Array, ""]:
        return _phase_integrals.ff_backscatter(*self._shape(self.index.dtype))

    def _shape(self, dtype):
        """(ln delta at 180 degrees, s = (slope - 3)/2)."""
        index, slope = self.index.astype(dtype), self.slope.astype(dtype)
        return math.log(4 / 3) - 2 * jnp.log(index - 1), (slope - 3) / 2


class Tabulated(AbstractPhase):
    """Phase function given at angles, interpolated linearly in log(value) over log(angle).

    Below the first angle the first segment's power law continues (integrated exactly).  If the
    first angle is 0, log(value) is linear in the angle up to the second.
    """

    angle_deg: tuple[float, ...] = eqx.field(static=True)
    log_values: Float[Array, " angle"]

    def __init__(
        self,
        angle_deg: ArrayLike,
        values: Float[Array, " angle"] | Float[np.ndarray, " angle"],
        normalise: bool = True,
    ):
        """angle_deg: concrete, strictly increasing, first >= 0, last 180; values: positive, 1/sr.

        With normalise=False the values are taken to integrate to 1 already.  Raises ValueError for
        other angles, for concrete values that are not positive, or whose power law towards
        0 degrees has no finite integral (steeper than angle^-2).
        """
        angle = np.asarray(angle_deg, float)
        if len(angle) < 3 or angle[0] < 0 or angle[-1] != 180 or not np.all(np.diff(angle) > 0):
            raise ValueError(
                "angle_deg must rise strictly from an angle >= 0 to exactly 180 in at least 3 "
                f"steps; got {len(angle)} angles from {angle[:1]} to {angle[-1:]}."
            )
        values = jnp.asarray(values)
        if values.shape != angle.shape:
            raise ValueError(f"values must be one per angle, {angle.shape}; got {values.shape}.")
        if _concrete(values) and not bool(jnp.all(values > 0)):
            raise ValueError(f"values must be positive; the smallest is {values.min()}.")
        self.angle_deg = tuple(angle.tolist())
        self.log_values = jnp.log(values)
        if _concrete(values) and angle[0] > 0 and float(self._forward_exponent()) >= 2:
            raise ValueError(
                f"values rise towards 0 degrees as angle^-{self._forward_exponent():.3f}; an "
                "integrable phase function needs an exponent below 2."
            )
        if normalise:
            self.log_values = _normalised(self)

    @eqx.filter_jit
    def __call__(self, cos_theta: Float[Array, "..."]) -> Float[Array, "..."]:
        half = jnp.clip((1 - cos_theta) / 2, 0.0, 1.0)
        theta = 2 * jnp.arctan2(safe_sqrt(half), safe_sqrt(1 - half))
        cap = self._cap()
        if cap == 0:
            return jnp.exp(self._log_at(theta))
        cone = self._forward_fraction(cap, cos_theta.dtype)
        cone_mean = cone / (4 * np.pi * math.sin(cap / 2) ** 2)
        return jnp.where(theta < cap, cone_mean, jnp.exp(self._log_at(jnp.maximum(theta, cap))))

    @eqx.filter_jit
    def moments(self, order: int) -> Float[Array, " moment"]:
        angles, measure = self._measure(order)
        half = jnp.asarray(np.sin(angles / 2) ** 2, measure.dtype)
        return _phase_integrals.legendre_sums(half, measure, order) + self._tail()

    @property
    @eqx.filter_jit
    def backscatter_ratio(self) -> Float[Array, ""]:
        angles, measure = self._measure(0)
        return jnp.sum(measure[angles > np.pi / 2])

    def _cap(self) -> float:
        """Half-angle (rad) of the forward cone in which the mean is returned; 0 for none."""
        return math.radians(min(_CAP_DEGREES, self.angle_deg[0]))

    def _coordinate(self, theta):
        """log(theta), continued linearly (once differentiably) below the first positive angle."""
        first = math.radians(next(angle for angle in self.angle_deg if angle > 0))
        if self.angle_deg[0] > 0:
            return jnp.log(theta)
        beyond = jnp.log(jnp.maximum(theta, first))
        return jnp.where(theta < first, math.log(first) - 1 + theta / first, beyond)

    def _log_at(self, theta):
        """log p at angles theta (rad), beyond the first angle by its segment's power law."""
        dtype = theta.dtype
        knots = self._coordinate(jnp.asarray(np.radians(self.angle_deg), dtype))
        at = self._coordinate(theta)
        values = self.log_values.astype(dtype)
        i = jnp.clip(jnp.searchsorted(knots, at, side="right") - 1, 0, len(self.angle_deg) - 2)
        t = (at - knots[i]) / (knots[i + 1] - knots[i])
        return values[i] + t * (values[i + 1] - values[i])

    def _measure(self, order: int):
        """Quadrature angles (rad) and 2 pi p sin(theta) times the weights."""
        start = 0.0 if self.angle_deg[0] == 0 else _phase_integrals.SMALLEST_ANGLE
        own = [float(a) for a in np.radians(self.angle_deg) if a > start]
        edges = tuple(sorted({start, *own, *_phase_integrals.log_panels(order)[1:]}))
        angles, weights = _phase_integrals.angular_quadrature(edges)
        dtype = self.log_values.dtype
        solid = jnp.asarray(2 * np.pi * weights * np.sin(angles), dtype)
        return angles, solid * jnp.exp(self._log_at(jnp.asarray(angles, dtype)))

    def _forward_exponent(self):
        """m of p ~ theta^-m below the first angle."""
        run = math.log(self.angle_deg[1] / self.angle_deg[0])
        return (self.log_values[0] - self.log_values[1]) / run

    def _forward_fraction(self, theta: float, dtype):
        """Exact integral of the power law over the cone of half-angle theta <= first angle."""
        m = self._forward_exponent().astype(dtype)
        first = math.radians(self.angle_deg[0])
        scale = jnp.exp(self.log_values[0].astype(dtype) - m * math.log(theta / first))
        # sin t = t - t^3/6 + t^5/120, each term integrated against t^-m.
        series = 1 / (2 - m) - theta**2 / 6 / (4 - m) + theta**4 / 120 / (6 - m)
        return 2 * np.pi * theta**2 * scale * series

    def _tail(self):
        if self.angle_deg[0] == 0:
            return jnp.zeros((), self.log_values.dtype)
        return self._forward_fraction(_phase_integrals.SMALLEST_ANGLE, self.log_values.dtype)


@eqx.filter_jit
def _normalised(phase: Tabulated) -> Float[Array, " angle"]:
    total = jnp.sum(phase._measure(0)[1]) + phase._tail()
    return phase.log_values - jnp.log(total)


def petzold() -> Tabulated:
    """Average particle of Petzold's San Diego harbour stations (Mobley 1994, table 3.10).

    Mean cosine 0.924, bb/b = 0.0183.
    """
    columns = tables.load("Petzold1972").columns
    with jax.ensure_compile_time_eval():
        return Tabulated(columns["angle"], columns["phase_function"])


class Mixture(AbstractPhase):
    """Non-negative mixture sum w_k p_k / sum w_k, e.g. of constituents weighted by their b."""

    weights: Float[Array, " component"]
    phases: tuple[AbstractPhase, ...]

    def __init__(self, weights: Float[Array, " component"], phases: Sequence[AbstractPhase]):
        """Raises ValueError unless there is one weight per phase, all >= 0 and one > 0."""
        weights = jnp.asarray(weights)
        if len(phases) != weights.shape[0]:
            raise ValueError(f"give one weight per phase; got {len(weights)} for {len(phases)}.")
        if _concrete(weights) and not (bool(jnp.all(weights >= 0)) and float(weights.sum()) > 0):
            raise ValueError(f"weights must be >= 0 with a positive sum; got {weights}.")
        self.weights = weights / weights.sum()
        self.phases = tuple(phases)

    def _mix(self, terms):
        return sum(
            (w.astype(term.dtype) * term for w, term in zip(self.weights, terms, strict=True)),
            start=jnp.zeros((), terms[0].dtype),
        )

    def __call__(self, cos_theta: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._mix([phase(cos_theta) for phase in self.phases])

    def moments(self, order: int) -> Float[Array, " moment"]:
        dtype = self.weights.dtype
        return self._mix([moments_of(p, order).astype(dtype) for p in self.phases])

    @property
    def backscatter_ratio(self) -> Float[Array, ""]:
        dtype = self.weights.dtype
        return self._mix([backscatter_ratio_of(p).astype(dtype) for p in self.phases])


def moments_of(phase: AbstractPhase, order: int) -> Float[Array, " moment"]:
    """`phase.moments(order)`.  If nothing in the phase function is traced, it is a constant of the
    program, since compiling its quadrature would take longer than all the rest."""
    if not all(map(_concrete, jax.tree.leaves(phase))):
        return phase.moments(order)
    with jax.ensure_compile_time_eval():
        return phase.moments(order)


def backscatter_ratio_of(phase: AbstractPhase) -> Float[Array, ""]:
    """`phase.backscatter_ratio`, a constant of the program if nothing in it is traced."""
    if not all(map(_concrete, jax.tree.leaves(phase))):
        return phase.backscatter_ratio
    with jax.ensure_compile_time_eval():
        return phase.backscatter_ratio


def _concrete(value) -> bool:
    return not isinstance(value, jax.core.Tracer)


def _parameter(name: str, value, low, high, closed: bool = False) -> Array:
    """value as a floating scalar array; ValueError if it is concrete and outside the interval."""
    value = jnp.asarray(value)
    if not jnp.issubdtype(value.dtype, jnp.floating) or value.weak_type:
        value = value.astype(float)
    if value.shape != ():
        raise ValueError(f"{name} must be a scalar; got shape {value.shape}.")
    if _concrete(value):
        number = float(value)
        if not (low < number < high or (closed and number in (low, high))):
            ends = "[]" if closed else "()"
            raise ValueError(f"{name} must lie in {ends[0]}{low}, {high}{ends[1]}; got {number}.")
    return value
