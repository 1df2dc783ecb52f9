"""Kd of every band by itself: an exponential, or one exponential per layer of the water."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting._programs import kept
from fitting.observations import MIN_DEPTHS
from fitting.solve import Optimum, covariance, least_squares, value_and_jacobian

RELATIVE_NOISE = 0.05
_ROUNDS = 4
_MAX_LAYERS = 4
_CANDIDATES = 60
_LEAST_LN_KD, _LARGEST_LN_KD = -46.0, 8.0


class BandFit(eqx.Module):
    """Fits of many bands: `x` = (ln Ed(0-), ln Kd of each layer), each with a leading band axis."""

    optimum: Optimum
    covariance: Float[Array, "*band unknown unknown"]
    noise: Float[Array, "*band"]


def thickness(depth, interfaces):
    """(..., layer): how far above each `depth` (m) each layer reaches; their sum is the depth.

    numpy in, numpy out.
    """
    xp = np if isinstance(depth, np.ndarray) else jnp
    edges = [0.0, *xp.asarray(interfaces, depth.dtype)]
    reaches = [xp.maximum(depth - top, 0.0) for top in edges]
    limits = [below - top for top, below in itertools.pairwise(edges)]
    return xp.stack([*map(xp.minimum, reaches[:-1], limits), reaches[-1]], axis=-1)


@kept
def fit_bands(
    depth: Float[Array, "band depth"],
    Ed: Float[Array, "band depth"],
    sigma: Float[Array, "band depth"] | None,
    floor: Float[Array, " band"],
    mask: Bool[Array, "band depth"],
    interfaces: Float[Array, " interface"] | None = None,
) -> BandFit:
    """Ed = Ed(0-) e^(-Kd z) for every band by itself; one compiled program for a padded batch.

    With `interfaces` (m, ascending, the same for all bands) Kd is constant in each layer and Ed
    is continuous.  Maximum likelihood with sd^2 = (noise Ed)^2 + floor^2 evaluated at the model,
    not at the noisy datum (which would favour low readings); `noise` is estimated from the
    residuals when `sigma` is None.
    """
    path = thickness(depth, jnp.zeros(0) if interfaces is None else interfaces)
    if sigma is None:
        return jax.vmap(functools.partial(_fit_band, None))(path, Ed, floor, mask)
    return jax.vmap(_fit_band)(sigma, path, Ed, floor, mask)


def _model(x, path):
    Kd = jnp.exp(jnp.clip(x[1:], _LEAST_LN_KD, _LARGEST_LN_KD))
    return jnp.exp(x[0] - path @ Kd)


def band_residual(x, args):
    """Misfit of one band in standard deviations, 0 where masked."""
    path, Ed, sd, mask = args
    return jnp.where(mask, (Ed - _model(x, path)) / sd, 0.0)


def _fit_band(sigma, path, Ed, floor, mask):
    count = jnp.sum(mask).astype(Ed.dtype)
    positive = jnp.where(mask, Ed, 1.0)
    start = _log_linear(
        path,
        jnp.log(positive),
        jnp.where(mask, positive**2, 0.0) / ((RELATIVE_NOISE * positive) ** 2 + floor**2),
    )

    def spread(x, noise):
        if sigma is not None:
            return jnp.where(mask, sigma, 1.0)
        return jnp.sqrt((noise * _model(x, path)) ** 2 + floor**2)

    def refine(carry, _):
        x, noise = carry
        optimum = least_squares(band_residual, x, (path, Ed, spread(x, noise), mask), max_steps=60)
        if sigma is None:
            excess = jnp.sum(optimum.residual**2) / jnp.maximum(count - x.shape[0], 1)
            noise = jnp.clip(noise * jnp.sqrt(excess), 1e-5, 1.0)
        return (optimum.x, noise), optimum.code

    rounds = _ROUNDS if sigma is None else 1
    (x, noise), codes = jax.lax.scan(
        refine, (start, jnp.asarray(RELATIVE_NOISE, start.dtype)), None, length=rounds
    )
    args = (path, Ed, spread(x, noise), mask)
    residual, jacobian = value_and_jacobian(lambda x: band_residual(x, args), x)
    optimum = Optimum(x, residual, jacobian, codes[-1])
    return BandFit(optimum, covariance(optimum.jacobian), noise)


def _log_linear(path, log_ed, weight):
    """Weighted straight lines through ln Ed: (intercept, ln slopes), the slopes kept positive."""
    total = jnp.sum(weight)
    mean_path, mean_y = weight @ path / total, weight @ log_ed / total
    centred = path - mean_path[None, :]
    matrix = (centred * weight[:, None]).T @ centred
    ridge = jnp.diag(jnp.maximum(1e-9 * jnp.diag(matrix), 1e-12))
    slope = -jnp.linalg.solve(matrix + ridge, centred.T @ (weight * (log_ed - mean_y)))
    slope = jnp.maximum(slope, 1e-4)
    return jnp.concatenate([(mean_y + slope @ mean_path)[None], jnp.log(slope)])


def choose_interfaces(
    depth: np.ndarray, Ed: np.ndarray, floor: np.ndarray, mask: np.ndarray, layers: int | None
) -> np.ndarray:
    """Depths (m) between `layers` layers; as many as lower the Bayes information criterion if None.

    `Ed`, `mask` (depth, wl); all bands share the interfaces, which lie on samples with at least
    `MIN_DEPTHS` usable ones between.  Found one by one, each time all are moved to their best place
    in turn.  The criterion takes samples for independent: noise that is correlated over depth
    makes it find more layers than there are.

    **Raises** ValueError if the samples do not suffice for so many layers.
    """
    used = depth[mask.any(axis=1)]
    places = np.unique(used)[MIN_DEPTHS:-MIN_DEPTHS]
    if len(places) > _CANDIDATES:
        places = places[np.linspace(0, len(places) - 1, _CANDIDATES).round().astype(int)]
    safe = np.where(mask, Ed, 1.0)
    weight = np.where(mask, safe**2, 0.0) / (safe**2 + (floor / RELATIVE_NOISE) ** 2)
    best: list[float] = []
    score = _criterion(depth, np.log(safe), weight, best)
    for count in range(2, (layers or _MAX_LAYERS) + 1):
        found = _added(depth, used, np.log(safe), weight, best, places)
        if layers is None and found[0] >= score:
            break
        if not found[1]:
            raise ValueError(
                f"layers is {layers}, but {len(used)} usable depths allow {count - 1}: each layer "
                f"needs at least {MIN_DEPTHS}."
            )
        score, best = found
    return np.array(best)


def _added(depth, used, log_ed, weight, interfaces, places) -> tuple[float, list[float]]:
    """(criterion, interfaces) with one interface more; (inf, []) where there is no room."""

    def best_place(others) -> tuple[float, list[float]]:
        tried = [sorted([*others, float(place)]) for place in places]
        tried = [one for one in tried if _roomy(used, one)]
        scores = [_criterion(depth, log_ed, weight, one) for one in tried]
        return min(zip(scores, tried, strict=True), default=(np.inf, []))

    found = best_place(interfaces)
    for _ in range(2 if interfaces else 0):
        for i in range(len(found[1])):
            found = min(found, best_place(found[1][:i] + found[1][i + 1 :]))
    return found


def _roomy(used, interfaces) -> bool:
    counts = np.histogram(used, [-np.inf, *interfaces, np.inf])[0]
    return bool(np.all(counts >= MIN_DEPTHS))


def _criterion(depth, log_ed, weight, interfaces) -> float:
    """Bayes information criterion of continuous straight lines through ln Ed, summed over bands."""
    edges = np.array([0.0, *interfaces, np.inf])
    path = np.clip(depth[:, None] - edges[None, :-1], 0.0, np.diff(edges)[None, :])
    design = np.concatenate([np.ones((len(depth), 1)), path], axis=1)
    normal = np.einsum("zi,zw,zj->wij", design, weight, design)
    normal += 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(len(edges))
    right = np.einsum("zi,zw->wi", design, weight * log_ed)
    line = design @ np.linalg.solve(normal, right[..., None])[..., 0].T
    count = np.maximum((weight > 0).sum(axis=0), 1)
    misfit = np.maximum((weight * (log_ed - line) ** 2).sum(axis=0) / count, 1e-12)
    unknowns = log_ed.shape[1] * design.shape[1] + len(interfaces)
    return float(np.sum(count * np.log(misfit)) + unknowns * np.log(count.sum()))
