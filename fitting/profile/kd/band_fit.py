"""Kd of every band by itself: an exponential, or one exponential per layer of the water.

What one sensor saw on its way down,

    Ed_i = s_i Ed(0-) e^(-Kd z_i) (1 + waves_i) + dark + electronics_i,

with s the light above the surface relative to its median.  Waves focus light: their part is
relative, may be larger near the surface and is correlated over depth.

The search is written by hand because it is no least-squares problem alone: each step chooses the
outliers anew and, where errors are not given, the noise.  Measured on 1,050 bands of 100 depths
with given errors, on two cores, against all of `fit_band_batch`: a vmapped search of optimistix
before outliers are left out and another afterwards take 1.0 to 1.1 times the processor time with
`optimistix.GaussNewton`, which limits no step, 1.8 to 2.5 times with the trust region of
`fitting.core.least_squares` and 6.7 to 7.6 times with `optimistix.LevenbergMarquardt` (1e-6); the
first call, which compiles, 1.3 to 1.8 times.  With the same outliers the answers agree within 4e-7
standard deviations.  Where the noise is estimated, each round would need a search of its own.
"""

import functools
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.core.program_cache import cached_jit
from fitting.profile.kd.noise_statistics import correlation_of_neighbours, previous_used, whiten

RELATIVE_NOISE = 0.05
# Standard deviations beyond which a reading is an outlier: one in 16,000 good ones is lost.
CUT = 4.0
_START_ROUNDS = 5
# With given errors only the curve has to converge, else the noise too.
_ROUNDS_GIVEN, _ROUNDS = 5, 12
_SETTLED = 4
LEAST_LN_KD, _LARGEST_LN_KD = -46.0, 8.0
_LARGEST_LN_ED = 300.0
# Candidates for the waves: correlation lengths in median spacings, and how the relative noise
# rises towards the surface, 1 + gain e^(-z / (share of the range)).
_LENGTHS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
_LONGEST = 1 / 5  # of the range: longer waves cannot be told from the water
_RISES = ((0.0, 1.0), (2.0, 0.1), (4.0, 0.05))
# Prior odds of correlated against independent noise (no preference), and of rising against even.
_ODDS_CORRELATED, _ODDS_RISING = 1.0, 0.2


# Arrays of JAX, of numpy once a fit is done.
Numbers = Array | np.ndarray


class BandBatch(eqx.Module):
    """Bands of casts side by side, samples by depth, padded at the end.

    `depth` m; `Ed`; `reference`: s above; `sigma`: standard deviations of Ed, None to estimate
    them; `floor`: of the electronics; `dark`, `dark_sd`: reading in darkness and how well it is
    known (0: not in question); `mask`; `interfaces`: m, ascending, between layers of constant Kd.
    """

    depth: Float[Array, "*band depth"]
    Ed: Float[Array, "*band depth"]
    reference: Float[Array, "*band depth"]
    sigma: Float[Array, "*band depth"] | None
    floor: Float[Array, "*band"]
    dark: Float[Array, "*band"]
    dark_sd: Float[Array, "*band"]
    mask: Bool[Array, "*band depth"]
    interfaces: Float[Array, "*band interface"]


class BandFit(eqx.Module):
    """Fits of bands: `x` = (ln Ed(0-), ln Kd of each layer), each with a leading band axis.

    - `noise`: relative, without the electronics.
    - `dof`: how many independent samples the noise was estimated from, less the unknowns.
    - `length`: m over which the waves are correlated, mean over the candidates, 0 if they are not.
    - `used`: samples that were not outliers.
    - `code`: of `fitting.core.diagnostics.Status`.
    """

    x: Float[Numbers, "*band unknown"]
    covariance: Float[Numbers, "*band unknown unknown"]
    noise: Float[Numbers, "*band"]
    dof: Float[Numbers, "*band"]
    length: Float[Numbers, "*band"]
    used: Bool[Numbers, "*band depth"]
    code: Int[Numbers, "*band"]


def thickness(depth, interfaces):
    """(..., layer): how far above each `depth` (m) each layer reaches; their sum is the depth.

    numpy in, numpy out.
    """
    xp = np if isinstance(depth, np.ndarray) else jnp
    edges = [0.0, *xp.asarray(interfaces, depth.dtype)]
    reaches = [xp.maximum(depth - top, 0.0) for top in edges]
    limits = [below - top for top, below in itertools.pairwise(edges)]
    return xp.stack([*map(xp.minimum, reaches[:-1], limits), reaches[-1]], axis=-1)


@cached_jit
def fit_band_batch(batch: BandBatch) -> BandFit:
    """Maximum likelihood for every band by itself; one compiled program for a padded batch.

    The standard deviation is evaluated at the model, not at the noisy datum (which would favour
    low readings).  A robust start (least absolute deviations of ln Ed), then Gauss-Newton with
    outliers left out, in a fixed number of rounds, so that no band waits for another.  Where the
    noise is estimated, the answer is the mean over candidates for the waves' rise and correlation,
    weighted by their restricted likelihood, and its covariance holds their disagreement.
    """
    return jax.vmap(_fit_band)(batch)


def _signal(x, path, reference):
    Kd = jnp.exp(jnp.clip(x[1:], LEAST_LN_KD, _LARGEST_LN_KD))
    return reference * jnp.exp(
        jnp.clip(x[0], -_LARGEST_LN_ED, _LARGEST_LN_ED) - jnp.sum(path * Kd[None, :], axis=1)
    )


def band_residual(x, args):
    """Misfit of one band in standard deviations, 0 where masked."""
    path, Ed, sd, mask = args
    return jnp.where(mask, (Ed - _signal(x, path, jnp.ones_like(Ed))) / sd, 0.0)


def _inverse(matrix):
    """Inverse and ln det of a small positive matrix by Gauss-Jordan, unrolled: no call per band."""
    n = matrix.shape[-1]
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 1e-150))
    identity = jnp.eye(n, dtype=matrix.dtype)
    rows = jnp.concatenate([matrix / (scale[:, None] * scale[None, :]), identity], axis=1)
    volume = 2.0 * jnp.sum(jnp.log(scale))
    for i in range(n):
        pivot = jnp.maximum(rows[i, i], 1e-13)
        volume += jnp.log(pivot)
        row = rows[i] / pivot
        rows = rows - (rows[:, i] - identity[i])[:, None] * row[None, :]
    return rows[:, n:] / (scale[:, None] * scale[None, :]), volume


def _weighted(jacobian, weight, right):
    """(J^T W J, J^T W r) as sums of products: faster in a batch than small matrix products."""
    moved = (jacobian * weight[:, None]).T
    return moved @ jacobian, moved @ right


def _start(path, y, weight):
    """Least absolute deviations through ln Ed: (intercept, ln slopes), slopes kept positive."""
    design = jnp.concatenate([jnp.ones_like(y)[:, None], -path], axis=1)

    def refine(_, carry):
        beta, robust = carry
        matrix, right = _weighted(design, weight * robust, y)
        ridge = jnp.diag(1e-9 * jnp.diagonal(matrix) + 1e-12)
        beta = _inverse(matrix + ridge)[0] @ right
        return beta, 1.0 / jnp.maximum(jnp.abs(y - design @ beta), 0.2 * RELATIVE_NOISE)

    zero = jnp.zeros(design.shape[1], y.dtype)
    beta, _ = jax.lax.fori_loop(0, _START_ROUNDS, refine, (zero, jnp.ones_like(y)))
    return jnp.concatenate([beta[:1], jnp.log(jnp.maximum(beta[1:], 1e-4))])


def _median(values, mask):
    """Median of the masked-in values."""
    count = jnp.sum(mask)
    ordered = jnp.sort(jnp.where(mask, values, jnp.inf))
    return 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])


class _Curve(eqx.Module):
    """What one band is fitted with: its samples, and the thickness of layers above them."""

    band: BandBatch
    path: Float[Array, "depth layer"]

    def spread(self, signal, noise, rise: Any = 1.0):
        """(depth,) standard deviations: given ones, or of waves and electronics."""
        if self.band.sigma is not None:
            return jnp.where(self.band.mask, self.band.sigma, 1.0)
        return jnp.sqrt((noise * rise * signal) ** 2 + self.band.floor**2)

    def linear(self, state):
        """Signal, its slopes and the misfit at (x, dark in its standard deviations)."""
        band, path = self.band, self.path
        signal = _signal(state[:-1], path, band.reference)
        Kd = jnp.exp(jnp.clip(state[1:-1], LEAST_LN_KD, _LARGEST_LN_KD))
        dark = jnp.broadcast_to(band.dark_sd, signal.shape)
        slopes = jnp.concatenate([jnp.ones_like(dark)[:, None], -path * Kd[None, :]], axis=1)
        misfit = band.Ed - signal - band.dark - state[-1] * band.dark_sd
        return signal, jnp.concatenate([slopes * signal[:, None], dark[:, None]], axis=1), misfit

    def usual(self, misfit, sd):
        """(depth,) samples that are no outliers."""
        return self.band.mask & (jnp.abs(misfit) < CUT * sd)

    def within_bounds(self, state):
        """The state, held where values stay finite."""
        low, high = (
            jnp.full_like(state, ln_kd).at[0].set(ln_ed)
            for ln_kd, ln_ed in ((LEAST_LN_KD, -_LARGEST_LN_ED), (_LARGEST_LN_KD, _LARGEST_LN_ED))
        )
        return jnp.clip(state, low, high)


def _fit_band(band: BandBatch):
    curve = _Curve(band, jnp.asarray(thickness(band.depth, band.interfaces)))
    state, noise, scale = _robust_start(curve)
    state, noise, moved = _gauss_newton(curve, state, noise, scale)
    signal, jacobian, misfit = curve.linear(state)
    sd = curve.spread(signal, noise)
    used = curve.usual(misfit, scale * sd)
    code = jnp.where(jnp.isfinite(moved), jnp.where(moved < 1e-4, 0, 1), 2)
    if band.sigma is not None:
        matrix, _ = _weighted(jacobian, jnp.where(used, 1.0 / sd**2, 0.0), misfit)
        covariance = _inverse(matrix + jnp.diag(_dark_prior(state)))[0]
        count = jnp.sum(band.mask).astype(band.Ed.dtype)
        freedom, length = count - (len(state) - 1), jnp.zeros_like(noise)
    else:
        state, (covariance, noise, freedom, length, used) = _mean_over_waves(
            curve, state, noise, used
        )
    return BandFit(
        curve.within_bounds(state)[:-1],
        covariance[:-1, :-1],
        noise,
        freedom,
        length,
        used,
        code.astype(jnp.int32),
    )


def _dark_prior(state):
    """Weights of the prior: the dark level, in its standard deviations, is known by itself."""
    return jnp.zeros_like(state).at[-1].set(1.0)


def _robust_start(curve: _Curve):
    """A first state by least absolute deviations, the noise, and the scale of given errors."""
    band, given = curve.band, curve.band.sigma is not None
    light = jnp.where(band.mask, (band.Ed - band.dark) / band.reference, 1.0)
    positive = jnp.maximum(light, 1e-3 * jnp.maximum(band.floor, 1e-300))
    expected = (RELATIVE_NOISE * positive) ** 2 + band.floor**2
    if band.sigma is not None:
        # The errors are given for Ed; `light` is relative to the light above.
        expected = (jnp.where(band.mask, band.sigma, 1.0) / band.reference) ** 2
    relative = jnp.where(band.mask & (light > 0), positive**2 / expected, 0.0)
    x = _start(curve.path, jnp.log(positive), relative)
    state = jnp.concatenate([x, jnp.zeros_like(x[:1])])
    signal, _, misfit = curve.linear(state)
    size = jnp.abs(misfit) / curve.spread(signal, RELATIVE_NOISE)
    scale = jnp.maximum(1.4826 * _median(size, band.mask), 1e-4)
    noise = jnp.minimum(RELATIVE_NOISE * scale, 1.0)
    # Given errors may be too small; they must not make outliers of everything.
    return state, noise, jnp.maximum(scale, 1.0) if given else jnp.ones_like(scale)


def _gauss_newton(curve: _Curve, state, noise, scale):
    """The state and the noise after a fixed number of steps, and how far the last one went,
    squared, in standard deviations."""
    band, given = curve.band, curve.band.sigma is not None
    rounds, dark_prior = _ROUNDS_GIVEN if given else _ROUNDS, _dark_prior(state)

    def refine(carry, step):
        state, noise, used = carry
        signal, jacobian, misfit = curve.linear(state)
        sd = curve.spread(signal, noise)
        # Freeze the outlier mask in the last rounds: a borderline sample would oscillate.
        now = curve.usual(misfit, scale * sd)
        used = now if given else jnp.where(step < rounds - _SETTLED, now, used)
        weight = jnp.where(used, 1.0 / sd**2, 0.0)
        matrix, right = _weighted(jacobian, weight, misfit)
        matrix, right = matrix + jnp.diag(dark_prior), right - dark_prior * state
        move = jnp.clip(_inverse(matrix)[0] @ right, -1.0, 1.0)
        if not given:
            freedom = jnp.maximum(jnp.sum(used) - (len(state) - 1), 1).astype(noise.dtype)
            excess = jnp.sum(weight * misfit**2) / freedom
            updated = jnp.clip(noise * jnp.sqrt(excess), 1e-5, 1.0)
            # The first rounds still move the curve: the robust scale holds meanwhile.
            noise = jnp.where(step < 3, noise, updated)
        # A band without light runs away: it stays finite here and ends as not converged.
        return (curve.within_bounds(state + move), noise, used), move @ matrix @ move

    start = (state, noise, band.mask)
    (state, noise, _), moved = jax.lax.scan(refine, start, jnp.arange(rounds))
    return state, noise, moved[-1]


def _mean_over_waves(curve: _Curve, state, noise, used):
    """The state by the mean over candidates for the waves; covariance, noise, degrees of freedom,
    correlation length and the samples that are no outliers then."""

    def improve(carry, _):
        state, used = carry
        signal, jacobian, misfit = curve.linear(state)
        sd_of = functools.partial(curve.spread, signal)
        found = _averaged(curve.band, state, jacobian, misfit, noise, used, sd_of)
        # Strong waves near the surface are no outliers once they are seen to be usual there.
        used = curve.usual(misfit, found[-1])
        return (state + found[0], used), (*found[1:-1], used)

    (state, _), found = jax.lax.scan(improve, (state, used), None, length=2)
    return state, jax.tree.map(lambda leaf: leaf[-1], found)


def _averaged(band, state, jacobian, misfit, noise, used, spread):
    """Mean over the candidates for the waves, each by generalised least squares.

    Returns the step from `state`, its covariance, relative noise, degrees of freedom, mean length,
    and the standard deviations of the likeliest candidate.
    """
    before, first = previous_used(used)
    gap = band.depth - band.depth[before]
    top = jnp.min(jnp.where(used, band.depth, jnp.inf))
    reach = jnp.max(jnp.where(used, band.depth, -jnp.inf)) - top
    spacing = _median(gap, used & ~first & (gap > 0))
    spacing = jnp.where(jnp.isfinite(spacing), spacing, reach)
    n = jnp.sum(used).astype(misfit.dtype)
    p = state.shape[0]
    freedom = jnp.maximum(n - (p - 1), 1.0)

    def candidate(steps, gain, share):
        rise = 1.0 + gain * jnp.exp(-(band.depth - top) / (share * jnp.maximum(reach, 1e-6)))
        even = jnp.sqrt(jnp.sum(jnp.where(used, rise**2, 0.0)) / n)
        sd = spread(noise, rise / even)
        length = steps * spacing
        rho = jnp.where(first, 0.0, correlation_of_neighbours(gap, length))
        rest = jnp.sqrt(1.0 - rho**2)

        scaled = jnp.concatenate([jacobian, misfit[:, None]], axis=1) / sd[:, None]
        scaled = jnp.where(used[:, None], scaled, 0.0)
        whitened = jnp.where(used[:, None], whiten(scaled, before, rho), 0.0)
        whitened, right = whitened[:, :-1], whitened[:, -1]
        # The dark level is known by itself: one more independent observation.
        prior = jnp.zeros(p, misfit.dtype).at[-1].set(1.0)
        matrix, slope = _weighted(whitened, jnp.ones_like(misfit), right)
        inverse, volume_of = _inverse(matrix + jnp.diag(prior))
        move = inverse @ (slope - prior * state)
        square = jnp.maximum(
            jnp.sum((right - jnp.sum(whitened * move[None, :], axis=1)) ** 2), 1e-300
        )
        scale = square / freedom
        volume = jnp.sum(jnp.where(used, jnp.log(sd) + jnp.log(rest), 0.0))
        likelihood = -0.5 * (freedom * jnp.log(square) + volume_of) - volume
        allowed = (steps == 0) | (length <= _LONGEST * reach)
        prior_weight = jnp.where(steps == 0, 0.0, jnp.log(_ODDS_CORRELATED / (len(_LENGTHS) - 1.0)))
        prior_weight += jnp.where(gain == 0, 0.0, jnp.log(_ODDS_RISING / (len(_RISES) - 1.0)))
        likelihood = jnp.where(allowed, likelihood + prior_weight, -jnp.inf)
        middle = correlation_of_neighbours(spacing, length)
        share_left = (1.0 - middle) / (1.0 + middle)
        return likelihood, move, scale * inverse, scale, share_left, length, jnp.sqrt(scale) * sd

    grid = [(s, g, w) for s in _LENGTHS for g, w in _RISES]
    columns = [jnp.asarray(column, misfit.dtype) for column in zip(*grid, strict=True)]
    likelihood, move, inverse, scale, share, length, sd = jax.vmap(candidate)(*columns)
    weight = jax.nn.softmax(likelihood)
    mean = weight @ move
    apart = move - mean[None, :]
    covariance = jnp.einsum("k,kij->ij", weight, inverse + apart[:, :, None] * apart[:, None, :])
    freedom = jnp.maximum((weight @ share) * freedom, 1.0)
    noise = noise * jnp.sqrt(weight @ scale)
    best = jnp.argmax(likelihood)
    return mean, covariance, noise, freedom, weight @ length, sd[best]
