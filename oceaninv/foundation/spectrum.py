"""From spectra to channels: bands, camera responses, the standard observer, daylight."""

import functools
import re
from typing import Any

import jax.numpy as jnp
import numpy as np
from equinox import Module, field
from jax.typing import ArrayLike as JaxArrayLike
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from oceaninv.foundation import tables
from oceaninv.foundation.numerics import gauss_legendre, linear_interpolation_matrix

_RGB = ("R", "G", "B")


def bands(
    n: int, start: float | int = 400.0, stop: float | int = 700.0
) -> Float[np.ndarray, " wl"]:
    """Centres (nm) of `n` equal bands that fill `start` to `stop`; `band_edges` gives their edges.

    8, 16 and 32 bands over 400-700 nm leave at most 2.6, 1.0 and 0.2 % of the brightest channel of
    a camera as error, in daylight after 0 to 20 m of clear to green water against 1 nm
    (`test_error_of_few_bands_against_one_nanometre`).

    >>> bands(3)
    array([450., 550., 650.])
    >>> band_edges(bands(3))
    array([400., 500., 600., 700.])
    """
    if n < 2:
        raise ValueError(f"n must be at least 2 bands, but is {n}.")
    if not 0 < start < stop:
        raise ValueError(f"bands need 0 < start < stop in nm, but came {start:g} and {stop:g}.")
    return start + (stop - start) * (np.arange(n) + 0.5) / n


# Found by `tests/acceptance/band_nodes.py`.
_CAMERA_BANDS = {
    (8, 400.0, 650.0): "419.9 459.7 481.9 511.8 544.2 577.8 596.4 632.1",
    (12, 400.0, 650.0): "412.2 436.5 452.8 472.0 494.2 511.9 535.0 559.1 577.4 597.0 621.7 640.6",
    (8, 400.0, 700.0): "417.0 450.9 487.1 522.6 563.5 608.1 633.9 678.0",
    (12, 400.0, 700.0): "415.4 446.3 468.7 495.2 515.0 535.8 563.1 585.8 608.7 639.2 646.6 682.2",
}


def camera_bands(
    n: int, start: float | int = 400.0, stop: float | int = 700.0
) -> Float[np.ndarray, " wl"]:
    """Wavelengths (nm) of `n` unequal bands from which `Response.smooth_weights` serves cameras
    better than from equal ones: 8 of them do what 12 equal ones do.

    They lie where daylight under water changes fast and cameras see it: least error in colour over
    24 cameras in clear to green water, and half as much or less over 28 others
    (`tests/acceptance/camera_bands.md`). Their `band_edges` fill `start` to `stop`.

    **Raises:** `ValueError` unless `n` is 8 or 12 and the range 400 to 650 or 400 to 700 nm.
    """
    try:
        nodes = _CAMERA_BANDS[n, float(start), float(stop)]
    except KeyError:
        known = "; ".join(f"{k} on {a:g}-{b:g} nm" for k, a, b in _CAMERA_BANDS)
        raise ValueError(
            f"camera bands are known for {known}, not for {n} on {start:g}-{stop:g} nm: "
            "take equal bands."
        ) from None
    return np.array(nodes.split(), dtype=float)


def band_edges(wavelength: tables.Wavelengths) -> Float[np.ndarray, " edge"]:
    """Edges (nm) of the bands around `wavelength`: the midpoints, and half a band at each end.

    **Raises:** `ValueError` for fewer than two wavelengths, as one band has no width, and for
    what `tables.check_wavelength` refuses.
    """
    wavelength = tables.check_wavelength(wavelength)
    if wavelength.size < 2:
        raise ValueError("wavelength must hold at least two bands: one alone has no width.")
    half = np.diff(wavelength) / 2
    return np.concatenate(
        [[wavelength[0] - half[0]], wavelength[:-1] + half, [wavelength[-1] + half[-1]]]
    )


class Response(Module):
    """Spectral response of the channels of a sensor, linear between its samples, 0 beyond them.

    **Arguments:**

    - `values`: response to spectral radiance per nm, (channel, sample); may be traced.
    - `samples`: wavelengths of the samples, nm, concrete.
    - `channels`: their names.

    **Raises:** `ValueError` when the three do not fit together.
    """

    values: Float[Array, "channel sample"]
    samples: tuple[float, ...] = field(static=True)
    channels: tuple[str, ...] = field(static=True)

    def __init__(
        self, values: JaxArrayLike, samples: tables.Wavelengths, channels: tuple[str, ...]
    ):
        grid = tables.check_wavelength(samples)
        values = jnp.asarray(values)
        if values.shape != (len(channels), grid.size) or grid.size < 2:
            raise ValueError(
                f"values must have shape (channel, sample) = ({len(channels)}, {grid.size}), with"
                f" two samples or more, but came with {values.shape}."
            )
        if not jnp.issubdtype(values.dtype, jnp.floating):
            raise ValueError(f"values must be real floating numbers, but came as {values.dtype}.")
        self.values = values
        self.samples = tuple(grid.tolist())
        self.channels = tuple(channels)

    def weights(self, wavelength: tables.Wavelengths) -> Float[Array, "channel wl"]:
        """Weights with `channels = weights @ L`, in nm times the unit of the response.

        The integral of response times L is exact for an L that is linear between the band
        wavelengths (nm, concrete) and constant from the first and last to their outer band
        edges. What the response sees beyond these is left out: see `outside`.
        """
        grid = tables.check_wavelength(wavelength)
        overlap = hat_overlap(self.samples, tuple(grid.tolist()))
        return _product(self.values, overlap)

    def smooth_weights(
        self, wavelength: tables.Wavelengths, light: tuple[ArrayLike, ArrayLike] | None = None
    ) -> Float[Array, "channel wl"]:
        """Weights like `weights`, for an L that is smooth in units of a light of fine structure.

        L over the light is taken as the natural cubic spline through the bands, linear beyond the
        first and last; the integral runs in steps of 0.5 nm to the outer band edges.  With 8 bands
        of a picture in daylight this halves the error in colour
        (`tests/acceptance/camera_bands.md`).
        Weights may be negative: noise in single bands is not averaged down as by `weights`.

        **Arguments:** `light`: (wavelengths in nm, values), linear in between; `None` is flat.
        """
        bands = tables.check_wavelength(wavelength)
        edges = band_edges(bands)
        samples = np.array(self.samples)
        low, high = max(edges[0], samples[0]), min(edges[-1], samples[-1])
        if high <= low:
            return _product(self.values, np.zeros((samples.size, bands.size)))
        count = int(np.ceil((high - low) / 0.5))
        step = (high - low) / count
        at = low + step * (np.arange(count) + 0.5)
        basis = spline_basis(bands, at)
        if light is not None:
            fine, values = (np.asarray(v, dtype=float) for v in light)
            at_bands = np.interp(bands, fine, values)
            if np.any(at_bands <= 0):
                raise ValueError("light must be positive at every band.")
            basis = np.interp(at, fine, values)[:, None] * basis / at_bands
        response = linear_interpolation_matrix(at, samples)
        return _product(self.values, step * response.T @ basis)

    def outside(self, wavelength: tables.Wavelengths) -> Float[Array, " channel"]:
        """Share of the integral of each channel's response that lies beyond the outer band edges.

        0 when the bands hold all of it, and for a channel that sees nothing.
        """
        grid = np.array(self.samples)
        whole = np.asarray(np.trapezoid(np.eye(grid.size), grid, axis=1))
        total = _product(self.values, whole)
        inside = jnp.sum(self.weights(wavelength), axis=1)
        seen = total != 0
        return jnp.where(seen, 1 - inside / jnp.where(seen, total, 1.0), 0.0)


def spline_basis(
    nodes: Float[np.ndarray, " wl"], at: Float[np.ndarray, " at"]
) -> Float[np.ndarray, "at wl"]:
    """Matrix from values at `nodes` (increasing) to their natural cubic spline at `at`, which runs
    straight on beyond the first and last node."""
    from scipy.interpolate import CubicSpline

    # A natural spline ends without curvature.
    spline = CubicSpline(nodes, np.eye(nodes.size), bc_type="natural")
    inner = np.clip(at, nodes[0], nodes[-1])
    return spline(inner) + (at - inner)[:, None] * spline(inner, 1)


def _product(values: Array, matrix: np.ndarray) -> Array:
    # Full precision: some accelerators would otherwise keep three digits.
    return jnp.matmul(values, jnp.asarray(matrix, values.dtype), precision="highest")


@functools.lru_cache(maxsize=256)
def hat_overlap(response_nm: tuple[float, ...], bands_nm: tuple[float, ...]) -> np.ndarray:
    """Integrals of each sample's hat function times each band's, (sample, wl), nm.  The array is
    cached: do not write to it."""
    samples, wavelength = np.array(response_nm), np.array(bands_nm)
    edges = band_edges(wavelength)
    knots = np.unique(np.concatenate([samples, wavelength, edges[[0, -1]]]))
    low, high = max(samples[0], edges[0]), min(samples[-1], edges[-1])
    knots = knots[(knots >= low) & (knots <= high)]
    if knots.size < 2:
        return np.zeros((samples.size, wavelength.size))
    # Between knots the integrand is a quadratic, for which two Gauss points are exact.
    node, weight = gauss_legendre(2, 0.0, 1.0)
    width = np.diff(knots)
    at = (knots[:-1, None] + width[:, None] * node).ravel()
    share = (width[:, None] * weight).ravel()
    response = linear_interpolation_matrix(at, samples)
    inside = np.clip(at, wavelength[0], wavelength[-1])
    radiance = linear_interpolation_matrix(inside, wavelength)
    return response.T @ (share[:, None] * radiance)


def camera_names() -> tuple[str, ...]:
    """The names of the cameras that `camera_response` accepts."""
    columns = tables.load("cameras").columns
    return tuple(sorted({column.rsplit(" ", 1)[0] for column in columns}))


def camera_response(name: str) -> Response:
    """Measured relative response (R, G, B) of a camera, 380-780 nm by 5 nm, green maximum 1.

    Of ARRI D21 and Nikon D5100, each channel was published scaled to 1: the balance between their
    channels is unknown.

    **Arguments:** `name`: one of `camera_names()`, in large or small letters.

    **Raises:** `ValueError` with the near names when the camera is not among `camera_names()`.

    Source: rawtoaces-data (Academy Software Foundation, A.M.P.A.S.), Apache License 2.0.

    >>> camera_response("Nikon D850").channels
    ('R', 'G', 'B')
    """
    by_letters = {known.lower(): known for known in camera_names()}
    known = by_letters.get(" ".join(name.split()).lower())
    if known is None:
        raise tables.unknown("Camera", name, camera_names())
    table = tables.load("cameras")
    return Response(_channels(table, known), table.wavelength, _RGB)


def generic_camera(coefficients: Float[Array, "3"] | None = None) -> Response:
    """Mean camera, or one that departs from it along the three principal components.

    **Arguments:** `coefficients`: scores in units of their standard deviation over 50 cameras
    (so that -2 to 2 is the usual range); may be traced. None: the mean.

    The three hold 73 % of the variance between cameras. The response can turn slightly negative
    where the mean is near 0.

    Source: own analysis of rawtoaces-data, see the header of the table `generic_camera`.
    """
    table = tables.load("generic_camera")
    mean = jnp.asarray(_channels(table, "mean"))
    if coefficients is None:
        return Response(mean, table.wavelength, _RGB)
    parts = np.stack([_channels(table, f"component{k}") for k in (1, 2, 3)])
    steps = _product(coefficients, parts.reshape(3, -1)).reshape(mean.shape)
    return Response(mean.astype(coefficients.dtype) + steps, table.wavelength, _RGB)


def _channels(table: tables.Table, name: str) -> np.ndarray:
    return np.stack([table.columns[f"{name} {channel}"] for channel in _RGB])


def _colour() -> Any:
    """colour-science, loaded at first use, without its change of numpy's print options."""
    with np.printoptions():
        import colour
    return colour


def cie_1931() -> Response:
    """Colour-matching functions X, Y, Z of the CIE 1931 2 degree observer, 360-830 nm by 1 nm.

    Source: CIE 018:2019, through colour-science.
    """
    observer = _colour().MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    return Response(np.asarray(observer.values).T, observer.wavelengths, ("X", "Y", "Z"))


def daylight(wavelength: tables.Wavelengths) -> Float[np.ndarray, " wl"]:
    """CIE standard illuminant D65: relative spectral irradiance, 1 at 560 nm.

    **Arguments:** `wavelength`: nm, concrete, 300 to 780. Linear between the tabulated 5 nm.

    **Raises:** `ValueError` outside that range.

    Source: CIE 015:2018, through colour-science.

    >>> daylight([560.0])
    array([1.])
    """
    wavelength = tables.check_wavelength(wavelength)
    grid, values = daylight_table()
    low, high = grid[0], grid[-1]
    if wavelength[0] < low or wavelength[-1] > high:
        raise ValueError(
            f"Daylight covers {low:g}-{high:g} nm, but the wavelengths run from"
            f" {wavelength[0]:g} to {wavelength[-1]:g} nm."
        )
    return np.interp(wavelength, grid, values)


def daylight_table() -> tuple[Float[np.ndarray, " wl"], Float[np.ndarray, " wl"]]:
    """Wavelengths (nm, by 5) and values of `daylight` as tabulated."""
    table = _colour().SDS_ILLUMINANTS["D65"]
    return np.asarray(table.wavelengths), np.asarray(table.values) / 100.0


def to_srgb(xyz: ArrayLike) -> Float[np.ndarray, "*image 3"]:
    """sRGB for display, encoded, between 0 and 1: XYZ (..., 3) with Y = 1 for white.

    A colour beyond the gamut of sRGB keeps its lightness and hue in Oklab; its chroma is reduced
    to the largest that sRGB can show (found to 1e-6 of itself). What is lighter than white becomes
    white, and what is darker than black becomes black. Colours within the gamut do not change.

    The white of sRGB is D65, so nothing is adapted. Concrete numbers only; not differentiable.

    Source: IEC 61966-2-1:1999 and Ottosson 2020 (Oklab), through colour-science; the mapping is
    that of chroma in CSS Color 4, section 13.2, without its steps that clip.

    >>> to_srgb([0.2, 0.4, 0.6]).round(2)  # clipped, its red would be 0
    array([0.  , 0.73, 0.71])
    """
    colour, linear = _colour(), linear_srgb(xyz)
    beyond = _beyond(linear)
    if np.any(beyond):
        xyz = np.asarray(xyz, dtype=np.float64)
        linear[beyond] = _less_chroma(xyz[beyond])
    return np.clip(colour.models.eotf_inverse_sRGB(np.clip(linear, 0.0, 1.0)), 0.0, 1.0)


def outside_srgb(xyz: ArrayLike) -> np.ndarray:
    """Which colours, XYZ (..., 3) with Y = 1 for white, sRGB cannot show.

    >>> outside_srgb([[0.4, 0.4, 0.4], [0.2, 0.4, 0.6]])
    array([False,  True])
    """
    return _beyond(linear_srgb(xyz))


def adaptation(white: ArrayLike, wanted: ArrayLike) -> Float[np.ndarray, "3 3"]:
    """Matrix that turns XYZ seen under one white into XYZ under another, by cone responses.

    Source: CAT16 of Li et al. 2017, through colour-science.

    >>> (adaptation([0.5, 1.0, 2.0], [0.95, 1.0, 1.09]) @ [0.5, 1.0, 2.0]).round(2)
    array([0.95, 1.  , 1.09])
    """
    return _colour().adaptation.matrix_chromatic_adaptation_VonKries(
        np.asarray(white, float), np.asarray(wanted, float), transform="CAT16"
    )


_EDGE = 1e-6  # what linear sRGB may exceed 0 and 1 by


def _beyond(linear: np.ndarray) -> np.ndarray:
    return np.asarray(np.any((linear < -_EDGE) | (linear > 1 + _EDGE), axis=-1))


def linear_srgb(xyz: ArrayLike) -> Float[np.ndarray, "*image 3"]:
    """Linear sRGB of XYZ (..., 3), not clipped: negative where the gamut does not reach.

    Source: IEC 61966-2-1:1999, through colour-science.

    >>> linear_srgb([0.2, 0.4, 0.6]).round(2)
    array([-0.27,  0.58,  0.56])
    """
    xyz = np.asarray(xyz, dtype=np.float64)
    if xyz.ndim == 0 or xyz.shape[-1] != 3:
        raise ValueError(f"xyz must end in an axis of 3 (X, Y, Z), but has shape {xyz.shape}.")
    return _colour().XYZ_to_sRGB(xyz, apply_cctf_encoding=False)


def _less_chroma(xyz: Float[np.ndarray, "pixel 3"]) -> Float[np.ndarray, "pixel 3"]:
    """Linear sRGB of the largest share of a colour's chroma that lies within the gamut."""
    colour = _colour()
    lab = colour.XYZ_to_Oklab(xyz)
    lightness, chroma = np.clip(lab[:, :1], 0.0, 1.0), lab[:, 1:]

    def at(share):
        return linear_srgb(colour.Oklab_to_XYZ(np.hstack([lightness, share[:, None] * chroma])))

    low, high = np.zeros(len(lab)), np.ones(len(lab))
    for _ in range(20):
        middle = 0.5 * (low + high)
        beyond = _beyond(at(middle))
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return at(low)


def colour_checker(patch: str, wavelength: tables.Wavelengths) -> Float[np.ndarray, " wl"]:
    """Reflectance of one of the 24 patches of a ColorChecker, 380-780 nm by 5 nm.

    **Arguments:** `patch`: its name, such as "dark skin", "neutral 5" or "white"; `wavelength`:
    nm, concrete.

    **Raises:** `ValueError` with the near names for an unknown patch, and outside the range.

    Source: Ohta 1997, through colour-science.

    >>> colour_checker("white", [550.0]).round(2)
    array([0.89])
    """
    wavelength = tables.check_wavelength(wavelength)
    # "neutral 8 (.23 D)" is neutral 8, "white 9.5 (.05 D)" is white.
    chart = {
        re.sub(r" \(.*|(?<=white|black) .*", "", name): values
        for name, values in _colour().SDS_COLOURCHECKERS["cc_ohta"].items()
    }
    if patch not in chart:
        raise tables.unknown("ColorChecker patch", patch, chart)
    values = chart[patch]
    low, high = values.wavelengths[0], values.wavelengths[-1]
    if wavelength[0] < low or wavelength[-1] > high:
        raise ValueError(
            f"The ColorChecker covers {low:g}-{high:g} nm, but the wavelengths run from"
            f" {wavelength[0]:g} to {wavelength[-1]:g} nm."
        )
    return np.interp(wavelength, values.wavelengths, values.values)
