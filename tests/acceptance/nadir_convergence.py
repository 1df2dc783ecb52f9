"""How many streams Rrs, Lu and a photograph's radiance need under a surface.

    python -m tests.acceptance.nadir_convergence    (writes nadir_convergence.md beside this file)

64 waters of the default bio-optical model (chlorophyll 0.02-30 mg/m3, CDOM 0.002-1 /m at 440 nm,
detritus 0.001-0.3 /m at 400 nm, minerals 0.01-10 g/m3 in three of five; log-uniform, seeded) in 13
bands of 400-700 nm, a quarter under each sun at 0, 20, 40 and 60 degrees.  Lu: upward radiance at
5 m.  Photograph: light scattered into four rays of 4 m at 5 m, every eighth water.  Truth: 96
streams, whose own error the row of 64 streams bounds; photograph: 48 streams, and 32 bound it.
Water without a surface, whose nodes are exact, checks the truth where little light comes back.
"""

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi

jax.config.update("jax_enable_x64", True)

BANDS = np.linspace(400.0, 700.0, 13)
SUNS = (0.0, 20.0, 40.0, 60.0)
WATERS, DEPTH, LENGTH = 64, 5.0, 4.0
STREAMS, MOST = (8, 12, 16, 24, 32, 64), 96
PHOTO_STREAMS, PHOTO_MOST = (8, 16, 24, 32), 48


def coefficients(seed: int = 5):
    """a (case,), b (shape, case) and phase functions; the bands of a water follow each other."""
    rng = np.random.default_rng(seed)
    model = oi.BioOpticalModel()
    a, b, phases = [], [], ()
    for _ in range(WATERS):
        ends = [(0.02, 30.0), (0.002, 1.0), (0.001, 0.3), (0.01, 10.0)]
        amounts = [np.exp(rng.uniform(*np.log(pair))) for pair in ends]
        amounts[3] *= rng.uniform() < 0.6
        water = model.iops(oi.Constituents(*amounts), BANDS)
        a.append(np.asarray(water.a))
        b.append(np.asarray(water.b_components))
        phases = water.phases
    return np.concatenate(a), np.concatenate(b, axis=1), phases


def scenes(every: int = 1):
    """One scene per sun, whose wavelengths are bands of waters one after another."""
    a, b, phases = coefficients()
    found = []
    for place, sun in enumerate(SUNS):
        waters = range(place, WATERS, len(SUNS) * every)
        pick = np.concatenate([np.arange(BANDS.size) + BANDS.size * i for i in waters])
        water = oi.IOPs(np.arange(1.0, pick.size + 1), a[pick], b[:, pick], phases)
        light = oi.Light(jnp.asarray(sun), jnp.ones(pick.size))
        found.append(oi.Scene(water, light, oi.FlatSurface()))
    return found


def nadir(scene, streams: int):
    """Rrs and Lu, (2, case)."""
    # Straight down only azimuth order 0 is seen.
    model = oi.PlaneParallel(streams=streams, orders=1)
    down = oi.Rays(jnp.asarray([[0.0, 0.0, DEPTH]]), jnp.asarray([[0.0, 0.0, 1.0]]))
    reflectance = oi.apparent.remote_sensing_reflectance(scene, model)
    return np.stack([reflectance, oi.radiance(scene, down, model).value[0]])


def photograph(scene, streams: int):
    """Radiance of the water between camera and object, (ray, case)."""
    looks = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.3], [1.0, 1.0, 1.0]])
    looks /= np.linalg.norm(looks, axis=1)[:, None]
    start = jnp.tile(jnp.asarray([[0.0, 0.0, DEPTH]]), (4, 1))
    rays = oi.Rays(start, jnp.asarray(looks), jnp.full(4, LENGTH))
    return np.asarray(oi.radiance(scene, rays, oi.PlaneParallel(streams=streams)).value)


def compared(name, measure, waters, streams, most):
    """Rows of the table."""
    truth = [measure(scene, most) for scene in waters]
    rows = []
    for count in streams:
        found, seconds = [], []
        for scene in waters:
            begin = time.process_time()
            found.append(measure(scene, count))
            seconds.append(time.process_time() - begin)
        cost = 1e3 * min(seconds) / found[0].shape[-1]
        errors = [f / t - 1 for f, t in zip(found, truth, strict=True)]
        for label, part in name:
            each = [np.abs(e[part]) for e in errors]
            every = np.concatenate([e.ravel() for e in each])
            cells = [np.median(every), np.quantile(every, 0.95), every.max()]
            cells += [e.max() for e in each]
            numbers = " | ".join(f"{100 * v:.3f}" for v in cells)
            rows.append(f"| {label} | {count} | {numbers} | {cost:.1f} |")
            print(rows[-1], flush=True)
    return rows


def with_over_without_surface() -> list[str]:
    """Upward radiance per unit of sunbeam, sun in the zenith: under a surface over without one,
    whose nodes integrate exactly.  The ratio goes to 1 where no light comes back from below."""
    particles = oi.phase.HenyeyGreenstein(0.95)
    phase = oi.phase.Mixture(jnp.asarray([0.96, 0.04]), [particles, oi.phase.Isotropic()])
    down = oi.Rays(jnp.zeros((1, 3)), jnp.asarray([[0.0, 0.0, 1.0]]))
    absorbing = jnp.asarray([0.4, 0.8, 2.0, 8.0])
    water = oi.IOPs(BANDS[:4], absorbing, jnp.full(4, 0.4), phase)
    found = []
    for surface in (oi.FlatSurface(), None):
        scene = oi.Scene(water, oi.Light(jnp.asarray(0.0), jnp.ones(4)), surface)
        model = oi.PlaneParallel(streams=32, orders=1)
        found.append(oi.radiance(scene, down, model).value[0] / scene.beam()[1])
    under = oi.Scene(water, oi.Light(jnp.asarray(0.0), jnp.ones(4)), oi.FlatSurface())
    back = oi.apparent.irradiance_reflectance(under)
    ratio = found[0] / found[1]
    return [f"{x:.4f} ({100 * r:.2f} %)" for x, r in zip(ratio, back, strict=True)]


def run() -> str:
    """The report."""
    head = "| | streams | median | 95 % | largest | " + " | ".join(
        f"largest, sun {sun:g}" for sun in SUNS
    )
    lines = [
        "# Streams that radiances under a surface need",
        "",
        f"`python -m tests.acceptance.nadir_convergence`: {WATERS} waters, {BANDS.size} bands;",
        f"|relative error| in % against {MOST} streams (photograph: {PHOTO_MOST}).  Last:"
        " processor",
        "ms per wavelength, of Rrs and Lu together in azimuth order 0, of the photograph in all.",
        "",
        head + " | ms |",
        "|---" * 10 + "|",
    ]
    lines += compared((("Rrs", 0), ("Lu", 1)), nadir, scenes(), STREAMS, MOST)
    part = (("photograph", slice(None)),)
    lines += compared(part, photograph, scenes(every=8), PHOTO_STREAMS, PHOTO_MOST)
    lines += [
        "",
        "Upward radiance under a surface over that without, 32 streams, Henyey-Greenstein",
    ]
    lines += ["0.95 and 4 % isotropic, sun in the zenith (irradiance reflectance of the water):"]
    lines += [", ".join(with_over_without_surface()) + "."]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    begin = time.time()
    table = run()
    Path(__file__).with_suffix(".md").write_text(table)
    print(table, f"{time.time() - begin:.0f} s")
