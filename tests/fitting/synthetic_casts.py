"""Casts of known truth with the columns and the noise of real profiling radiometers."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

# Share of the upwelling radiance that leaves a flat surface of n = 1.34.
LEAVING = (1 - (0.34 / 2.34) ** 2) / 1.34**2
TURBID_BANDS = np.array(
    [305, 320, 330, 340, 380, 412, 443, 465, 490, 510, 532, 555, 589, 625, 665, 683, 694, 710, 780],
    dtype=float,
)
# 1/m: a turbid estuary, green water over ultraviolet that is gone within a few metres.
TURBID_KD = np.array(
    [4.6, 4, 3.6, 3.2, 2.1, 1.49, 1.16, 0.95, 0.77, 0.63, 0.53, 0.48, 0.5, 0.64, 0.78, 0.86, 0.9]
)
TURBID_KD = np.append(TURBID_KD, [1.05, 2.9])
ED_BELOW, LU_BELOW = -0.09, 0.25


class TurbidCast(NamedTuple):
    """What `write_turbid_cast` wrote: nineteen bands, light in uW cm-2 nm-1 (sr-1)."""

    path: Path
    wavelength: np.ndarray
    Kd: np.ndarray
    KLu: np.ndarray
    Rrs: np.ndarray
    Es: np.ndarray
    tilt: np.ndarray
    nonpositive: np.ndarray


def write_turbid_cast(folder: Path, seed: int = 0, samples: int = 2000) -> TurbidCast:
    """A csv as a multispectral free-fall profiler's software exports it, no unit in it.

    From 30 m up to the surface, as recorded; Ed hangs 0.09 m above the pressure sensor and Lu
    0.25 m below it.  Waves of 10 % that fade with depth, electronic noise that makes up to half of
    a band's readings non-positive, tilt of 11 +- 4 degrees, light above that rises by 4 %.  Twice
    the arm of a shadow band passes over the reference: it takes five sixths of its light for a
    twenty-fifth of the cast, and nothing from the water.
    """
    rng = np.random.default_rng(seed)
    bands, kd = TURBID_BANDS, TURBID_KD
    depth = np.linspace(29.8, 0.15, samples) + 0.03 * rng.standard_normal(samples)
    level = 130 * np.exp(-(((bands - 500) / 180) ** 2))
    rrs = 0.005 * np.exp(-(((bands - 555) / 60) ** 2)) + 2e-4
    time = np.arange(samples) / samples
    above = 1.03 * level * (1 + 0.02 * np.linspace(-1, 1, samples))[:, None]
    share = np.ones(samples)
    for middle in (0.36, 0.59):
        arm = np.clip(1.6 - np.abs(time - middle) / 0.0125, 0, 1)
        share = np.minimum(share, 1 - arm * 5 / 6)
    waves = 1 + 0.1 * np.exp(-0.3 * depth)[:, None] * rng.standard_normal((samples, 1))
    ed = above / 1.03 * waves * np.exp(-kd * (depth[:, None] + ED_BELOW))
    ed = ed + 4e-4 * rng.standard_normal(ed.shape)
    klu = 1.02 * kd
    lu = rrs / LEAVING * above * np.exp(-klu * (depth[:, None] + LU_BELOW))
    lu = lu * (1 + 0.02 * rng.standard_normal(lu.shape)) + 5e-6 * rng.standard_normal(lu.shape)
    tilt = np.abs(11 + 4 * rng.standard_normal(samples))
    names = ["sample", "depth_m", "depth_good", "time_s", "Ed0_tilt_deg", "EdZ_tilt_deg"]
    names += [f"{kind}_{band:g}" for kind in ("Ed0", "EdZ", "LuZ") for band in bands]
    number = np.arange(samples, dtype=float)
    first = [number, depth, np.ones(samples), number // 15, np.full(samples, 3.0), tilt]
    table = np.hstack([np.stack(first, axis=1), above * share[:, None], ed, lu])
    path = folder / "turbid.csv"
    rows = [",".join(f"{value:.7g}" for value in row) for row in table]
    comment = "# turbid estuary; depth_m is that of the pressure sensor"
    path.write_text("\n".join([comment, ",".join(names), *rows]) + "\n")
    es = np.median(above, axis=0) / 100
    return TurbidCast(path, bands, kd, klu, rrs, es, tilt, np.mean(ed <= 0, axis=0))


class LayeredCast(NamedTuple):
    """`depth` (m), `wavelength` (nm), `Ed` (W m-2 nm-1, NaN below detection) and the true optical
    depth of every band, (depth, wl)."""

    depth: np.ndarray
    wavelength: np.ndarray
    Ed: np.ndarray
    optical_depth: np.ndarray

    def mean_kd(self, low: float, high: float) -> np.ndarray:
        """(wl,) true mean Kd between two depths of the cast, 1/m."""
        ends = [self.optical_depth[self.depth == z][0] for z in (high, low)]
        return (ends[0] - ends[1]) / (high - low)


def hyperspectral_cast(seed: int = 0) -> LayeredCast:
    """A hyperspectral cast on a grid of 1 m, 44 bands of 412-556 nm, of turbid over clear water.

    Kd falls smoothly about 12 m, in the blue from 0.23 to 0.03 1/m; 2 % noise, 10 % in the
    uppermost 3 m where waves are; values below 1e-3 W m-2 nm-1 are missing.
    """
    rng = np.random.default_rng(seed)
    depth = np.arange(1.0, 100.0)
    wavelength = np.round(412.0 + 3.33 * np.arange(44), 2)
    blue = (556.0 - wavelength) / 144.0
    deep = 0.06 - 0.03 * blue
    shallow = 0.10 + 0.13 * blue
    # The integral from the surface of a logistic step at 12 m, 2 m wide.
    step = 2.0 * (np.logaddexp(0, (depth - 12.0) / 2.0) - np.logaddexp(0, -6.0))
    optical = shallow * depth[:, None] - (shallow - deep) * step[:, None]
    spread = np.where(depth < 3.5, 0.1, 0.02)[:, None]
    Ed = 0.4 * np.exp(-optical) * (1 + spread * rng.standard_normal(optical.shape))
    return LayeredCast(depth, wavelength, np.where(Ed > 1e-3, Ed, np.nan), optical)
