"""Where layers meet, and what outliers do: measured beside what the data allow.

    python -m tests.acceptance.profile_robust

Prints the table and writes it beside this file (profile_robust.md).  Seeded; some minutes.

Layers: casts of 3 bands, 60 depths evenly down to 3 % of the light, 5 % wave noise; below a depth
between 30 and 70 % of the range the Kd of every band is larger.  How much larger is set by the
ratio of the change to its own standard deviation in one band if the depth of the change were known
(Cramer-Rao).  Beside what is found stands what the Cramer-Rao bound of the depth of the change
allows, all bands together: the share of errors below one sample of a normal law with that
deviation.

Outliers: the same casts with and without a share of their samples wrong by a factor of 2 to 10,
up or down; beside it, the same casts with these samples left out by an oracle.  A fit without a
fifth of its samples differs from that of all by half of its standard deviation, so that even the
oracle moves 4.6 % of them by more than one.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from fitting import Profile
from fitting.core.result import quantile
from fitting.profile.kd.band_fit import BandBatch, fit_band_batch
from fitting.profile.kd.cast import cast_of
from tests.acceptance.profile_statistics import casts

NOISE, DEPTHS, BANDS = 0.05, 60, np.array([443.0, 490.0, 555.0])
RATIOS = (5.0, 7.5, 10.0, 20.0, 40.0)


def change_bound(depth, place, gain):
    """Cramer-Rao standard deviations, per unit of noise, of a change of Kd below `place` that is
    known, and of `place` where Kd changes by `gain` in every one of the bands."""
    below = np.maximum(depth - place, 0.0)
    known = np.stack([np.ones_like(depth), depth, below], axis=1)
    change = np.sqrt(np.linalg.inv(known.T @ known)[2, 2])
    slope = gain * (depth > place)
    left = slope - known @ np.linalg.lstsq(known, slope, rcond=None)[0]
    return change, 1.0 / np.sqrt(len(BANDS) * np.sum(left**2))


def layers(ratio: float, count: int = 300, seed: int = 5) -> dict[str, float]:
    """Share of casts in which the depth of the change is found within a sample, and allowed."""
    rng = np.random.default_rng(seed)
    found, allowed, number = [], [], []
    for _ in range(count):
        kd = np.exp(rng.uniform(np.log(0.05), np.log(0.5)))
        depth = np.linspace(0.02, 1.0, DEPTHS) * np.log(30.0) / kd
        spacing, place = depth[1] - depth[0], depth[-1] * rng.uniform(0.3, 0.7)
        gain = ratio * NOISE * change_bound(depth, place, 1.0)[0]
        clean = np.exp(-kd * depth - gain * np.maximum(depth - place, 0.0))
        noise = rng.standard_normal((DEPTHS, len(BANDS)))
        profile = Profile(
            depth, BANDS, clean[:, None] * (1 + NOISE * noise), floor=1e-6 * np.ones(len(BANDS))
        )
        reach = (0.0, float(depth[-1]))
        number.append(len(cast_of(profile, reach, None).window.interfaces))
        (interface,) = cast_of(profile, reach, 2).window.interfaces
        found.append(abs(interface - place) <= spacing)
        sd = NOISE * change_bound(depth, place, gain)[1]
        allowed.append(1 - 2 * norm.sf(spacing / sd))
    return {
        "found": float(np.mean(found)),
        "allowed": float(np.mean(allowed)),
        "two layers chosen": float(np.mean(np.array(number) == 1)),
        "one layer chosen": float(np.mean(np.array(number) == 0)),
    }


def outliers(share: float, count: int = 2000, seed: int = 6) -> dict[str, float]:
    """How far outliers move ln Kd in standard deviations of the fit without them."""
    _, log_kd, depth, _, seen, mask, floor = casts(count, seed)
    rng = np.random.default_rng(seed + 1)
    # The same number in every cast, at random places.
    rank = np.argsort(np.argsort(np.where(mask, rng.random(mask.shape), 2.0), axis=1), axis=1)
    wrong = rank < np.round(share * mask.sum(axis=1))[:, None]
    factor = np.exp(rng.choice([-1.0, 1.0], mask.shape) * rng.uniform(np.log(2), np.log(10)))

    def fit(readings, used):
        used = used & (readings > 0)
        zero = jnp.zeros(count)
        return fit_band_batch(
            BandBatch(
                jnp.asarray(np.maximum.accumulate(depth, axis=1)),
                jnp.asarray(np.where(used, readings, 1.0)),
                jnp.ones_like(depth),
                None,
                jnp.asarray(floor),
                zero,
                zero,
                jnp.asarray(used),
                jnp.zeros((count, 0)),
            )
        )

    clean = fit(seen, mask)
    spoilt, oracle = fit(np.where(wrong, seen * factor, seen), mask), fit(seen, mask & ~wrong)
    sd = np.sqrt(np.asarray(clean.covariance)[:, 1, 1])
    own = np.sqrt(np.asarray(spoilt.covariance)[:, 1, 1])
    x, y, z = (np.asarray(f.x)[:, 1] for f in (clean, spoilt, oracle))
    reach = np.array([quantile(0.95, float(dof)) for dof in spoilt.dof])
    return {
        "within": float(np.mean(np.abs(y - x) < sd)),
        "oracle": float(np.mean(np.abs(z - x) < sd)),
        "mean": float(np.mean((y - x) / sd)),
        "rms": float(np.sqrt(np.mean(((y - x) / sd) ** 2))),
        "oracle rms": float(np.sqrt(np.mean(((z - x) / sd) ** 2))),
        "coverage": float(np.mean(np.abs(y - log_kd) < reach * own)),
    }


def main():
    jax.config.update("jax_enable_x64", True)
    rows = [
        "# Layers and outliers\n",
        "`python -m tests.acceptance.profile_robust`: 300 casts a row of 3 bands and 60 depths, "
        "and 2,000 bands a row of 20-60 depths; 5 % wave noise.\n",
        "| change of Kd / its sd in one band | depth of the change within one sample | allowed by "
        "Cramer-Rao | two layers chosen | one layer chosen |",
        "|---|---|---|---|---|",
    ]
    for ratio in RATIOS:
        s = layers(ratio)
        rows.append(f"| {ratio:g} | " + " | ".join(f"{100 * v:.1f} %" for v in s.values()) + " |")
        print(rows[-1], flush=True)
    rows += [
        "\n| outliers | move ln Kd by < 1 sd | an oracle's omission | mean move / sd | rms move / "
        "sd | rms of the oracle | 95 % intervals cover |",
        "|---|---|---|---|---|---|---|",
    ]
    for share in (0.02, 0.05, 0.1, 0.2):
        s = outliers(share)
        rows.append(
            f"| {share:.0%} | {100 * s['within']:.1f} % | {100 * s['oracle']:.1f} % | "
            f"{s['mean']:+.3f} | {s['rms']:.2f} | {s['oracle rms']:.2f} | {s['coverage']:.3f} |"
        )
        print(rows[-1], flush=True)
    Path(__file__).with_suffix(".md").write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
