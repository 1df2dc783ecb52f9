"""The picture of Gutierrez et al. 2008: 512 x 384 pixels, ten kinds of event, a point light.

    python -m tests.benchmarks.bench_gutierrez [walks per pixel, default 64]

The paper: 20 minutes on two Xeons of 2.8 GHz in 2008, 400000 photons, at most five interactions.
Here CPU seconds of smaller pictures of the same view; cost per pixel is the same for all sizes but
the least, so the last line scales the larger up.
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


def main() -> None:
    walks = int(sys.argv[1]) if len(sys.argv) > 1 else 64
    lit, transport = scene(), oi.MonteCarlo(walks, 8)
    for width, height in ((16, 12), (32, 24)):
        camera = oi.Camera(
            [0.0, 0.0, 6.6],
            [0.0, 1.0, 0.15],
            [0.0, 0.0, -1.0],
            60.0,
            width,
            height,
            oi.spectrum.cie_1931(),
        )

        def draw(seed, camera=camera):
            found = oi.photograph(lit, camera, transport, key=jax.random.key(seed))
            return jax.block_until_ready(found)

        draw(0)
        start = time.process_time()
        found = draw(1)
        seconds = time.process_time() - start
        error = np.median(np.asarray(found.stderr / found.value)[..., 1])
        print(
            f"{width} x {height}: {seconds:.1f} s of CPU, {1e3 * seconds / (width * height):.2f} "
            f"ms per pixel, {walks} walks of 8 events; median stderr of luminance {error:.1%}",
            flush=True,
        )
    whole = seconds * 512 * 384 / (width * height)
    print(f"512 x 384, scaled: {whole / 60:.1f} minutes of one core")


if __name__ == "__main__":
    main()
