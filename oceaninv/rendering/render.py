"""Scenes drawn piece by piece, and pictures as files: EXR, TIFF, PNG."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from oceaninv.fidelity.planning import expected_error
from oceaninv.foundation import provenance
from oceaninv.foundation.interface_optics import Rays
from oceaninv.rendering import display
from oceaninv.rendering.image_writer import write_image
from oceaninv.scene import objects
from oceaninv.scene.scene import Scene
from oceaninv.scene.scene_file import SceneFile
from oceaninv.transport.base import AbstractTransport
from oceaninv.transport.closed_form.kd import KdTransport
from oceaninv.transport.front import check_ranges, check_rays, radiance
from oceaninv.transport.objects.range_map_radiance import ranged_radiance

_PIECE = 2**14


@dataclasses.dataclass(frozen=True)
class Picture:
    """The picture of a scene.

    `radiance`, `veil`: spectral radiance (row, column, wl) in all, and of the water alone;
    `range`: metres to the object, floor or surface, 0 where there is none; `stderr`: largest
    standard error of the radiance as a share of its mean.
    """

    radiance: np.ndarray
    veil: np.ndarray | None
    range: np.ndarray
    stderr: float


@eqx.filter_jit
def _piece(scene: Scene, rays: Rays, transport, key):
    return radiance(scene, rays, transport, key=key)


@eqx.filter_jit
def _distance(scene: Scene, rays: Rays):
    """Metres to an object, the floor or the surface, inf where there is none."""
    down = rays.direction[:, 2]
    still = down == 0
    speed = jnp.where(still, 1.0, down)
    end = jnp.where(down < 0, -rays.origin[:, 2] / speed, jnp.inf)
    if scene.floor is not None:
        end = jnp.where(down > 0, (scene.floor.depth - rays.origin[:, 2]) / speed, end)
    if scene.objects:
        hit = jax.vmap(lambda o, d: objects.nearest(scene.objects, o, d))
        end = jnp.minimum(end, hit(rays.origin, rays.direction).distance)
    return jnp.where(still & ~jnp.isfinite(end), jnp.inf, end)


def draw(
    found: SceneFile,
    transport: AbstractTransport,
    *,
    seed: int = 0,
    veil: bool = False,
    progress: Callable[[float], None] = lambda share: None,
) -> Picture:
    """Spectral radiance of every pixel.

    **Arguments:** `veil`: also the light of the water alone; `progress`: called with the share
    that is done.
    """
    scene, camera = found.scene, found.camera
    rays = camera.rays()
    check_rays(scene, rays)
    ranges, ranged = found.ranges, None
    if ranges is not None:
        check_ranges(scene, ranges)
        ranged = ranges.seen_by(camera)
    dtype = scene.light.direct.dtype
    origin, direction = np.asarray(rays.origin), np.asarray(rays.direction)
    count = origin.shape[0]
    size = min(_PIECE, count)
    random = jax.random.key(seed)
    seen, water, far, worst = [], [], [], 0.0
    starts = range(0, count, size)
    for start in starts:
        rows = np.minimum(np.arange(start, start + size), count - 1)
        lines = Rays(jnp.asarray(origin[rows], dtype), jnp.asarray(direction[rows], dtype))
        key = jax.random.fold_in(random, start)
        if ranges is None or ranged is None:
            estimate = _piece(scene, lines, transport, key)
            distance = _distance(scene, lines)
        else:
            part = jax.tree.map(lambda leaf, rows=rows: leaf[rows], ranged)
            estimate = ranged_radiance(scene, lines, part, ranges.reflectance, transport, key)
            distance = _distance(scene, lines)
            distance = jnp.where(part.met, jnp.minimum(part.distance, distance), distance)
        seen.append(np.asarray(estimate.value))
        mean = max(float(np.mean(seen[-1])), 1e-30)
        worst = max(worst, float(np.max(np.asarray(estimate.stderr))) / mean)
        far.append(np.asarray(distance))
        if veil:
            # Just short of the end of the ray, so that only the light of the water is counted.
            length = jnp.where(jnp.isfinite(distance), distance * (1 - 1e-5), 1e9)
            short = Rays(lines.origin, lines.direction, length)
            water.append(np.asarray(_piece(scene, short, transport, key).value))
        progress(min(start + size, count) / count)
    shape = (camera.height, camera.width)

    def image(pieces):
        return np.concatenate(pieces)[:count].reshape(*shape, *pieces[0].shape[1:])

    reach = image(far)
    return Picture(
        image(seen),
        image(water) if veil else None,
        np.where(np.isfinite(reach), reach, 0.0),
        worst,
    )


def channels(found: SceneFile, radiance: np.ndarray) -> np.ndarray:
    """Linear channel values (row, column, channel) of the file's camera."""
    response, wavelength = found.camera.response, found.scene.wavelength
    return radiance @ np.asarray(response.smooth_weights(wavelength, found.fine_light)).T


def to_display(
    found: SceneFile, values: np.ndarray, white_balance: str | tuple[int, int] | None = None
) -> display.Shown:
    """What `oi.show` draws of linear channel values, by the file's exposure if it states one."""
    exposure = found.sensor.exposure
    return display.shown(
        values,
        found.scene,
        found.camera,
        white_balance=white_balance,
        exposure=None if exposure is None else float(exposure),
        fine_light=found.fine_light,
        base=None if found.kd is None else KdTransport(found.kd),
    )


def _linear_srgb() -> np.ndarray:
    """From XYZ to linear sRGB (IEC 61966-2-1)."""
    return np.array(
        [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    )


def _predicted(found: SceneFile, transport) -> dict:
    """The error to expect of a picture's channels (root mean square over the mean, of the worst
    channel), and what it does not cover."""
    scene = found.scene
    things = [name for name in ("objects", "lamps") if getattr(scene, name)]
    if found.ranges is not None:
        things.append("range map")
    if scene.surface is not None and scene.surface.waves is not None:
        things.append("waves")
    bare = dataclasses.replace(scene, objects=(), lamps=())
    try:
        error = expected_error(
            bare,
            transport,
            "photograph",
            depth=float(found.camera.position[2]),
            response=found.camera.response,
        )
    except ValueError as reason:
        random = type(transport).__name__ == "MonteCarlo"
        return {"predicted_error": "random: see largest_stderr" if random else str(reason)}
    covered = "water, floor and sky" + (f", not {' and '.join(things)}" if things else "")
    return {"predicted_error": float(f"{error:.2g}"), "predicted_error_covers": covered}


def metadata(
    path: Path, found: SceneFile, transport, seed: int, picture: Picture
) -> dict[str, Any]:
    """How a picture was made."""
    inner = getattr(transport, "base", transport)
    return {
        "scene": path.name,
        "title": found.title,
        "transport": type(inner).__name__,
        **_predicted(found, inner),
        "largest_stderr": round(picture.stderr, 6),
        "seed": seed,
        "bands_nm": [round(float(w), 3) for w in found.scene.wavelength],
        "versions": {"oceaninv": provenance.version(), "jax": jax.__version__},
    }


def save(
    path: Path,
    found: SceneFile,
    picture: Picture,
    note: Mapping[str, Any],
    *,
    linear: bool,
    spectral: bool,
    seed: int = 0,
    white_balance: str | tuple[int, int] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a picture whole or not at all, by the ending of its name.

    - `.exr`: float. Channels as the camera has them (R, G, B in its own or, for the standard
      observer, in sRGB's primaries), `direct.*` (light of objects, floor and sky that arrives),
      `veil.*` (light of the water), `range` in m; or, `spectral`, the spectral radiance `S0.<nm>nm`
      with `veil` and `range`.
    - `.tif`, and `.png` when `linear`: 16 bits, linear, as the sensor reports.
    - `.png`: 8 bits, sRGB, for looking at, with this white balance; see `display.show`.  The
      metadata say under `display` how it came about.
    """
    kind = path.suffix.lower()
    if kind == ".exr":
        values, names = _exr(found, picture, spectral)
        bits = "float"
    elif kind in (".tif", ".tiff", ".png"):
        linear_values = channels(found, picture.radiance)
        if linear or kind != ".png":
            exposed = found.sensor.expose(jnp.asarray(linear_values), jax.random.key(seed))
            values, bits = np.asarray(exposed), "uint16"
        else:
            developed = to_display(found, linear_values, white_balance)
            values, bits = developed.srgb, "uint8"
            note = {**note, "display": dict(developed.facts)}
        names = ["R", "G", "B"] if values.shape[-1] == 3 else list(found.camera.response.channels)
    else:
        raise ValueError(f"cannot write {path}: name a file that ends in .exr, .tif or .png.")
    write_image(path, values, names, bits, note, overwrite=overwrite)


def _exr(found: SceneFile, picture: Picture, spectral: bool) -> tuple[np.ndarray, list[str]]:
    veil = picture.veil
    assert veil is not None
    if spectral:
        # Spectral EXR after Fichet, Pacanowski & Wilkie 2021: S0.<nanometres>,<decimals>nm.
        names = [f"S0.{w:.3f}nm".replace(".", ",").replace("S0,", "S0.", 1)
                 for w in found.scene.wavelength]  # fmt: skip
        values = [picture.radiance, veil, picture.range[..., None]]
        return np.concatenate(values, axis=-1), [*names, *(f"veil.{n}" for n in names), "range"]
    response = found.camera.response
    turn = np.eye(len(response.channels))
    letters = list(response.channels)
    if response.channels == ("X", "Y", "Z"):
        turn, letters = _linear_srgb(), ["R", "G", "B"]
    whole_light = channels(found, picture.radiance) @ turn.T
    water = channels(found, veil) @ turn.T
    values = [whole_light, whole_light - water, water, picture.range[..., None]]
    layers = [*letters, *(f"direct.{c}" for c in letters), *(f"veil.{c}" for c in letters)]
    return np.concatenate(values, axis=-1), [*layers, "range"]
