"""Light of targets of finite size: what small-angle scattering brings back into an image.

Light that leaves a target and is scattered through small angles still arrives within the target's
image, so that a target of finite size is brighter than exp(-c r) says (Duntley 1963; Wells 1973).
For the same reason a target hides light that the water behind it would have scattered forward into
the line of sight.  Both are given by the share S of light from the eye's line of sight, followed
backwards, that reaches the target.  In small-angle theory (Wells 1973, in Optics of the Sea, AGARD
Lecture Series 61, 4.1), for a disc of radius R at distance r,

    S = exp(-c r) + int_0^inf J1(q s) s [exp(-r (c - sum_i b_i Phi_i(q))) - exp(-c r)] dq,
    Phi_i(q) = 2 pi int_0^(pi/2) p_i(t) K(q tan t) sin t dt,  K(z) = int_0^1 J0(z u) du,  s = R/r,

with p_i the phase functions.  The integral over q is evaluated by a digital filter: the bracket is
interpolated by cubic splines in ln q at `_NODES`, whose integrals against J1 depend on q s alone
(as Anderson 1979, Geophysics 44:1287, for other kernels).  A target of any other shape is a mean
over discs, because S counts light evenly in azimuth about the line of sight.
"""

import functools
import itertools

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from oceaninv.foundation.numerics import gauss_legendre
from oceaninv.water.iops import IOPs, check_concrete
from oceaninv.water.phase import AbstractPhase, Mixture

# Nodes in ln q, and their spacing: with it, S errs by at most 2e-4 for b r up to 20.
_SPACING = 0.3
_NODES = np.log(2e-3) + _SPACING * np.arange(65)
# The filter is tabulated at so many points per spacing, over these values of ln(q s).
_FINENESS = 8
_LEAST, _MOST = -14.0, 9.0
# Half-angle (rad) of the cone inside which phase functions are constant.
_CONE = np.radians(0.1)


def disc_transmission(
    water: IOPs,
    distance: Float[Array, " ray"],
    radius: Float[Array, "ray disc"],
    peak_width: ScalarLike = 1.0,
) -> Float[Array, "ray disc wl"]:
    """Share of the radiance of discs that arrives at an eye on their axis.

    **Arguments:**

    - `water`: homogeneous.
    - `distance`: metres from the eye to each disc, > 0.
    - `radius`: metres, >= 0; several discs at each distance cost little more than one.
    - `peak_width`: factor on the width in angle of the forward peaks of all phase functions, at
      equal total and backward scattering, > 0.

    **Returns** the transmission for a disc of uniform radiance: exp(-c r) for a vanishing radius,
    exp(-(c - b_forward) r) for an endless one, b_forward = b - bb.

    Small-angle theory: compared with random walks, see `target_transmission`.  Phase functions that
    return their mean inside 0.1 degree limit it to radii above 0.002 of the distance.

    **Raises:** ValueError for concrete values outside these ranges.

    >>> import jax.numpy as jnp
    >>> from oceaninv import IOPs, phase
    >>> water = IOPs([550.0], jnp.array([0.1]), jnp.array([0.5]), phase.HenyeyGreenstein(0.9))
    >>> seen = disc_transmission(water, jnp.array([2.0]), jnp.array([[0.0, 0.1, 1e9]]))[0, :, 0]
    >>> [round(float(value), 3) for value in seen]
    [0.301, 0.444, 0.8]
    """
    distance, radius = jnp.asarray(distance), jnp.asarray(radius)
    check_concrete("distance", distance, np.nextafter(0.0, 1.0))
    check_concrete("radius", radius)
    check_concrete("peak_width", peak_width, np.nextafter(0.0, 1.0))
    floating = jnp.issubdtype(water.b_components.dtype, jnp.floating)
    dtype = water.b_components.dtype if floating else jnp.asarray(0.0).dtype
    far = distance.astype(dtype)
    spread = jnp.stack([_shape_factors(p, peak_width, dtype) for p in water.phases])
    c = water.c.astype(dtype)
    # (node, wl) the part of b that counts as unscattered at each q.
    kept = spread.T @ water.b_components.astype(dtype)
    lost = jnp.maximum(c[None, :] - kept, 0.0)
    direct = jnp.exp(-far[:, None] * c[None, :])[:, None, :]
    bracket = jnp.exp(-far[:, None, None] * lost[None]) - direct
    weights = _filter(radius.astype(dtype) / far[:, None])
    # HIGHEST: float32 products on accelerators would lose half the digits.
    return direct + jnp.einsum(
        "rdn,rnw->rdw", weights, bracket, precision=jax.lax.Precision.HIGHEST
    )


def target_transmission(
    water: IOPs,
    distance: Float[Array, " ray"],
    half_width: Float[Array, " ray"],
    half_height: Float[Array, " ray"] | None = None,
    peak_width: ScalarLike = 1.0,
) -> Float[Array, "ray wl"]:
    """Share of the radiance of a rectangle that arrives at an eye before its centre.

    **Arguments:** `half_width`, `half_height`: metres, >= 0; a square unless both are given; the
    others as for `disc_transmission`.

    **Returns** S: exp(-c r) in the limit of a small target, exp(-(c - b_forward) r) in that of a
    large one.  M = S exp(c r), at least 1, is the gain by image-forming light.

    - **Solves**: scattering of all orders through angles below 90 degrees, for small angles.
    - **Neglects**: the longer way of scattered light, and light that turns back.
    - **Measured error** of M against random walks (`tests/oceaninv/water/test_image_forming.py`),
      for b r of 0.1-3, half-sizes of 0.01-0.3 of the distance and six phase functions: 0.2-0.5 %
      rms and 2.4 % at most for a = b/4; 1.2-3.3 % rms and 15 % at most (too large, with half-sizes
      of 0.3 at a r = 6) for a = 2 b, where the longer way of scattered light is felt.
    - **Differentiable in** a, b, phase functions, distance, size and `peak_width`, both modes.

    **Raises:** ValueError for concrete values outside their ranges.

    >>> import jax.numpy as jnp
    >>> from oceaninv import IOPs, phase
    >>> water = IOPs([550.0], jnp.array([0.1]), jnp.array([0.5]), phase.HenyeyGreenstein(0.9))
    >>> at = jnp.array([2.0])
    >>> seen = target_transmission(water, at, jnp.array([0.1]))
    >>> round(float(seen[0, 0] / jnp.exp(-water.c[0] * 2.0)), 2)  # M
    1.52
    """
    half_width = jnp.asarray(half_width)
    half_height = half_width if half_height is None else jnp.asarray(half_height)
    check_concrete("half_width", half_width)
    check_concrete("half_height", half_height)
    radius, weight = discs_of_rectangle(half_width, half_height)
    seen = disc_transmission(water, distance, radius, peak_width)
    return jnp.einsum("rd,rdw->rw", weight.astype(seen.dtype), seen)


_PART, _PART_WEIGHT = gauss_legendre(6, 0.0, 1.0)


def discs_of_rectangle(
    half_width: Float[Array, "..."], half_height: Float[Array, "..."]
) -> tuple[Float[Array, "... disc"], Float[Array, "... disc"]]:
    """Radii and weights of the discs whose mean is a rectangle seen from before its centre.

    The radii are the distances of its edge in Gauss nodes of azimuth, for each side.  Half-sizes
    of 0 are allowed.
    """
    part, weight = _last(_PART, half_width), _last(_PART_WEIGHT, half_width)
    empty = (half_width == 0) & (half_height == 0)
    corner = jnp.arctan2(jnp.where(empty, 1.0, half_height), jnp.where(empty, 1.0, half_width))
    radii, weights = [], []
    for side, span in ((half_width, corner), (half_height, np.pi / 2 - corner)):
        # In a rectangle without width the span to its corner is the quadrant: its edge is at 0.
        cosine = jnp.maximum(jnp.cos(span[..., None] * part), jnp.finfo(part.dtype).eps)
        radii.append(side[..., None] / cosine)
        weights.append(span[..., None] * weight * (2 / np.pi))
    return jnp.concatenate(radii, axis=-1), jnp.concatenate(weights, axis=-1)


def _last(values: np.ndarray, like: Float[Array, "..."]):
    """Values along a new last axis after the axes of an array, in its dtype."""
    return jnp.asarray(values.reshape((1,) * like.ndim + (-1,)), like.dtype)


@functools.cache
def _forward_angles() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles (rad), solid angle per node, and (node, angle) K(q tan t) at `_NODES` of ln q."""
    from scipy.special import itj0y0

    edges = np.concatenate([[0.0], np.geomspace(_CONE, 1e5, 99)])
    parts = [gauss_legendre(16, low, high) for low, high in itertools.pairwise(edges)]
    tangent, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
    cosine = 1.0 / np.sqrt(1.0 + tangent**2)
    solid = 2 * np.pi * weight * tangent * cosine**3
    z = np.exp(_FINE_NODES)[:, None] * tangent
    return np.arctan(tangent), solid, itj0y0(z)[0] / z


# Where Phi is tabulated: the nodes and, for other widths of the peak, a margin on either side.
_MARGIN = 8
_FINE_NODES = _NODES[0] + _SPACING * np.arange(-_MARGIN, len(_NODES) + _MARGIN)


def _shape_factors(phase: AbstractPhase, peak_width, dtype) -> Float[Array, " node"]:
    """Phi of a phase function at q = 0 and at the nodes."""
    if isinstance(phase, Mixture):
        parts = jnp.stack([_shape_factors(p, peak_width, dtype) for p in phase.phases])
        return phase.weights.astype(dtype) @ parts
    table, forward = _tabulated_factors(phase, dtype)
    at = jnp.asarray(_NODES, dtype) + jnp.log(jnp.asarray(peak_width, dtype))
    return jnp.concatenate([forward[None], _read(table, at, float(_FINE_NODES[0]), _SPACING)])


def _tabulated_factors(phase: AbstractPhase, dtype):
    """Phi at the nodes of the table, and the forward scattered share, which is Phi at q = 0."""
    angle, solid, kernel = _forward_angles()
    concrete = not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(phase))
    if not concrete:
        density = phase(jnp.asarray(np.cos(angle), dtype)).astype(dtype)
        of_nodes, of_all = jnp.asarray(kernel * solid, dtype), jnp.asarray(solid, dtype)
        return of_nodes @ density, of_all @ density
    # In double precision wherever it is asked for: cosines near 1 lose small angles in single.
    with jax.ensure_compile_time_eval(), jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float64)), phase)
        density = np.asarray(double(jnp.asarray(np.cos(angle))))
    measure = solid * density
    return jnp.asarray(kernel @ measure, dtype), jnp.asarray(measure.sum(), dtype)


@functools.cache
def _filter_table() -> tuple[np.ndarray, np.ndarray]:
    """The filter at values of ln(q s), and the sum of it over all nodes below a first one there.

    The integral of J1(y) L((ln y - x)/spacing) dy, L the cardinal cubic spline, by its Fourier
    transform: that of J1(e^x) e^x is 2^(-iw) Gamma(1 - iw/2)/Gamma(1 + iw/2), of modulus 1, and
    that of L is sinc^4 (w/2) 3/(2 + cos w).
    """
    from scipy.special import loggamma

    step = _SPACING / _FINENESS
    size = 2 ** int(np.ceil(np.log2((_MOST - _LEAST + 30.0) / step)))
    # Harmonics beyond the grid's own are folded onto it: the table is of exact values.
    period = size * step
    harmonic = np.arange(1, 16 * size)
    frequency = 2 * np.pi * harmonic / period
    scaled = frequency * _SPACING
    spline = np.sinc(scaled / (2 * np.pi)) ** 4 * 3 / (2 + np.cos(scaled))
    kernel = np.exp(
        loggamma(1 - 0.5j * frequency) - loggamma(1 + 0.5j * frequency) - 1j * frequency * np.log(2)
    )
    start = _LEAST - 15.0
    terms = kernel * spline * np.exp(1j * frequency * start)
    folded = np.zeros(size, complex)
    np.add.at(folded, harmonic % size, terms)
    values = _SPACING / period * (1.0 + 2.0 * np.fft.ifft(folded).real * size)
    below = np.zeros(size)
    for row in range(_FINENESS):
        below[row::_FINENESS] = np.cumsum(values[row::_FINENESS])
    below = np.concatenate([np.zeros(_FINENESS), below[:-_FINENESS]])
    inside = slice(round(15.0 / step), round((_MOST - start) / step) + 1)
    return values[inside], below[inside]


def _filter(size: Float[Array, "..."]) -> Float[Array, "... node"]:
    """Weights of the bracket's values at q = 0 and the nodes, for discs whose radius is `size`
    times the distance.

    The bracket is that of q = 0 below the first node, and 0 beyond the last.
    """
    dtype = size.dtype
    values, below = (jnp.asarray(v, dtype) for v in _filter_table())
    step = _SPACING / _FINENESS
    positive = size > 0
    log = jnp.log(jnp.where(positive, size, 1.0))
    log = jnp.clip(log, float(_LEAST - _NODES[-1]), float(_MOST - _NODES[0]))
    at = log[..., None] + _last(_NODES, log)
    # Beyond the table the filter's own mean is 0, and the sum of all its weights 1.
    weights = jnp.where(at <= _MOST, _read(values, at, _LEAST, step), 0.0)
    first = _read(below, at[..., 0], _LEAST, step)
    weights = jnp.concatenate([first[..., None], weights], axis=-1)
    return jnp.where(positive[..., None], weights, 0.0)


def _read(table: Float[Array, " entry"], at: Float[Array, "..."], start: float, step: float):
    """Values of a table with even steps by local cubics (Catmull-Rom); constant beyond its ends."""
    place = jnp.clip((at - start) / step, 1.0, table.shape[0] - 2.0)
    low = jnp.clip(jnp.floor(place).astype(int), 1, table.shape[0] - 3)
    t = place - low.astype(place.dtype)
    before, here, after, beyond = (table[low + i] for i in (-1, 0, 1, 2))
    slope, next_slope = 0.5 * (after - before), 0.5 * (beyond - here)
    rise = after - here
    return here + t * (
        slope + t * (3.0 * rise - 2.0 * slope - next_slope + t * (slope + next_slope - 2.0 * rise))
    )
