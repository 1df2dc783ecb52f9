"""What surrounds the patches of a chart: mean reflectance of rings about each of them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.observations.photo import WAVELENGTH, Board, Chart

RINGS = 10
# A board of unknown size: side (m), standard deviation of its ln, and share of the side that a
# patch fills.
_SIDE, SIDE_SD, _PATCH = 0.2, 0.5, 0.2
# Points of a ring at which the board is looked up: radii and azimuths.
_RADII, _AZIMUTHS = 8, 64


class Surroundings(NamedTuple):
    """Rings about the readings of a chart, the innermost a disc within the patch.

    - `radius`: (ring,) m, outer radii; the last reaches the board's farthest corner.
    - `reflectance`: (patch, ring, wl) means, 0 off the board.
    - `cover`: (patch, ring) shares of the rings that lie on the board.
    - `place`: (patch, 2) m across and down from the board's middle.
    """

    radius: Float[np.ndarray, " ring"]
    reflectance: Float[np.ndarray, "patch ring wl"]
    cover: Float[np.ndarray, "patch ring"]
    place: Float[np.ndarray, "patch 2"]


def spectra_of(reflectance: np.ndarray) -> Float[np.ndarray, "patch wl"]:
    """Reflectances at the wavelengths of a photograph; of neutral ones, the same at each."""
    if reflectance.ndim == 1:
        return np.broadcast_to(reflectance[:, None], (len(reflectance), len(WAVELENGTH)))
    return reflectance


def surroundings_of(chart: Chart) -> Surroundings:
    """The rings of a chart's readings."""
    own = spectra_of(chart.reflectance)
    if chart.board is None:
        return _unknown(own)
    if chart.place is None:
        return _plain(own, chart.board)
    board, rows = chart.board, chart.board.patches[chart.place]
    middle = rows[:, :2]
    inner = rows[:, 2:].min()
    corner = np.hypot(*(np.abs(middle).max(axis=0) + np.array([board.width, board.height]) / 2))
    radius = np.geomspace(inner, corner, RINGS)
    at = _points(radius)
    where = middle[:, None, None, :] + at
    spectra = np.concatenate(
        [
            np.zeros((1, len(WAVELENGTH))),
            np.full((1, len(WAVELENGTH)), board.ground),
            spectra_of(board.reflectance),
        ]
    )
    # 0 off the board, 1 on it, 2 and more on a patch.
    part = np.all(np.abs(where) <= np.array([board.width, board.height]) / 2, axis=-1).astype(int)
    for i, (x, y, half_width, half_height) in enumerate(board.patches):
        away = np.abs(where - np.array([x, y]))
        part[(away[..., 0] <= half_width) & (away[..., 1] <= half_height)] = i + 2
    reflectance = spectra[part].mean(axis=2)
    # The reading's own spectrum, not the board's entry, is what the innermost disc shows.
    reflectance[:, 0] = own
    cover = (part > 0).mean(axis=2)
    cover[:, 0] = 1.0
    return Surroundings(radius, reflectance, cover, middle)


def _points(radius: np.ndarray) -> Float[np.ndarray, "ring point 2"]:
    """Points of every ring, evenly in radius and azimuth.

    Scattered light falls off about as the inverse of the distance from the line of sight, so that
    an even spread in radius, not in area, counts it as it arrives.
    """
    edges = np.concatenate([[0.0], radius])
    share = (np.arange(_RADII) + 0.5) / _RADII
    radii = edges[:-1, None] + share * np.diff(edges)[:, None]
    azimuth = 2 * np.pi * (np.arange(_AZIMUTHS) + 0.5) / _AZIMUTHS
    way = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    return (radii[:, :, None, None] * way).reshape(len(radius), -1, 2)


def _plain(own: np.ndarray, board: Board) -> Surroundings:
    """A board whose patches are not laid out: all in its middle, around them their mean."""
    half = np.array([board.width, board.height]) / 2
    radius = np.geomspace(_PATCH * half.min(), np.hypot(*half), RINGS)
    at = _points(radius)
    cover = np.all(np.abs(at) <= half, axis=-1).mean(axis=1)
    mean = own.mean(axis=0)
    reflectance = np.broadcast_to(cover[:, None] * mean, (len(own), RINGS, own.shape[1])).copy()
    reflectance[:, 0] = own
    covers = np.broadcast_to(cover, (len(own), RINGS))
    return Surroundings(radius, reflectance, covers, np.zeros((len(own), 2)))


def _unknown(own: np.ndarray) -> Surroundings:
    return _plain(own, Board(_SIDE, _SIDE, SIDE_SD))
