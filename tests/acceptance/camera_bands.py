"""How many bands a picture needs: colour differences over 28 cameras.

    python -m tests.acceptance.camera_bands [cameras.csv]     (writes camera_bands.md beside this)

The committed table is of 28 of the 52 cameras of rawtoaces-data, in one csv; without it, of the
cameras that come with the project.

Spectra: the radiance that the two-stream model sends along 60 lines of sight of all directions in
the six waters and depths of Monzon et al. 2024, table 2 (floor, surface, sun and sky as in
scenes/three_spheres.toml).  Each camera's channels become XYZ by its matrix fitted to ColorChecker
patches in daylight and CIELAB by a white card under the surface's light; the difference is that
between n bands and 64, at one exposure, in CIEDE2000 (Sharma, Wu & Dalal 2005, through
colour-science).
"""

import csv
import dataclasses
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from oceaninv.rendering.display import display_matrix

jax.config.update("jax_enable_x64", True)

SCENE = Path(__file__).parents[2] / "scenes" / "three_spheres.toml"
WATERS = (("3C", 3.0), ("3C", 9.0), ("I", 5.0), ("IA", 9.0), ("IB", 5.0), ("II", 3.0))
COUNTS = (3, 8, 12, 16, 32)
CAMERAS = 28


def grids(count: int):
    """(kind of weights, wavelengths) of so many bands."""
    equal = oi.spectrum.bands(count, 400, 650)
    yield "linear", equal
    yield "smooth", equal
    yield "smooth, light unknown", equal
    if count in (8, 12):
        yield "smooth, camera_bands", oi.spectrum.camera_bands(count, 400, 650)


@jax.jit
def _look(scene, rays):
    return oi.radiance(scene, rays).value


def radiances(wavelength) -> list[np.ndarray]:
    """(ray, wl) in each water."""
    rng = np.random.default_rng(7)
    direction = rng.normal(size=(60, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    base = oi.load_scene(SCENE, bands=8).scene
    day = jnp.asarray(oi.spectrum.daylight(wavelength))
    sky = base.light.diffuse[0] / base.light.direct[0] * day
    light = oi.Light(base.light.zenith, day, sky)
    reflectance = jnp.full(len(wavelength), base.floor.reflectance[0])
    results = []
    for kind, depth in WATERS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            water = oi.jerlov(kind, wavelength)
        floor = oi.Floor(depth, reflectance)
        scene = dataclasses.replace(base, water=water, light=light, floor=floor, objects=())
        rays = oi.Rays([0.0, 0.0, depth - 1.5], jnp.asarray(direction))
        results.append(np.asarray(_look(scene, rays)))
    return results


def names_of(rows) -> list[str]:
    """28 of the cameras of a file, evenly through their names."""
    every = sorted({row[0] for row in rows})
    return [every[i] for i in np.linspace(0, len(every) - 1, CAMERAS).round().astype(int)]


def read_responses(rows):
    """(name, response) of every camera; columns: camera, wavelength_nm, R, G, B."""
    for name in sorted({row[0] for row in rows}):
        table = np.array([row[1:5] for row in rows if row[0] == name], dtype=float).T
        values = table[1:] / table[2].max()
        yield name, oi.spectrum.Response(values, table[0], ("R", "G", "B"))


def responses():
    """Names and responses of the measured cameras: 28 of a file's or the project's own."""
    if len(sys.argv) < 2:
        names = list(oi.spectrum.camera_names())
        return names, [oi.spectrum.camera_response(name) for name in names]
    with open(sys.argv[1], encoding="utf-8") as file:
        rows = list(csv.reader(line for line in file if not line.startswith("#")))[1:]
    names = names_of(rows)
    return names, [response for name, response in read_responses(rows) if name in names]


def run() -> str:
    """The table."""
    import colour

    names, cameras = responses()
    grid = oi.spectrum.bands(64, 400, 650)
    fine = radiances(grid)
    daylight = oi.spectrum.daylight(grid)
    lines = [
        "# How many bands a picture needs",
        "",
        f"`python -m tests.acceptance.camera_bands`: {len(names)} cameras, six",
        "waters, 400-650 nm, 60 lines of sight each; against 64 bands.  CIEDE2000, and root mean",
        "square of the channels as a share of the brightest.",
        "",
        "| bands | weights | dE median | dE 95th percentile | dE largest | rms, median camera |",
        "|---|---|---|---|---|---|",
    ]
    light = oi.spectrum.daylight_table()
    known = [(r, display_matrix(r), np.asarray(r.smooth_weights(grid, light)).T) for r in cameras]
    drawn = {n: radiances(oi.spectrum.bands(n, 400, 650)) for n in COUNTS}
    for count, kind, few_grid in [(n, *pair) for n in COUNTS for pair in grids(n)]:
        coarse = radiances(few_grid) if "camera_bands" in kind else drawn[count]
        differences, rms = [], []
        for response, matrix, exact in known:
            if kind == "linear":
                found = response.weights(few_grid)
            else:
                known_light = None if kind.endswith("unknown") else light
                found = response.smooth_weights(few_grid, known_light)
            weights = [np.asarray(found).T, exact]
            white = matrix @ (weights[1].T @ daylight) / np.pi
            for few, many in zip(coarse, fine, strict=True):
                pair = [few @ weights[0], many @ weights[1]]
                rms.append(np.sqrt(np.mean((pair[0] - pair[1]) ** 2)) / np.max(pair[1]))
                # One exposure for both: the brightest of the finer picture is as bright as white.
                scale = white[1] / np.max(pair[1] @ matrix.T[:, 1])
                spaces = [
                    colour.XYZ_to_Lab(
                        np.maximum(scale * p @ matrix.T, 0.0) / white[1],
                        colour.XYZ_to_xy(white),
                    )
                    for p in pair
                ]
                differences.append(colour.delta_E(*spaces, method="CIE 2000"))
        d = np.concatenate(differences)
        row = (np.median(d), np.percentile(d, 95), np.max(d))
        lines.append(
            f"| {count} | {kind} | "
            + " | ".join(f"{v:.2f}" for v in row)
            + f" | {np.median(rms):.4f} |"
        )
        print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(run())
