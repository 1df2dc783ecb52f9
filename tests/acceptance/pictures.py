"""How far pictures are from the truth: the six waters and depths of Monzon et al. 2024, table 2.

    python -m tests.acceptance.pictures            (writes pictures.md beside this file)

The scene is scenes/three_spheres.toml without its balls: camera, sand floor, surface, sun and sky,
in Jerlov waters of Solonenko & Mobley 2015 as the paper, and of Williamson & Hollins 2022 where
they have the type, with the floor at the depth that the paper's table names, drawn with the
colour-matching functions and turned into sRGB at one exposure, the truth's (its 99th percentile at
0.85).  Truth: discrete ordinates, 16 streams per hemisphere.  The printed formula gets what the
paper gives it: its closure (eq 9) for multiple and the true phase function for single scattering,
Kd by Lee et al. 2005, the floor's radiance, and the sky through the surface.
"""

import dataclasses
import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from skimage.metrics import mean_squared_error

import oceaninv as oi
from oceaninv.transport.closed_form.kd import monzon2024
from oceaninv.water.bio_optics import jerlov_types

jax.config.update("jax_enable_x64", True)

SCENE = Path(__file__).parents[2] / "scenes" / "three_spheres.toml"
WATERS = (("3C", 3.0), ("3C", 9.0), ("I", 5.0), ("IA", 9.0), ("IB", 5.0), ("II", 3.0))
WIDTH, HEIGHT = 24, 16
OTHER = "WilliamsonHollins2022"
PHASES = {
    "Henyey-Greenstein 0.8": lambda: oi.phase.HenyeyGreenstein(0.8),
    "Petzold": oi.phase.petzold,
}
_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])


def scene(kind: str, depth: float, phase, source: str = "SolonenkoMobley2015"):
    """The scene over a floor at `depth`, the camera 1.5 m above it."""
    found = oi.load_scene(SCENE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        water = oi.jerlov(kind, found.scene.wavelength, source, phase)
    floor = oi.Floor(depth, found.scene.floor.reflectance)
    camera = dataclasses.replace(
        found.camera,
        position=found.camera.position.at[2].set(depth - 1.5),
        width=WIDTH,
        height=HEIGHT,
    )
    return dataclasses.replace(found.scene, water=water, floor=floor, objects=()), camera


@eqx.filter_jit
def seen(scene, rays, transport):
    return oi.radiance(scene, rays, transport).value


@eqx.filter_jit
def printed(scene, rays):
    """Eqs 4-11 of the paper as they stand."""
    water = scene.water
    mu0, beam = scene.beam()
    kd = oi.attenuation.kd_lee2005(water.a, water.bb, scene.light.zenith)
    surface = mu0 * beam + np.pi * scene.light.diffuse
    z, down = rays.origin[:, 2], rays.direction[:, 2]
    steep = jnp.where(jnp.abs(down) < 1e-3, 1e-3, down)
    bottom, rho = scene.floor.depth, scene.floor.reflectance
    length = jnp.where(steep > 0, (bottom - z) / steep, -z / steep)
    multiple = monzon2024(water.b, water.c, kd, surface, z, down, length, rho, bottom)
    # Single scattering with the true phase function, along the refracted sun.
    half = oi.optics.scattering_half_sine(rays.direction, mu0)
    beta = water.volume_scattering(1.0 - 2.0 * half**2)
    c = water.c[None, :]
    start = z[:, None] * c / mu0
    stop = start + c * (length * (1 + down / mu0))[:, None]
    from oceaninv.foundation.numerics import exp_mean

    single = beta * beam[None, :] * length[:, None] * exp_mean(start, stop)
    through = jnp.exp(-c * length[:, None])
    floor = (rho / np.pi * surface * jnp.exp(-kd * bottom))[None, :] * through
    index = scene.surface.index
    reflectance = oi.optics.fresnel_from_water(jnp.abs(steep), index)[:, None]
    mirrored = monzon2024(
        water.b, water.c, kd, surface, 0 * z, jnp.abs(steep), bottom / jnp.abs(steep), rho, bottom
    )
    above = (1 - reflectance) * scene.light.diffuse[None, :] + reflectance * mirrored
    return multiple + single + jnp.where((down > 0)[:, None], floor, above * through)


def encode(linear, exposure):
    """sRGB in [0, 1]."""
    rgb = np.clip(exposure * linear @ _SRGB.T, 0.0, 1.0)
    return np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)


def run() -> str:
    """The table."""
    models = {"TwoStream": oi.TwoStream(), "FourStream": oi.FourStream()}
    lines = [
        "# Pictures against the truth",
        "",
        "`python -m tests.acceptance.pictures`: root mean square error of sRGB in [0, 1] at the",
        f"truth's exposure, {WIDTH} x {HEIGHT} pixels, 8 bands, floor and surface, no objects;",
        "truth: PlaneParallel(streams=16).  The paper's own numbers for its scene are 0.059,",
        "0.041, 0.117, 0.107, 0.107, 0.107 (mean 0.090) against a path tracer.",
    ]
    known = [w for w in WATERS if w[0] in jerlov_types(OTHER)]
    tables = [(name, make, "SolonenkoMobley2015", WATERS) for name, make in PHASES.items()]
    tables.append((f"Petzold, {OTHER}", PHASES["Petzold"], OTHER, known))
    for name, make, source, waters in tables:
        lines += [
            "",
            f"## {name}",
            "",
            "| water, floor | printed formula | TwoStream | FourStream |",
        ]
        lines += ["|---|---|---|---|"]
        columns = []
        for kind, depth in waters:
            one, camera = scene(kind, depth, make(), source)
            rays = camera.rays()
            weights = np.asarray(camera.response.weights(one.wavelength)).T
            truth = np.asarray(seen(one, rays, oi.PlaneParallel(streams=16))) @ weights
            exposure = 0.85 / np.percentile(np.max(truth @ _SRGB.T, axis=1), 99)
            results = [printed(one, rays), *(seen(one, rays, m) for m in models.values())]
            target = encode(truth, exposure)
            rms = [
                mean_squared_error(target, encode(np.asarray(r) @ weights, exposure)) ** 0.5
                for r in results
            ]
            columns.append(rms)
            lines.append(f"| {kind}, {depth:g} m | " + " | ".join(f"{v:.3f}" for v in rms) + " |")
            print(lines[-1], flush=True)
        mean = np.mean(columns, axis=0)
        lines.append("| mean | " + " | ".join(f"{v:.4f}" for v in mean) + " |")
        share = mean[1] / mean[0]
        lines.append(f"\nTwoStream's mean is {100 * share:.0f} % of the printed formula's.")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    begin = time.time()
    table = run()
    Path(__file__).with_suffix(".md").write_text(table)
    print(table, f"{time.time() - begin:.0f} s")
