"""A photograph without its water, by a fitted water and a range map."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.core.program_cache import cached_jit
from fitting.core.result import Fit
from fitting.images.photograph_file import Photograph
from fitting.photo._band_derivatives import open_radiance
from fitting.photo.forward_model import light_up
from oceaninv.foundation.double_precision import in_double_precision
from oceaninv.foundation.figure_file import save_figure

_RANGES = 48
_TILTS = 7


@dataclasses.dataclass(frozen=True, eq=False)
class Restored:
    """A photograph with the water taken out.

    - `reflectance`: (row, column, channel) in camera channels, for a surface that faces the light
      at the camera's depth: true up to how each surface is lit; NaN without range.
    - `residual`: (row, column) how far, as a share of the pixel's value, the pixel lies outside of
      what reflectances of 0-1 can look like: negative where the fitted veil is brighter than the
      picture, positive where the surface is brighter than white; the channel that is furthest off.
    - `noise`: (row, column) what the noise was amplified by, in the worst channel.
    - `veil`: (channel,) share of the fitted veil that was taken off: 1, or less where the darkest
      pixels of the picture are darker than the fitted veil at their range.
    """

    reflectance: Float[np.ndarray, "row column 3"]
    residual: Float[np.ndarray, "row column"]
    noise: Float[np.ndarray, "row column"]
    veil: Float[np.ndarray, "3"]

    def message(self) -> str | None:
        """A message where the darkest pixels contradict the fitted veil; else None."""
        if self.veil.min() > 0.9:
            return None
        shares = ", ".join(f"{100 * share:.0f}" for share in self.veil)
        return (
            f"only {shares} % (R, G, B) of the fitted veil was subtracted: the darkest pixels "
            "are no brighter than that, so they lie in shade or the water is clearer than fitted "
            "(small charts have too little contrast because of blur and glare)"
        )

    def save(self, stem: str | Path, *, overwrite: bool = False) -> list[Path]:
        """Write STEM_restored.exr, STEM_restored.png and STEM_residual.png; returns their paths."""
        from fitting.images.chart_reading import display
        from oceaninv.rendering.image_writer import write_image

        paths = restored_paths(Path(stem))
        write = functools.partial(write_image, overwrite=overwrite)
        write(
            paths[0], self.reflectance, ["R", "G", "B"], "float", {"values": "reflectance, linear"}
        )
        # Pixels without range, or of mostly noise, are black.
        seen = np.where((self.noise < 50.0)[:, :, None], self.reflectance, 0.0)
        write(
            paths[1], display(seen), ["R", "G", "B"], "uint8", {"values": "reflectance, gamma 2.2"}
        )
        self._draw_residual(paths[2], overwrite)
        return paths

    def _draw_residual(self, path: Path, overwrite: bool) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8.0, 5.0), layout="tight")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        shown = axes.imshow(self.residual, cmap="RdBu_r", vmin=-0.3, vmax=0.3)
        axes.set_facecolor("0.8")
        figure.colorbar(shown, label="share of the value outside reflectances 0-1", shrink=0.8)
        axes.set_title(
            "blue: veil too bright for the picture; red: brighter than white", fontsize=9
        )
        save_figure(figure, path, dpi=110, overwrite=overwrite)


def restored_paths(stem: Path) -> list[Path]:
    """The files that `Restored.save` writes."""
    ends = ("_restored.exr", "_restored.png", "_residual.png")
    return [stem.with_name(stem.name + end) for end in ends]


@in_double_precision
def restore(
    fit: Fit,
    photograph: Photograph,
    distance: Any,
    *,
    photo: int = 0,
    zenith: Any = 90.0,
    dark: float = 0.01,
) -> Restored:
    """Take the fitted water out of a photograph.

    **Arguments:**

    - `fit`: of readings of this photograph (the same file and development: its gains count).
    - `distance`: (row, column) range in metres, NaN where missing (`fitting.read_range`).
    - `photo`: which of the fit's photographs it is.
    - `zenith`: direction of the lines of sight, degrees: one for the whole picture, or (row,
      column), or (row, 1).
    - `dark`: share of pixels that may be darker than what is subtracted, 0-1.  Water in front of
      shaded things is less lit than the open water of the fit, whose whole veil would leave black
      holes: each channel's veil is lowered by one factor until this share is below it.  1: never.

    Of every pixel the path radiance at its range is subtracted and the rest divided by what a
    white surface at that range would send; a colour matrix, if fitted, is undone.

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
    if not 0 <= dark <= 1:
        raise ValueError(f"dark is {dark:g}; a share between 0 and 1 wanted.")
    if problem.readings[photo].lamp:
        raise ValueError("pictures lit by a lamp are not restored; only daylight is modelled.")
    known = np.isfinite(distance) & (distance > 0)
    if not known.any():
        raise ValueError("distance holds no range.")
    ranges = np.geomspace(distance[known].min(), distance[known].max() * (1 + 1e-9), _RANGES)
    tilt = np.asarray(zenith, dtype=np.float64)
    if tilt.ndim not in (0, 2) or not np.all((tilt >= 0) & (tilt <= 180)):
        raise ValueError(
            f"zenith must be degrees between 0 and 180, one or (row, column), not {zenith!r}."
        )
    tilt = np.broadcast_to(tilt, distance.shape)
    nodes = np.linspace(tilt.min(), tilt.max(), _TILTS if np.ptp(tilt) > 0.5 else 1)
    at = np.where(known, distance, ranges[0])
    path, bright, output = np.zeros(values.shape), np.zeros(values.shape), np.eye(3)
    for node in nodes:
        veil, white, output = (
            np.asarray(part)
            for part in _along(
                problem, jnp.asarray(fit.x), jnp.asarray(ranges), photo, jnp.asarray(node)
            )
        )
        # Linear between nodes: the share of this one.
        apart = np.abs(tilt - node) / (nodes[1] - nodes[0]) if len(nodes) > 1 else np.zeros((1, 1))
        share = np.clip(1.0 - apart, 0.0, 1.0)[:, :, None]
        path += share * np.stack([np.interp(at, ranges, v) for v in veil.T], axis=-1)
        bright += share * np.stack([np.interp(at, ranges, np.log(w)) for w in white.T], axis=-1)
    camera, full = values @ np.linalg.inv(output).T, np.exp(bright)
    found = np.where(known[:, :, None], (camera - path) / full, np.nan)
    off = (found - np.clip(found, 0.0, 1.0)) * full / np.maximum(camera, 1e-12)
    # Lowered in the file's channels, in which dark pixels are dark whatever the matrix.
    seen = path @ output.T
    share = np.clip(np.nanquantile((values / seen)[known], dark, axis=0), 0.0, 1.0)
    lowered = (values - share * seen) @ np.linalg.inv(output).T
    reflectance = np.where(known[:, :, None], lowered / full, np.nan)
    worst = np.argmax(np.abs(np.nan_to_num(off)), axis=-1)[:, :, None]
    residual = np.take_along_axis(off, worst, axis=-1)[:, :, 0]
    noise = np.where(known, np.max(camera / full, axis=-1), np.inf)
    return Restored(reflectance, residual, noise, share)


@cached_jit
def _along(problem, x, ranges, photo: int, zenith):
    """(range, channel) path radiance and light of a white surface, and the output matrix."""
    values = problem.layout.values(x)
    readings = problem.readings[photo]
    lit = light_up(values, readings, problem.sunlight, photo)
    # All rays of a photograph have the azimuth of its readings.
    ahead = readings.direction
    if len(readings.middle):
        ahead = ahead[jnp.argmax(readings.middle[0])][None]
    first = ahead[0] if len(readings.blend) else readings.pixels.direction
    around = jnp.arctan2(first[1], first[0])
    tilt = jnp.radians(zenith)
    way = jnp.stack([jnp.sin(tilt) * jnp.cos(around), jnp.sin(tilt) * jnp.sin(around),
                     -jnp.cos(tilt)])  # fmt: skip
    depths = jnp.maximum(lit.depth + ranges * way[2], 0.0)
    at = jnp.concatenate([lit.depth[None], depths])
    water = open_radiance(lit.scene, at, jnp.broadcast_to(way, (len(at), 3)), problem.transport)
    # The things fill the view, see `predict_pixels`.
    whole = jnp.exp(-(lit.water.a + lit.water.bb)[None, :] * ranges[:, None])
    veil = (water[:1] - whole * water[1:]) @ lit.response.T
    down = problem.transport.irradiance(lit.scene, depths, None).Ed.value / jnp.pi
    arriving = down * whole
    return veil * lit.veil[None, :], arriving @ lit.response.T, lit.output
