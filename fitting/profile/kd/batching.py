"""Batches of bands: windows of casts padded to shared shapes, in chunks of one size."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from fitting.core.diagnostics import Status
from fitting.observations.profile_sensor import MIN_DEPTHS
from fitting.profile.kd.band_fit import LEAST_LN_KD, BandBatch, BandFit, fit_band_batch
from fitting.profile.kd.cast import FitWindow
from fitting.profile.kd.ways import combined, ways_of

# BandBatch of one compiled call for many casts of up to 128 depths; of longer ones fewer.
MOST = 1024
# Variance of a logarithm of which nothing is known.
_UNKNOWN = 1e4


def band_batch(windows: Sequence[FitWindow], size_of_batch: int | None = None) -> BandBatch:
    """The bands of casts that share a shape; `size_of_batch`: padded to so many."""
    size, given, interfaces = windows[0].shape
    count = sum(len(window.profile.wavelength) for window in windows)
    total = size_of_batch or count

    def blank(fill, dtype: type = float, *shape: int):
        return np.full((total, *shape), fill, dtype)

    depth, Ed, reference = (blank(fill, float, size) for fill in (0.0, 1.0, 1.0))
    sigma = blank(1.0, float, size) if given else None
    mask, edges = blank(False, bool, size), blank(1.0, float, interfaces)
    floor, dark, dark_sd = blank(0.0), blank(0.0), blank(0.0)
    at = 0
    for window in windows:
        profile, n = window.profile, window.rows
        to = slice(at, at + len(profile.wavelength))
        used = window.mask[:n].T
        # The last depth goes on through the padding, so that depths ascend.
        depth[to] = profile.depth[n - 1]
        depth[to, :n] = profile.depth[:n]
        mask[to, :n] = used
        Ed[to, :n] = np.where(used, profile.Ed[:n].T, 1.0)
        if profile.reference is not None:
            reference[to, :n] = np.where(used, profile.reference[:n].T, 1.0)
        if sigma is not None and profile.sigma is not None:
            sigma[to, :n] = np.where(used, profile.sigma[:n].T, 1.0)
        floor[to], dark[to], dark_sd[to] = profile.floor, profile.dark, profile.dark_sd
        edges[to] = window.interfaces
        at = to.stop
    if at < total:
        # Unused places of a chunk hold a plain exponential.
        depth[at:] = np.linspace(0.0, 1.0, size)
        Ed[at:], mask[at:] = np.exp(-depth[at:]), True
        edges[at:] = np.linspace(0.3, 0.7, interfaces)
    arrays = (depth, Ed, reference, sigma, floor, dark, dark_sd, mask, edges)
    # device_put, unlike jnp.asarray, compiles nothing.
    return BandBatch(*jax.device_put(arrays))


def fit_windows(windows: Sequence[FitWindow]) -> list[BandFit]:
    """Fits of casts, each with a leading band axis; casts of several ways by `combined`."""
    split = [ways_of(window) for window in windows]
    fits = iter(_fit_each([way for ways in split for way in ways]))
    return [combined([next(fits) for _ in ways]) for ways in split]


def _fit_each(windows: Sequence[FitWindow]) -> list[BandFit]:
    """Fits with a leading band axis; many go in chunks of one size.

    The result of a cast does not depend on the others: a chunk is many independent bands, and
    which program runs depends on the cast's own shape.
    """
    if len(windows) == 1:
        return [_numpy(fit_band_batch(band_batch(windows)))]
    shapes = [window.shape for window in windows]
    bands = [len(window.profile.wavelength) for window in windows]
    fits: dict[int, BandFit] = {}

    def run(group: list[int]) -> None:
        chunk = _chunk(shapes[group[0]][0])
        total = chunk * -(-sum(bands[i] for i in group) // chunk)
        done = _numpy(fit_band_batch(_spread(band_batch([windows[i] for i in group], total))))
        at = 0
        for i in group:
            to = slice(at, at + bands[i])
            fits[i] = jax.tree.map(lambda array, to=to: array[to], done)
            at = to.stop

    group: list[int] = []
    bands_so_far = 0
    for i in sorted(range(len(windows)), key=lambda i: shapes[i]):
        full = bands_so_far + bands[i] > _chunk(shapes[i][0])
        if group and (shapes[i] != shapes[group[0]] or full):
            run(group)
            group, bands_so_far = [], 0
        group.append(i)
        bands_so_far += bands[i]
    run(group)
    return [fits[i] for i in range(len(windows))]


def _chunk(rows: int) -> int:
    """Bands that are fitted together: memory grows with their depths."""
    return max(MOST * 128 // max(rows, 128), 16)


def _numpy(fit: BandFit) -> BandFit:
    """The fit as numpy arrays; bands that kept hardly a sample, or whose Kd ran to the end of its
    range, are marked as not converged, with variances that say that nothing is known."""
    fit = jax.tree.map(np.asarray, fit)
    known = (fit.used.sum(axis=1) >= MIN_DEPTHS) & np.all(fit.x[:, 1:] > LEAST_LN_KD + 1.0, axis=1)
    known &= np.all(np.isfinite(fit.x), axis=1) & np.all(np.isfinite(fit.covariance), axis=(1, 2))
    code = np.where(known, fit.code, np.maximum(fit.code, Status.STEP_LIMIT))
    unknown = _UNKNOWN * np.eye(fit.x.shape[1], dtype=fit.covariance.dtype)
    covariance = np.where(known[:, None, None], fit.covariance, unknown)
    x = np.where(np.isfinite(fit.x), fit.x, 0.0)
    return dataclasses.replace(fit, x=x, covariance=covariance, code=code.astype(fit.code.dtype))


def _spread(batch: BandBatch) -> BandBatch:
    """Bands shared out over the local devices, where there are several."""
    devices = jax.local_devices()
    if len(devices) == 1 or len(batch.dark) % len(devices):
        return batch
    mesh = jax.sharding.Mesh(np.array(devices), ("band",))
    return jax.device_put(batch, jax.NamedSharding(mesh, jax.sharding.PartitionSpec("band")))
