"""The posterior of photographs of one water: unknowns, priors, residuals, search."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import oceaninv as oi
from fitting.core.least_squares import Optimum, least_squares
from fitting.core.parameters import Identity, Log, Parameter, Parameters, Prior
from fitting.core.problem import AbstractProblem
from fitting.core.program_cache import cached_jit
from fitting.observations.photo import WAVELENGTH, Photo
from fitting.photo.forward_model import (
    ALBEDO_TERMS,
    Readings,
    light_up,
    pixel_residual,
    predict_lit,
    predict_pixels,
    readings_of,
)
from fitting.photo.surroundings import SIDE_SD
from fitting.water_model.quantities import UNITS, water_quantities
from fitting.water_model.unknowns import constituents, pigment_packaging, shape_nuisances
from oceaninv.transport.base import AbstractTransport

_LAMP_EVENNESS = 0.1
# sd of ln of algal absorption at given chlorophyll.  Open ocean: 0.3-0.4 (Bricaud et al. 1998: r2
# of 0.90 at 440 nm over three decades of chlorophyll).  European coasts: 0.6 (Massicotte et al.
# 2023, doi 10.5194/essd-15-3529-2023: 60 stations above 0.5 mg/m3 with AC-9 absorption, split by
# least squares into the algae's mean spectrum and an exponential; 1.48 times the median deviation).
_ALGAL_ABSORPTION = 0.55


# Factor on the width of the particles' forward peak, and sd of its ln.  With it, the water model's
# phase functions have the image-forming light of others of equal bb/b, to 4 % for b r = 1 and discs
# of 0.005-0.3 of the range: 0.84-1.9 for the functions of Fournier & Forand that bb/b alone selects
# (Mobley et al. 2002), 1.5-3.2 for those of index 1.05-1.15 and slope 3.5-3.9, 2.2 for Petzold's.
_PEAK_WIDTH = (1.5, 0.5)

# Largest change (ln) of a correction from its value at the point: further away it is not known.
_LARGEST_CHANGE = 0.5


class Correction(eqx.Module):
    """First-order model of the ratio accurate/cheap prediction of each reading about a point,
    applied as a multiplicative correction.

    - `log`: ln of the ratio at the point, by photograph; `slope`: its derivative by the unknowns
      in `unit`.
    - `about`: the point; `unit`: standard deviations of the unknowns.
    - `proximal_weight`: weight of the standardised step from the point in a search's residual; 0
      leaves the search free.
    - `noise_inflation`: factor on the noise of the readings in the first stage of a search.
    """

    log: tuple[Float[Array, "reading channel"], ...]
    slope: tuple[Float[Array, "reading channel unknown"], ...]
    about: Float[Array, " unknown"]
    unit: Float[Array, " unknown"]
    proximal_weight: Float[Array, ""]
    noise_inflation: Float[Array, ""]

    def standardised_step(self, x: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """Distance of `x` from the point in standard deviations."""
        return (x - self.about) / self.unit

    def factor(self, photo: int, x: Float[Array, " unknown"]) -> Float[Array, "reading channel"]:
        """Ratio accurate/cheap of the readings of one photograph at `x`."""
        change = self.slope[photo] @ self.standardised_step(x)
        return jnp.exp(self.log[photo] + _LARGEST_CHANGE * jnp.tanh(change / _LARGEST_CHANGE))


class PhotoProblem(AbstractProblem):
    """The posterior of photographs of one water.

    - `known`: names of ancillary values; `known_values`: their (ln value, relative sd).
    - `robust`: residuals beyond so many standard deviations count linearly, None: all squared.
    - `correction`: factors on the transport's predictions of the readings, or None.
    """

    layout: Parameters = eqx.field(static=True)
    prior: Prior
    readings: tuple[Readings, ...]
    transport: AbstractTransport
    sunlight: Float[Array, " wl"]
    known: tuple[str, ...] = eqx.field(static=True, default=())
    known_values: Float[Array, "known 2"] | None = None
    robust: Float[Array, ""] | None = None
    correction: Correction | None = None

    def residual(self, x: Float[Array, " unknown"]) -> Float[Array, " residual"]:
        """Readings, pixels, ancillary values and priors, each in standard deviations."""
        values = self.layout.values(x)
        data, scenery = [], []
        for p, one in enumerate(self.readings):
            lit = light_up(values, one, self.sunlight, p)
            seen = predict_lit(lit, values, one, self.transport, p)
            if self.correction is not None:
                seen = seen * self.correction.factor(p, x)
            off = jnp.where(one.mask, (one.values - seen) / one.sigma, 0.0).reshape(-1)
            data.append(off if self.robust is None else _robust(off, self.robust))
            if one.pixels is not None:
                scenery.append(pixel_residual(lit, values, one.pixels, self.transport, p))
        if self.known_values is not None:
            scenery.append(self._ancillary(values, self.known_values))
        return jnp.concatenate([*data, *scenery, self.prior.residual(x)])

    def _ancillary(self, values, known):
        found = dict(values)
        if any(name in UNITS for name in self.known):
            found |= water_quantities(values, WAVELENGTH, self.transport)
        logs = jnp.log(jnp.stack([found[name] for name in self.known]))
        return (logs - known[:, 0]) / known[:, 1]

    def quantities(self, x: Float[Array, " unknown"]) -> dict[str, Array]:
        """Kd, c, bb, a_cdm; see `fitting.water_model.quantities.UNITS`."""
        return water_quantities(self.layout.values(x), WAVELENGTH, self.transport)


def _robust(residual, limit):
    """Signed square roots of twice the pseudo-Huber loss: r near 0, growing like sqrt beyond."""
    excess = residual / limit
    # loss = 2 limit^2 (sqrt(1 + e^2) - 1), written without cancellation; its root is smooth in r.
    return residual * jnp.sqrt(2.0 / (jnp.sqrt(1.0 + excess * excess) + 1.0))


def _widened_prior(shape: Parameter) -> Parameter:
    """The parameter with the spread that algal absorption has in nature."""
    if shape.name != "phytoplankton_absorption":
        return shape
    return dataclasses.replace(shape, spread=_ALGAL_ABSORPTION)


def _unknowns(photos: Sequence[Photo], matrix: bool) -> Parameters:
    sun = float(np.mean([photo.solar_zenith for photo in photos]))
    unknowns = [
        *constituents(),
        *map(_widened_prior, shape_nuisances()),
        pigment_packaging(),
        Parameter("solar_zenith", max(sun, 1.0), 0.1, Log(), "degree", True),
        Parameter("sunlight_tilt", 0.0, 0.05, Identity(), "1", True),
        # Relative error of the closed form in Kd.  Estimated for a less accurate Ed than today's
        # and not changed, because the coverage in
        # photo_statistics_mismatched.md was measured with it.
        Parameter("kd_model_error", 0.0, 0.035, Identity(), "1", True),
        # The error of the closed-form path radiance, per channel.
        *(Parameter(f"veil_{c}", 1.0, 0.06, nuisance=True, kind="veil", channel=c) for c in "RGB"),
    ]
    shift = max(photo.response_shift for photo in photos)
    if shift > 0:
        unknowns.append(Parameter("response_shift", 0.0, shift, Identity(), "nm", True))
    if any(photo.response is None for photo in photos):
        unknowns += [
            Parameter(f"response_{i}", 0.0, 1.0, Identity(), nuisance=True) for i in (1, 2, 3)
        ]
    if matrix:
        unknowns += [
            Parameter(f"mix_{i}{j}", 0.0, 0.3, Identity(), nuisance=True, kind="mix", channel=i)
            for i in "RGB"
            for j in "RGB"
            if i != j
        ]
    if any(photo.exposure is not None for photo in photos):
        unknowns += [
            Parameter(f"gain_{c}", 1.0, None, nuisance=True, kind="gain", channel=c) for c in "RGB"
        ]
    if any(photo.lamp for photo in photos):
        # Where lamp and view begin to overlap, which the lamp's arm and cone decide.
        unknowns.append(Parameter("overlap_distance", 0.2, 0.7, Log(), "m", True))
    unknowns += _of_boards(photos)
    for p, photo in enumerate(photos):
        unknowns += _of_frame(p, photo)
    return Parameters(unknowns)


def _of_boards(photos: Sequence[Photo]) -> list[Parameter]:
    """Unknowns of the light that boards and things send through small angles."""
    charts = [chart for photo in photos if not photo.lamp for chart in photo.charts]
    found = []
    if charts or any(photo.pixels is not None for photo in photos):
        found.append(Parameter("peak_width", *_PEAK_WIDTH, nuisance=True))
    sizes = [SIDE_SD if chart.board is None else chart.board.size_sd for chart in charts]
    if max(sizes, default=0.0) > 0:
        found.append(Parameter("board_size", 1.0, max(sizes), nuisance=True))
    return found


_WAYS = ("across", "down")


def _side_light(photo: Photo) -> float:
    """Exponent of the colour of diffuse light on upright charts that face the camera, beside that
    of diffuse scalar irradiance itself.

    That of the integral of `PlaneParallel`'s radiance over the chart's hemisphere, for clear,
    coastal and turbid water at 2-15 m: -0.5 to -0.1 for charts that face across the sun, -0.4 to
    0.6 for those that face away from it; it leaves 1 to 5 %.
    """
    away = abs((photo.azimuth + 180.0) % 360.0 - 180.0)
    return float(np.interp(away, [0.0, 90.0, 180.0], [0.2, -0.25, -0.25]))


def _of_frame(p: int, photo: Photo) -> list[Parameter]:
    def unknown(kind, centre, spread, *, chart=None, channel=None, **more):
        place = f"_{chart}" if chart is not None else f"_{channel}" if channel else ""
        where = {"photograph": p, "chart": chart, "channel": channel}
        name = f"{kind}_{p}{place}"
        return Parameter(name, centre, spread, nuisance=True, kind=kind, **where, **more)

    found = [unknown("depth", photo.depth, photo.depth_sd, unit="m")]
    if photo.exposure is None:
        found += [unknown("gain", 1.0, None, channel=c) for c in "RGB"]
    else:
        found.append(unknown("exposure", 1.0, photo.exposure_sd))
    if photo.charts and not photo.lamp:
        found.append(unknown("side_light", _side_light(photo), 0.3, transform=Identity()))
        if any(chart.place is not None for chart in photo.charts):
            # Of exact radiance over that of TwoStream, for clear, coastal and turbid water at 5 m:
            # 0.9-1.24 in zenith, 1.1-2.7 in azimuth.
            found.append(unknown("gradient_down", 1.1, 0.15, transform=Identity()))
            found.append(unknown("gradient_across", 1.6, 0.6, transform=Identity()))
            # Boards that are tilted, bent or shaded by their holder.
            found += [unknown(f"light_{way}", 0.0, 0.05, transform=Identity()) for way in _WAYS]
    for k, chart in enumerate(photo.charts):
        # A lamp lights charts by the inverse square of their distance; its cone and their tilt
        # cause deviations.
        spread = _LAMP_EVENNESS if photo.lamp else 1.0
        found.append(unknown("chart", 1.0, spread, chart=k))
        if chart.distance_sd > 0:
            found.append(unknown("range", 1.0, chart.distance_sd, chart=k))
    if photo.pixels is not None:
        found += [
            Parameter(f"albedo_{p}_{k}", 0.0, 1.0, Identity(), "1", True, "albedo", photograph=p)
            for k in range(ALBEDO_TERMS)
        ]
    return found


@cached_jit
def predict_all(layout, readings, transport, sunlight, x):
    """Readings of every photograph, and the means of its pixel classes (or None)."""
    values = layout.values(x)
    found = []
    for p, one in enumerate(readings):
        lit = light_up(values, one, sunlight, p)
        pixels = None
        if one.pixels is not None:
            pixels = predict_pixels(lit, values, one.pixels, transport, p)[0]
        found.append((predict_lit(lit, values, one, transport, p), pixels))
    return tuple(found)


def _start_gains(parameters: Parameters, readings, transport, sunlight) -> Parameters:
    """Centre the gains so that the model at the priors' centres is as bright as the readings."""
    centre = parameters.prior().centre
    at_centre = predict_all(parameters.layout(), readings, transport, sunlight, centre)
    changes, shared = {}, []
    at = {(g.photograph, g.channel): g for g in parameters if g.kind == "gain"}
    for p, (one, (model, pixels)) in enumerate(zip(readings, at_centre, strict=True)):
        ratio = np.where(np.asarray(one.mask), np.asarray(one.values) / np.asarray(model), np.nan)
        if pixels is not None:
            ratio = np.concatenate([ratio, np.asarray(one.pixels.mean) / np.asarray(pixels)])
        for i, c in enumerate("RGB"):
            column = ratio[:, i]
            if np.all(np.isnan(column)):
                raise ValueError(f"photograph {p} has no usable reading in channel {c}.")
            if one.exposure is None:
                gain = dataclasses.replace(
                    at[p, c], centre=float(np.nanmedian(column)), spread=None
                )
                changes[gain.name] = gain
        if one.exposure is not None:
            shared.append(ratio)
    if shared:
        for c, column in zip("RGB", np.concatenate(shared).T, strict=True):
            gain = dataclasses.replace(at[None, c], centre=float(np.nanmedian(column)), spread=None)
            changes[gain.name] = gain
    return parameters.replace(changes)


def photo_residual(parameters: Parameters, readings, transport, sunlight, prior=None):
    """The function of (x, values of each photograph) whose square a photo fit minimises.

    `prior`: the numbers of the priors; those of `parameters` unless given.
    """
    prior = parameters.prior() if prior is None else prior

    def residual(x, observed):
        here = eqx.tree_at(lambda all_: [one.values for one in all_], readings, list(observed))
        return PhotoProblem(parameters.layout(), prior, here, transport, sunlight).residual(x)

    return residual


def search(problem: PhotoProblem, start: Float[Array, " unknown"], solver: Any = None) -> Optimum:
    """The optimum of a photo fit.  Pure: jit and vmap it.

    `solver`: as for `fitting.core.least_squares.least_squares`.

    The first stage takes the readings as ten times as uncertain: from the priors' centres, exact
    readings can drive the first steps into opaque water, where the derivatives vanish.  With a
    correction, the correction sets the noise inflation and the proximal weight.
    """

    correction = problem.correction
    one = jnp.ones((), start.dtype)
    first = 10.0 if correction is None else correction.noise_inflation

    def stage(x, inflation):
        inflated = eqx.tree_at(
            lambda p: [one.sigma for one in p.readings],
            problem,
            [inflation * one.sigma for one in problem.readings],
        )

        def weighted(x, _):
            if correction is None:
                return inflated.residual(x)
            proximal = correction.proximal_weight * correction.standardised_step(x)
            return jnp.concatenate([inflated.residual(x), proximal])

        optimum = least_squares(weighted, x, None, problem.prior.scale, solver=solver)
        return optimum.x, optimum

    _, stages = jax.lax.scan(stage, start, jnp.stack([jnp.asarray(first, start.dtype), one]))
    found = jax.tree.map(lambda leaf: leaf[-1], stages)
    if correction is None:
        return found
    # The proximal term is no datum.
    rows = found.residual.shape[0] - start.shape[0]
    return Optimum(found.x, found.residual[:rows], found.jacobian[:rows], found.code)


def prepare(photos: Sequence[Photo], transport, priors=None, matrix: bool = False, sunlight=None):
    """Unknowns, readings and sunlight of a photo fit: what a `PhotoProblem` is made of."""
    if sunlight is None:
        sunlight = oi.spectrum.daylight(WAVELENGTH)
    sunlight = jnp.asarray(sunlight, dtype=float)
    readings = tuple(readings_of(photo) for photo in photos)
    parameters = _unknowns(photos, matrix).replace(priors or {})
    return _start_gains(parameters, readings, transport, sunlight), readings, sunlight
