"""The picture of Gutierrez et al. 2008: 512 x 384 pixels, ten kinds of event, a point light.

    python -m tests.benchmarks.bench_gutierrez [walks per pixel, default 64 [width, default 512]]

The paper: 20 minutes on two Xeons of 2.8 GHz in 2008, 400000 photons, at most five interactions.
Here CPU seconds of the same view in four sizes up to the width that is asked for.
A run is written down in gutierrez.md.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi

BANDS = np.arange(390.0, 701.0, 20.0)
WHITE = jnp.ones(len(BANDS))


def scene() -> oi.Scene:
    """Three spheres over a floor, lit by a lamp; the printed model at the ends of table 5."""
    amounts = oi.Constituents(chlorophyll=1.0, cdom=0.1, detritus=0.1)
    return oi.Scene(
        oi.gutierrez2008().iops(amounts, BANDS),
        oi.Light(0.0, 0.0 * WHITE),
        oi.FlatSurface(1.34),
        oi.Floor(8.0, 0.3 * WHITE),
        objects=tuple(
            oi.Sphere(centre, 0.5, r * WHITE)
            for centre, r in (
                ([0.0, 3.0, 7.4], 0.5),
                ([-1.2, 4.0, 7.3], 0.8),
                ([1.2, 4.0, 7.2], 0.2),
            )
        ),
        lamps=(oi.PointLamp([0.5, 2.0, 5.0], WHITE),),
        inelastic=oi.Inelastic(oi.Raman(), oi.ChlorophyllFluorescence(), oi.CDOMFluorescence()),
    )


def picture(lit: oi.Scene, transport: oi.MonteCarlo, width: int) -> tuple[float, float]:
    """CPU seconds of a picture `width` pixels wide, 4:3, and its median relative error."""
    camera = oi.Camera(
        [0.0, 0.0, 6.6],
        [0.0, 1.0, 0.15],
        [0.0, 0.0, -1.0],
        60.0,
        width,
        3 * width // 4,
        oi.spectrum.cie_1931(),
    )
    start = time.process_time()
    found = oi.photograph(lit, camera, transport, key=jax.random.key(1))
    found = jax.block_until_ready(found)
    seconds = time.process_time() - start
    return seconds, float(np.nanmedian(np.asarray(found.stderr / found.value)[..., 1]))


def main() -> None:
    walks = int(sys.argv[1]) if len(sys.argv) > 1 else 64
    width = int(sys.argv[2]) if len(sys.argv) > 2 else 512
    lit, transport = scene(), oi.MonteCarlo(walks, 8)
    print(f"{transport.paths} walks of 8 events a pixel, {len(BANDS)} bands, three processes")
    print("| picture | first call, s of CPU | again, s of CPU | ms a pixel | stderr of luminance |")
    print("|---|---|---|---|---|")
    for wide in (width // 16, width // 8, width // 4, width):
        first, error = picture(lit, transport, wide)
        # The largest is drawn once: compiling it takes no longer than the others.
        seconds = first if wide == width else picture(lit, transport, wide)[0]
        again = "-" if wide == width else f"{seconds:.1f}"
        each = 1e3 * seconds / (wide * (3 * wide // 4))
        print(
            f"| {wide} x {3 * wide // 4} | {first:.1f} | {again} | {each:.2f} | {error:.1%} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
