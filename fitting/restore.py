"""A photograph without its water, by a fitted water and a range map."""

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import oceaninv as oi
from fitting._photo_model import light_up
from fitting.photographs import Photograph
from fitting.posterior import Fit

_RANGES = 48


@dataclasses.dataclass(frozen=True, eq=False)
class Restored:
    """A photograph with the water taken out.

    - `reflectance`: (row, column, channel) in camera channels, for a surface that faces the light
      at the camera's depth: true up to how each surface is lit; NaN without range.
    - `residual`: (row, column) how far, as a share of the pixel's value, the pixel lies outside of
      what reflectances of 0-1 can look like: negative where the fitted veil is brighter than the
      picture, positive where the surface is brighter than white; the channel that is furthest off.
    - `noise`: (row, column) what the noise was amplified by, in the worst channel.
    """

    reflectance: Float[np.ndarray, "row column 3"]
    residual: Float[np.ndarray, "row column"]
    noise: Float[np.ndarray, "row column"]

    def save(self, stem: str | Path) -> list[Path]:
        """Write STEM_restored.exr, STEM_restored.png and STEM_residual.png; returns their paths."""
        from fitting.charts import display
        from fitting.render import write_image

        stem = Path(stem)
        paths = [
            stem.with_name(stem.name + end)
            for end in ("_restored.exr", "_restored.png", "_residual.png")
        ]
        write_image(paths[0], self.reflectance, ["R", "G", "B"], "float", "reflectance, linear")
        # What has no range or is mostly noise would only dazzle.
        seen = np.where((self.noise < 50.0)[:, :, None], self.reflectance, 0.0)
        write_image(paths[1], display(seen), ["R", "G", "B"], "uint8", "reflectance, gamma 2.2")
        self._draw_residual(paths[2])
        return paths

    def _draw_residual(self, path: Path) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        from fitting.report import whole

        figure = Figure(figsize=(8.0, 5.0), layout="tight")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        shown = axes.imshow(self.residual, cmap="RdBu_r", vmin=-0.3, vmax=0.3)
        axes.set_facecolor("0.8")
        figure.colorbar(shown, label="share of the value outside reflectances 0-1", shrink=0.8)
        axes.set_title(
            "blue: veil too bright for the picture; red: brighter than white", fontsize=9
        )
        with whole(path) as temporary:
            figure.savefig(temporary, dpi=110)


def restore(
    fit: Fit, photograph: Photograph, distance: Any, *, photo: int = 0, zenith: float = 90.0
) -> Restored:
    """Take the fitted water out of a photograph.

    **Arguments:**

    - `fit`: of readings of this photograph (the same file and development: its gains count).
    - `distance`: (row, column) range in metres, NaN where missing (`fitting.read_range`).
    - `photo`: which of the fit's photographs it is.
    - `zenith`: direction of the lines of sight, degrees: one for the whole picture.

    Of every pixel the path radiance at its range is subtracted and the rest divided by what a
    white surface at that range would send; a colour matrix, if fitted, is undone before.

    Raises ValueError when the fit keeps no problem or the shapes differ.
    """
    values, problem = photograph.values, fit.problem
    distance = np.asarray(distance, dtype=np.float64)
    if problem is None or not hasattr(problem, "readings"):
        raise ValueError("only fits of photographs can restore one.")
    if distance.shape != values.shape[:2]:
        raise ValueError(
            f"distance has shape {distance.shape}, the photograph {values.shape[:2]}: read it with "
            "fitting.read_range, which fits it to the picture."
        )
    if not 0 <= photo < len(problem.readings):
        raise ValueError(f"photo is {photo}; the fit has {len(problem.readings)}.")
    known = np.isfinite(distance) & (distance > 0)
    if not known.any():
        raise ValueError("distance holds no range.")
    ranges = np.geomspace(distance[known].min(), distance[known].max() * (1 + 1e-9), _RANGES)
    veil, white, output = (
        np.asarray(part)
        for part in _along(problem, jnp.asarray(fit.x), jnp.asarray(ranges), photo, zenith)
    )
    camera = values @ np.linalg.inv(output).T
    at = np.where(known, distance, ranges[0])
    path = np.stack([np.interp(at, ranges, veil[:, c]) for c in range(3)], axis=-1)
    full = np.exp(np.stack([np.interp(at, ranges, np.log(white[:, c])) for c in range(3)], axis=-1))
    found = np.where(known[:, :, None], (camera - path) / full, np.nan)
    off = (found - np.clip(found, 0.0, 1.0)) * full / np.maximum(camera, 1e-12)
    worst = np.argmax(np.abs(np.nan_to_num(off)), axis=-1)[:, :, None]
    residual = np.take_along_axis(off, worst, axis=-1)[:, :, 0]
    noise = np.where(known, np.max(camera / full, axis=-1), np.inf)
    return Restored(found, residual, noise)


@eqx.filter_jit
def _along(problem, x, ranges, photo: int, zenith: float):
    """(range, channel) path radiance and light of a white surface, and the output matrix."""
    values = problem.layout.values(x)
    readings = problem.readings[photo]
    lit = light_up(values, readings, problem.sunlight, photo)
    # Of all rays of a photograph the azimuth is that of its readings.
    first = readings.direction[0] if len(readings.ray) else readings.pixels.direction
    around = jnp.arctan2(first[1], first[0])
    tilt = np.radians(zenith)
    way = jnp.stack([jnp.sin(tilt) * jnp.cos(around), jnp.sin(tilt) * jnp.sin(around),
                     jnp.asarray(-np.cos(tilt), x.dtype)])  # fmt: skip
    zero = jnp.zeros((), x.dtype)
    rays = oi.Rays(
        jnp.stack([zero, zero, lit.depth]), jnp.broadcast_to(way, (len(ranges), 3)), ranges
    )
    veil = problem.transport.radiance(lit.scene, rays, None).value @ lit.response.T
    depths = jnp.maximum(lit.depth + ranges * way[2], 0.0)
    down = problem.transport.irradiance(lit.scene, depths, None).Ed.value / jnp.pi
    arriving = down * jnp.exp(-lit.water.c[None, :] * ranges[:, None])
    return veil * lit.veil[None, :], arriving @ lit.response.T, lit.output
