"""Linear pictures for looking at: white balance, exposure, and sRGB with its gamut."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from oceaninv.foundation import spectrum
from oceaninv.scene.camera import Camera
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import AbstractTransport, Estimate
from oceaninv.transport.closed_form.two_stream import TwoStream
from oceaninv.transport.front import irradiance
from oceaninv.transport.plane_parallel.plane_parallel import PlaneParallel
from oceaninv.water.iops import Layers

WHITE_BALANCES = ("surface", "depth", "none")
_D65 = np.array([0.95047, 1.0, 1.08883])  # XYZ of the white of sRGB, CIE 15
_BRIGHT = 0.85  # what the 99th percentile of the brightest primary becomes


@dataclasses.dataclass(frozen=True)
class Shown:
    """A picture for display.

    `srgb`: (row, column, 3), encoded, between 0 and 1.  `facts`: how it came about, by name, for
    the metadata of a file: the white balance and its white in channel values, the exposure, the
    mapping into the gamut and the share of pixels that it changed.
    """

    srgb: np.ndarray
    facts: Mapping[str, Any]


def show(
    picture: Estimate | ArrayLike,
    scene: Scene,
    camera: Camera,
    *,
    white_balance: str | tuple[int, int] | None = None,
    exposure: float | None = None,
    fine_light: tuple[np.ndarray, np.ndarray] | None = None,
    axes: Any = None,
) -> Float[np.ndarray, "row column 3"]:
    """Draws a picture that `photograph` made, and returns it as sRGB between 0 and 1.

    **Arguments:**

    - `picture`: the `Estimate` of `photograph`, or its linear values (row, column, channel).
    - `scene`, `camera`, `fine_light`: what `photograph` was given.
    - `white_balance`: what looks grey.  "surface": a grey card in the light above the surface, as
      for a camera set to daylight.  "depth": one in the light that comes down at the depth of the
      camera.  (column, row): one that is seen at this pixel, counted from 0 at the top left; the
      mean of 3 x 3 pixels counts.  "none": nothing, colours are as measured.  `None`: "depth",
      to which eyes and cameras in the water adapt; where lamps shine or that light lacks a
      channel, "surface".
    - `exposure`: factor on the XYZ that the channels become; `None`: the 99th percentile (lower of
      two ranks) of the brightest primary becomes 0.85 of the full linear value.
    - `axes`: of matplotlib; `None`: the current ones.

    White is adapted in the channels of a camera (one gain each), and for the standard observer in
    the cone responses of CAT16 (Li et al. 2017).  `spectrum.to_srgb` maps colours that sRGB cannot
    show.  Where the light above the surface lacks a channel, "surface" is "none".  Cameras of
    other than three channels show their first as grey.

    **Raises:** `ValueError` for other shapes and balances, for a pixel beyond the picture, for
    "depth" where lamps shine, and for a white that lacks a channel.
    """
    from matplotlib import pyplot

    values = picture.value if isinstance(picture, Estimate) else picture
    srgb = shown(
        np.asarray(values),
        scene,
        camera,
        white_balance=white_balance,
        exposure=exposure,
        fine_light=fine_light,
    ).srgb
    place = pyplot.gca() if axes is None else axes
    place.imshow(srgb)
    place.set_axis_off()
    return srgb


def shown(
    values: np.ndarray,
    scene: Scene,
    camera: Camera,
    *,
    white_balance: str | tuple[int, int] | None = None,
    exposure: float | None = None,
    fine_light: tuple[np.ndarray, np.ndarray] | None = None,
    base: AbstractTransport | None = None,
) -> Shown:
    """What `show` draws.  `base`: the transport of the light at depth, `TwoStream()`, or in layers
    `PlaneParallel(8, 1)`, unless given."""
    count = len(camera.response.channels)
    if values.ndim != 3 or values.shape[2] != count:
        raise ValueError(
            f"picture must have the shape (row, column, channel) with {count} channels, as the "
            f"camera has, but has {values.shape}."
        )
    if count != 3:
        grey = values[..., 0]
        factor = _exposure(grey, 1.0) if exposure is None else float(exposure)
        encoded = np.clip(grey * factor, 0, 1) ** (1 / 2.2)
        facts = {"white_balance": "none", "exposure": factor}
        return Shown(np.repeat(encoded[..., None], 3, axis=-1), facts)
    weights = np.asarray(camera.response.smooth_weights(scene.wavelength, fine_light))
    if white_balance is None:
        white_balance, white = _default_white(scene, camera, weights, base)
    else:
        white = _white(white_balance, scene, camera, values, weights, base)
    xyz = values @ balanced_matrix(camera.response, white).T
    if exposure is None:
        brightest = np.max(spectrum.linear_srgb(xyz), axis=-1)
        exposure = _exposure(brightest, _BRIGHT)
    xyz = float(exposure) * xyz
    named = white_balance if isinstance(white_balance, str) else list(white_balance)
    facts = {
        "white_balance": "none" if white is None else named,
        "white": None if white is None else [float(f"{v:.4g}") for v in white],
        "exposure": float(f"{exposure:.6g}"),
        "gamut": "sRGB; chroma reduced at constant lightness and hue in Oklab",
        "share_outside_gamut": round(float(np.mean(spectrum.outside_srgb(xyz))), 4),
    }
    return Shown(spectrum.to_srgb(xyz), facts)


def _exposure(values: np.ndarray, wanted: float) -> float:
    """Factor that brings the 99th percentile to what is wanted.

    The lower of the two ranks about it: the brightest pixel never counts.
    """
    bright = float(np.percentile(values, 99, method="lower"))
    return wanted / bright if bright > 0 else 1.0


def display_matrix(response: spectrum.Response) -> Float[np.ndarray, "3 3"]:
    """Matrix from channels to XYZ: exact for the standard observer, otherwise the best fit to the
    patches of a ColorChecker in daylight."""
    if response.channels == ("X", "Y", "Z"):
        return np.eye(3)
    grid = np.arange(400.0, 701.0, 10.0)
    names = ("dark skin", "light skin", "blue sky", "foliage", "blue flower", "bluish green",
             "orange", "purplish blue", "moderate red", "purple", "yellow green", "orange yellow",
             "blue", "green", "red", "yellow", "magenta", "cyan", "white", "neutral 5")  # fmt: skip
    light = spectrum.daylight(grid)
    patches = np.stack([light * spectrum.colour_checker(name, grid) for name in names])
    seen = patches @ np.asarray(response.weights(grid)).T
    wanted = patches @ np.asarray(spectrum.cie_1931().weights(grid)).T
    return np.linalg.lstsq(seen, wanted, rcond=None)[0].T


def balanced_matrix(
    response: spectrum.Response, white: ArrayLike | None
) -> Float[np.ndarray, "3 3"]:
    """`display_matrix`, adapted such that `white` (channel values, all positive) becomes the white
    of sRGB, as bright as it was.  `None`: not adapted."""
    matrix = display_matrix(response)
    if white is None:
        return matrix
    white = np.asarray(white, dtype=np.float64)
    bright = float(matrix[1] @ white)
    if response.channels == ("X", "Y", "Z"):
        return spectrum.adaptation(white / bright, _D65)
    return matrix * (np.linalg.solve(matrix, bright * _D65) / white)


def _default_white(
    scene: Scene, camera: Camera, weights: np.ndarray, base: AbstractTransport | None
) -> tuple[str, np.ndarray | None]:
    """The balance that is taken where none is stated, and its white."""
    if not scene.lamps:
        white = weights @ _light_at(scene, camera.position[2], base)
        if np.all(white > 0):
            return "depth", white
    white = weights @ _light_above(scene)
    return "surface", white if np.all(white > 0) else None


def _white(
    balance: str | tuple[int, int],
    scene: Scene,
    camera: Camera,
    values: np.ndarray,
    weights: np.ndarray,
    base: AbstractTransport | None,
) -> np.ndarray | None:
    """Channel values of what shall look white, up to a factor."""
    if isinstance(balance, str) and balance not in WHITE_BALANCES:
        raise ValueError(
            f"white_balance is {balance!r}; it must be one of {', '.join(WHITE_BALANCES)} or the "
            "column and row of a pixel."
        )
    if balance == "none":
        return None
    if balance == "surface":
        white = weights @ _light_above(scene)
        return white if np.all(white > 0) else None
    if balance == "depth":
        depth = float(camera.position[2])
        where = f"the light at {depth:g} m"
        if scene.lamps:
            raise ValueError(
                "white_balance is depth, which is the light of sun and sky, but lamps shine: take "
                "surface, none or the column and row of a grey card in the picture."
            )
        white = weights @ _light_at(scene, camera.position[2], base)
    else:
        column, row = balance
        height, width, _ = values.shape
        if not (0 <= column < width and 0 <= row < height):
            raise ValueError(
                f"white_balance is the pixel {column},{row}; the picture has the columns 0 to "
                f"{width - 1} and the rows 0 to {height - 1}."
            )
        where = f"the pixel {column},{row}"
        near = values[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        white = np.mean(near, axis=(0, 1))
    if not np.all(white > 0):
        lacking = camera.response.channels[int(np.argmin(white))]
        raise ValueError(
            f"white_balance: {where} has no light in the channel {lacking}, so nothing can make it "
            "white: take surface or none."
        )
    return white


def _light_above(scene: Scene) -> Float[np.ndarray, " wl"]:
    """Downward irradiance just above the surface."""
    light = scene.light
    down = light.direct * light.cosine
    return np.asarray(down if light.diffuse is None else down + jnp.pi * light.diffuse)


def _light_at(
    scene: Scene, depth: Float[Array, ""], base: AbstractTransport | None
) -> Float[np.ndarray, " wl"]:
    """Downward irradiance of sun and sky at a depth, without objects, lamps and waves."""
    surface = scene.surface
    if surface is not None and surface.waves is not None:
        surface = dataclasses.replace(surface, waves=None)
    bare = dataclasses.replace(scene, surface=surface, objects=(), lamps=())
    if base is None:
        exact = isinstance(scene.water, Layers) or scene.inelastic is not None
        base = PlaneParallel(8, 1) if exact else TwoStream()
    return np.asarray(irradiance(bare, depth[None], base).Ed.value)[0]
