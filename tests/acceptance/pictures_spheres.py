"""Pictures with objects against Monte Carlo: three spheres in the waters of Monzon et al. 2024.

    python -m tests.acceptance.pictures_spheres        (writes pictures_spheres.md beside this file)

scenes/three_spheres.toml with its balls, in Jerlov waters of Solonenko & Mobley 2015 with a
Henyey-Greenstein phase function of mean cosine 0.8, floor, balls and camera shifted to the depth
that the paper's table 2 names.  Truth: MonteCarlo, seeded.  Its noise is part of the difference;
the mean square that its standard error explains is taken off and stated.
"""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import oceaninv as oi  # noqa: E402
from tests.acceptance.pictures import (  # noqa: E402
    _SRGB,
    PHASES,
    SCENE,
    WATERS,
    encode,
    printed,
    scene,
)

WIDTH, HEIGHT = 24, 16
PATHS = {"3C": 2**12}  # turbid water needs more than the others' 2**10


def with_balls(kind: str, depth: float):
    """The scene of `pictures.scene` with the balls of the file above its floor."""
    found = oi.load_scene(SCENE).scene
    bare, camera = scene(kind, depth, PHASES["Henyey-Greenstein 0.8"]())
    shift = depth - float(found.floor.depth)
    balls = [
        oi.Sphere(ball.centre.at[2].add(shift), ball.radius, ball.reflectance)
        for ball in found.objects
    ]
    whole = dataclasses.replace(bare, objects=tuple(balls))
    return whole, bare, dataclasses.replace(camera, width=WIDTH, height=HEIGHT)


@eqx.filter_jit
def drawn(scene, rays, transport, key):
    return oi.radiance(scene, rays, transport, key=key)


def run() -> str:
    """The table."""
    lines = [
        "# Pictures with objects against Monte Carlo",
        "",
        f"`python -m tests.acceptance.pictures_spheres`: {WIDTH} x {HEIGHT} pixels, 1024 paths",
        "each (type 3C: 4096); root mean square error of sRGB in [0, 1] at the exposure of the",
        "truth, whose noise is taken off in the mean square.  The printed formula knows no balls:",
        "where they are seen it is left out.",
        "",
        "| water, floor | two-stream | four-stream | printed, off the balls | noise taken off |",
        "|---|---|---|---|---|",
    ]
    columns = []
    models = (oi.WithObjects(oi.TwoStream()), oi.WithObjects(oi.FourStream()))
    for kind, depth in reversed(WATERS):
        whole, bare, camera = with_balls(kind, depth)
        rays = camera.rays()
        weights = np.asarray(camera.response.weights(whole.wavelength)).T
        exact = drawn(whole, rays, oi.MonteCarlo(PATHS.get(kind, 2**10)), jax.random.key(1))
        truth = np.asarray(exact.value) @ weights
        exposure = 0.85 / np.percentile(np.max(truth @ _SRGB.T, axis=1), 99)
        target = encode(truth, exposure)
        # What one standard error does to the picture, bands in step.
        shaken = encode((np.asarray(exact.value + exact.stderr)) @ weights, exposure)
        noise = np.mean((shaken - target) ** 2)
        meet = jax.vmap(lambda o, d, s=whole: oi.objects.nearest(s.objects, o, d).distance)
        off = np.isinf(np.asarray(meet(rays.origin, rays.direction)))
        row = []
        for value, part in (
            *((drawn(whole, rays, m, None).value, slice(None)) for m in models),
            (printed(bare, rays), off),
        ):
            error = encode(np.asarray(value) @ weights, exposure) - target
            row.append(np.sqrt(max(np.mean(error[part] ** 2) - noise, 0.0)))
        row.append(np.sqrt(noise))
        columns.append(row)
        lines.append(f"| {kind}, {depth:g} m | " + " | ".join(f"{v:.3f}" for v in row) + " |")
        print(lines[-1], flush=True)
    mean = np.mean(columns, axis=0)
    lines.append("| mean | " + " | ".join(f"{v:.4f}" for v in mean) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(run())
