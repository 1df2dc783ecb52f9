"""Make up the reef of scenes/reef.toml and scenes/reef_range.toml.

    python tests/reference/regenerate_reef.py [folder]

writes into `folder` (default scenes) `reef_depth.csv`, a height field, then, as the camera of
`reef.toml` sees it, `reef_range.npz` (metres along each line of sight, to half a millimetre) and
`reef_texture.png`, reflectances in red, green and blue.  Not needed at run time.
"""

import sys
from pathlib import Path

import jax
import numpy as np
import OpenImageIO as oiio

import oceaninv as oi

SCENES = Path(__file__).parents[2] / "scenes"
SAND = 6.0  # m, depth of the sand
SPACING = 0.2  # m
X = -7.0 + SPACING * np.arange(71)
Y = 1.0 + SPACING * np.arange(71)
COLOURS = np.array(
    [[0.48, 0.26, 0.14], [0.52, 0.40, 0.16], [0.40, 0.22, 0.36], [0.28, 0.34, 0.16],
     [0.60, 0.30, 0.22]]
)  # fmt: skip


def bumps(rng: np.random.Generator) -> np.ndarray:
    """Coral heads: x, y, radius, height (m), colour, (bump, 5); small ones among large ones."""
    found = [(x, y, r, h, i % len(COLOURS)) for i, (x, y, r, h) in enumerate(
        [(-2.6, 5.6, 1.1, 1.5), (1.9, 6.6, 1.4, 2.1), (0.1, 9.0, 1.0, 1.3), (-4.6, 9.5, 1.5, 2.6),
         (4.9, 9.6, 1.3, 1.9), (3.4, 4.4, 0.6, 0.7), (-0.7, 4.1, 0.5, 0.5)]
    )]  # fmt: skip
    for i in range(46):
        x, y = rng.uniform(-6.5, 6.5), rng.uniform(2.0, 14.5)
        radius = rng.uniform(0.2, 0.6)
        found.append((x, y, radius, radius * rng.uniform(0.5, 1.4), i % len(COLOURS)))
    return np.array(found)


def rise(x, y, heads) -> tuple[np.ndarray, np.ndarray]:
    """What stands above the sand (m), and the coral head that is highest there (-1: none)."""
    wall = np.clip((y - 10.5 + 0.8 * np.sin(0.9 * x)) / 3.0, 0.0, 1.0)
    total = 3.4 * wall**2 * (3.0 - 2.0 * wall) + 0.04 * np.sin(6.0 * y + np.sin(2.0 * x))
    each = [h * np.sqrt(np.clip(1 - ((x - u) ** 2 + (y - v) ** 2) / r**2, 0, 1))
            for u, v, r, h, _ in heads]  # fmt: skip
    each = np.array(each)
    return total + each.max(axis=0), np.where(each.max(axis=0) > 0, each.argmax(axis=0), -1)


def texture(x, y, heads, rng) -> np.ndarray:
    """Reflectances in red, green and blue: sand, bare rock of the wall, corals with their grain."""
    _, head = rise(x, y, heads)
    sand = np.array([0.52, 0.46, 0.36])
    rock = np.array([0.36, 0.31, 0.24])
    wall = np.clip((y - 10.8 + 0.8 * np.sin(0.9 * x)) / 0.8, 0.0, 1.0)[..., None]
    colour = sand + wall * (rock - sand)
    own = COLOURS[heads[np.maximum(head, 0), 4].astype(int)]
    colour = np.where(head[..., None] >= 0, own, colour)
    return np.clip(colour * rng.uniform(0.8, 1.2, (*x.shape, 1)), 0.0, 1.0)


def main(folder: Path) -> None:
    """Write the three files."""
    rng = np.random.default_rng(8)
    heads = bumps(rng)
    x, y = np.meshgrid(X, Y)
    depth = SAND - rise(x, y, heads)[0]
    header = "Depth (m) of a made-up reef, row by row: y grows down the file, x along a row"
    np.savetxt(folder / "reef_depth.csv", depth, fmt="%.2f", delimiter=",", header=header)
    found = oi.load_scene(folder / "reef.toml", bands=2)
    rays = found.camera.rays()
    meet = jax.jit(jax.vmap(lambda o, d: oi.objects.nearest(found.scene.objects, o, d).distance))
    distance = np.asarray(meet(rays.origin, rays.direction))
    look, origin = np.asarray(rays.direction), np.asarray(rays.origin)
    floor = float(found.scene.floor.depth)
    down = look[:, 2] > 0
    to_floor = (floor - origin[:, 2]) / np.where(down, look[:, 2], 1.0)
    distance = np.where(down, np.minimum(distance, to_floor), distance)
    distance = np.where(np.isfinite(distance), distance, 0.0)  # 0: open water
    shape = (found.camera.height, found.camera.width)
    rounded = np.round(distance / 5e-4) * 5e-4
    np.savez_compressed(folder / "reef_range.npz", rounded.reshape(shape).astype(np.float32))
    at = origin + distance[:, None] * look
    picture = texture(at[:, 0].reshape(shape), at[:, 1].reshape(shape), heads, rng)
    picture = np.where(distance.reshape(*shape, 1) > 0, picture, 0.0)
    spec = oiio.ImageSpec(shape[1], shape[0], 3, "uint8")
    out = oiio.ImageOutput.create("x.png")
    out.open(str(folder / "reef_texture.png"), spec)
    out.write_image(picture.astype(np.float32))
    out.close()


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else SCENES)
