"""Casts that went down and up, or several times: each way fitted by itself, then combined.

Two ways through the same water minutes apart differ by more than the noise along either of them:
the sun, the ship and the water itself have moved.  Their samples interleaved by depth would look
like independent readings of one cast.
"""

import dataclasses

import numpy as np

from fitting.observations.profile_sensor import MIN_DEPTHS
from fitting.profile.kd.band_fit import BandFit
from fitting.profile.kd.cast import FitWindow
from fitting.profile.kd.noise_statistics import correlation_inflation

# Ways that the variance between ways counts as known from, besides those of the cast: two ways
# alone would give Student's t of one degree of freedom, wider than casts ever differ.
_PRIOR_WAYS = 2


def ways_of(window: FitWindow) -> list[FitWindow]:
    """The window's samples way by way; the window alone where one way holds them all."""
    segment = window.profile.segment
    found = []
    for way in np.unique(segment):
        mask = window.mask & (segment == way)[:, None]
        if np.mean(mask.sum(axis=0) >= MIN_DEPTHS) > 0.5:
            found.append(dataclasses.replace(window, mask=mask))
    return found if len(found) > 1 else [window]


def combined(fits: list[BandFit]) -> BandFit:
    """One fit of ways that were fitted by themselves (numpy, each with a leading band axis).

    A random-effects mean by band and unknown: weights are 1/(variance + variance between ways),
    the latter shared by the bands and found by the method of moments (DerSimonian & Laird 1986,
    Control. Clin. Trials 7:177).  Its degrees of freedom are those of the ways, not of the bands,
    whose light fluctuates together; those of the sum are Welch and Satterthwaite's.
    """
    if len(fits) == 1:
        return fits[0]
    x, cov = (np.stack([getattr(f, name) for f in fits]) for name in ("x", "covariance"))
    count = np.stack([f.used.sum(axis=1) for f in fits])
    good = (np.stack([f.code for f in fits]) == 0) & (count >= MIN_DEPTHS)
    good &= np.all(np.isfinite(x), axis=-1) & np.all(np.isfinite(cov), axis=(-1, -2))
    variance = np.where(good[..., None], np.diagonal(cov, axis1=-2, axis2=-1), np.inf)
    between = _between(x, variance)
    weight = 1.0 / (variance + between)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    share = weight / total
    mean = np.sum(share * np.where(good[..., None], x, 0.0), axis=0)
    spread = cov + np.eye(x.shape[-1]) * between
    spread = np.where(good[..., None, None], spread, 0.0)
    covariance = np.einsum("kwi,kwij,kwj->wij", share, spread, share)
    any_good = good.any(axis=0)
    first = fits[0]
    dof = np.sum(np.where(good, np.stack([f.dof for f in fits]), 0.0), axis=0)
    # Welch and Satterthwaite: how well the variance of Kd is known, noise and ways apart.
    noise = np.sum(np.where(good, (share**2 * np.where(good[..., None], variance, 0.0))[..., 1],
                            0.0), axis=0)  # fmt: skip
    ways = np.sum(np.where(good, share[..., 1] ** 2, 0.0), axis=0) * between[1]
    number = np.maximum(good.sum(axis=0) - 1, 1) + _PRIOR_WAYS
    known = noise**2 / np.maximum(dof, 1.0) + ways**2 / number
    dof = (noise + ways) ** 2 / np.maximum(known, 1e-300)
    return BandFit(
        np.where(any_good[:, None], mean, first.x),
        np.where(any_good[:, None, None], covariance, first.covariance),
        _mean(np.stack([f.noise for f in fits]), good, np.asarray(first.noise)),
        np.where(any_good, dof, first.dof),
        _mean(np.stack([f.length for f in fits]), good, np.asarray(first.length)),
        _used(fits, good),
        np.where(any_good, 0, np.max([f.code for f in fits], axis=0)).astype(first.code.dtype),
    )


def _between(x: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """(unknown,) variance between ways, by moments over all bands: 0 where noise explains all."""
    weight = 1.0 / variance
    sums = np.maximum(weight.sum(axis=0), 1e-300)
    mean = np.sum(weight * np.where(weight > 0, x, 0.0), axis=0) / sums
    apart = np.sum(weight * np.where(weight > 0, x - mean, 0.0) ** 2, axis=(0, 1))
    expected = np.maximum((weight > 0).sum(axis=0) - 1, 0).sum(axis=0)
    scale = np.sum(sums - np.sum(weight**2, axis=0) / sums, axis=0)
    return np.maximum(apart - expected, 0.0) / np.maximum(scale, 1e-300)


def _used(fits: list[BandFit], good: np.ndarray) -> np.ndarray:
    """(wl, depth) the samples of all ways; a way that ended higher up was padded to fewer."""
    used = np.zeros((len(good[0]), max(f.used.shape[1] for f in fits)), bool)
    for fit, known in zip(fits, good, strict=True):
        used[:, : fit.used.shape[1]] |= np.asarray(fit.used) & known[:, None]
    return used


def _mean(values: np.ndarray, good: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    number = good.sum(axis=0)
    mean = np.sum(np.where(good, values, 0.0), axis=0) / np.maximum(number, 1)
    return np.where(number > 0, mean, otherwise)


def sample_deviations(
    depth: np.ndarray, segment: np.ndarray, used: np.ndarray, relative: np.ndarray, fit: BandFit
) -> np.ndarray:
    """(depth, wl) factors on the deviations of samples for fits that take them as independent.

    `relative` (depth, wl): their deviations over the light.  Noise is correlated along each way,
    and ways differ among themselves: the factors leave a straight line through ln light with the
    variance of Kd that the fit of all ways has.
    """
    factor = np.ones_like(relative)
    length = np.asarray(fit.length)
    ways = np.unique(segment)
    for way in ways:
        here = used & (segment == way)[:, None]
        factor = np.where(here, correlation_inflation(depth, here, length), factor)
    if len(ways) == 1:
        return factor
    weight = np.where(used, (relative * factor) ** -2.0, 0.0)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    away = depth[:, None] - np.sum(weight * depth[:, None], axis=0) / total
    straight = 1.0 / np.maximum(np.sum(weight * away**2, axis=0), 1e-300)
    kd = np.exp(np.asarray(fit.x)[:, 1])
    stated = np.asarray(fit.covariance)[:, 1, 1] * kd**2
    return factor * np.sqrt(np.maximum(stated / straight, 1.0))
