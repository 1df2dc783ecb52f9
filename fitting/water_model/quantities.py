"""Quantities of a fitted water: Kd, c, bb, a_cdm."""

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.core.parameters import Parameters
from fitting.core.result import Description, Quantity, derived_quantity
from fitting.water_model.unknowns import water_iops
from oceaninv import FlatSurface, IOPs, Light, Scene
from oceaninv.transport.base import AbstractTransport
from oceaninv.water.attenuation import kd_jerlov1976, kd_lee2005

UNITS = {
    "Kd": Description(
        "m-1", "diffuse attenuation coefficient, mean from the surface to 10 % light", "Kd"
    ),
    "Kd_490": Description("m-1", "Kd at 490 nm, mean from the surface to 10 % light", "Kd"),
    "c": Description("m-1", "beam attenuation coefficient", "c"),
    "c_550": Description("m-1", "beam attenuation coefficient at 550 nm", "c"),
    "bb_550": Description("m-1", "backscattering coefficient at 550 nm", "bb"),
    "a_cdm_440": Description("m-1", "absorption by CDOM and detritus at 440 nm", "a_cdm"),
}
MARKS = np.array([440.0, 490.0, 550.0])


def kd_to_ten_percent(
    water: IOPs, solar_zenith: Float[Array, ""], transport: AbstractTransport
) -> Float[Array, " wl"]:
    """Mean Kd by a transport from the surface to the depth of 10 % light, 1/m, without sky.

    The depth itself is taken from Lee et al. 2005, good to 10 %: the mean moves by a fiftieth of
    that.
    """
    depth = jnp.log(10.0) / jnp.maximum(kd_lee2005(water.a, water.bb, solar_zenith), 1e-6)
    light = Light(solar_zenith, jnp.ones_like(depth))
    depths = jnp.concatenate([jnp.zeros_like(depth[:1]), depth])
    down = transport.irradiance(Scene(water, light, FlatSurface()), depths, None).Ed.value
    return jnp.log(down[0] / jnp.diagonal(down[1:])) / depth


def water_quantities(
    values: Mapping[str, Float[Array, ""]], wavelength: np.ndarray, transport: AbstractTransport
) -> dict[str, Float[Array, "..."]]:
    """The quantities named in `UNITS` from parameter values; spectra on `wavelength`."""
    grid = np.union1d(wavelength, MARKS)
    water = water_iops(values, grid)
    # `kd_model_error`: relative error of the transport's Kd, a nuisance of the fits.
    error = 1.0 + values.get("kd_model_error", 0.0)
    kd = error * kd_to_ten_percent(water, values["solar_zenith"], transport)
    asked = np.searchsorted(grid, wavelength)
    at_440, at_490, at_550 = np.searchsorted(grid, MARKS)
    row = dict(zip(water.absorbers, water.a_components, strict=True))
    return {
        "Kd": kd[asked],
        "Kd_490": kd[at_490],
        "c": water.c[asked],
        "c_550": water.c[at_550],
        "bb_550": water.bb[at_550],
        "a_cdm_440": (row["cdom"] + row["detritus"])[at_440],
    }


def nearest_jerlov(wavelength: np.ndarray, kd: Quantity) -> tuple[str, float]:
    """The Jerlov type whose Kd (Jerlov 1976) is nearest, and how far it is.

    Nearest in ln Kd over all bands, weighted by each band's variance plus 10 % for the differences
    between types; the distance is the unweighted root mean square difference.
    """
    weight = 1.0 / (kd.sd**2 + 0.1**2)
    best = ("", np.inf, np.inf)
    for name in ("I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C"):
        off = np.log(kd.value / np.asarray(kd_jerlov1976(name, wavelength)))
        misfit = float(np.sum(weight * off**2))
        if misfit < best[1]:
            best = (name, misfit, float(np.sqrt(np.mean(off**2))))
    return best[0], best[2]


def quantities_of(
    values, slopes, parameters: Parameters, covariance: np.ndarray, second_order=None, units=UNITS
) -> tuple[dict[str, Quantity], dict[str, dict[str, float]]]:
    """Quantities with standard deviations, and the sensitivity of each scalar to each nuisance.

    `units`: unit and long name of each.  `second_order`: a
    `fitting.core.least_squares.SecondOrderError`, whose standard deviations, at most those of the
    linear errors, widen the intervals.  The sensitivity, by quantity and nuisance, is the relative
    change of the quantity if the nuisance's prior were centred one standard deviation higher
    (linearised).
    """
    quantities, sensitivity = {}, {}
    for name, unit in units.items():
        value, slope = np.asarray(values[name]), np.asarray(slopes[name])
        found = derived_quantity(value, slope, covariance, *unit)
        if second_order is not None:
            extra = np.minimum(np.asarray(second_order.derived[name]), found.sd)
            found = dataclasses.replace(found, second_order_sd=extra)
        quantities[name] = found
        if value.ndim == 0:
            moved = slope / value @ covariance
            sensitivity[name] = {
                p.name: float(moved[i] / p.spread)
                for i, p in enumerate(parameters)
                if p.nuisance and p.spread is not None
            }
    for i, parameter in enumerate(parameters):
        if not parameter.nuisance:
            sensitivity[parameter.name] = {
                p.name: float(covariance[i, j] / p.spread)
                for j, p in enumerate(parameters)
                if p.nuisance and p.spread is not None
            }
    return quantities, sensitivity
