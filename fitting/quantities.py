"""What a fitted water is like, in the numbers that people compare: Kd, c, bb, a_cdm."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.parameters import Parameters, water_iops
from fitting.posterior import Quantity, derived_quantity
from oceaninv.attenuation import kd_lee2005, kd_mean
from oceaninv.iops import IOPs
from oceaninv.optics import refracted_cosine

WATER_INDEX = 1.34
UNITS = {
    "Kd": ("m-1", "diffuse attenuation coefficient, mean from the surface to 10 % light"),
    "Kd_490": ("m-1", "Kd at 490 nm, mean from the surface to 10 % light"),
    "c": ("m-1", "beam attenuation coefficient"),
    "c_550": ("m-1", "beam attenuation coefficient at 550 nm"),
    "bb_550": ("m-1", "backscattering coefficient at 550 nm"),
    "a_cdm_440": ("m-1", "absorption by CDOM and detritus at 440 nm"),
}
_MARKS = np.array([440.0, 490.0, 550.0])


def kd_to_ten_percent(water: IOPs, solar_zenith: Float[Array, ""]) -> Float[Array, " wl"]:
    """Mean Kd from the surface to the depth of 10 % light, 1/m, under a sun without sky."""
    mu0 = refracted_cosine(jnp.cos(jnp.deg2rad(solar_zenith)), WATER_INDEX)
    a, b, bb = water.a, water.b, water.bb
    kd = kd_lee2005(a, bb, solar_zenith)
    for _ in range(2):
        depth = jnp.log(10.0) / jnp.maximum(kd, 1e-6)
        kd = jnp.diagonal(kd_mean(a, b, bb, mu0, depth))
    return kd


def water_quantities(
    values: Mapping[str, Float[Array, ""]], wavelength: np.ndarray
) -> dict[str, Float[Array, "..."]]:
    """The quantities named in `UNITS` from parameter values; spectra on `wavelength`."""
    zenith = values["solar_zenith"]
    water = water_iops(values, wavelength)
    marks = water_iops(values, _MARKS)
    row = dict(zip(marks.absorbers, marks.a_components, strict=True))
    return {
        "Kd": kd_to_ten_percent(water, zenith),
        "Kd_490": kd_to_ten_percent(marks, zenith)[1],
        "c": water.c,
        "c_550": marks.c[2],
        "bb_550": marks.bb[2],
        "a_cdm_440": row["cdom"][0] + row["detritus"][0],
    }


def quantities_of(
    values, slopes, parameters: Parameters, covariance: np.ndarray
) -> tuple[dict[str, Quantity], dict[str, dict[str, float]]]:
    """Quantities with standard deviations, and how far each scalar leans on each nuisance.

    The second: by quantity and nuisance, the relative change of the quantity if the nuisance's
    prior were centred one spread higher (linearised).
    """
    quantities, leaning = {}, {}
    for name, unit in UNITS.items():
        value, slope = np.asarray(values[name]), np.asarray(slopes[name])
        quantities[name] = derived_quantity(value, slope, covariance, *unit)
        if value.ndim == 0:
            moved = slope / value @ covariance
            leaning[name] = {
                p.name: float(moved[i] / p.spread)
                for i, p in enumerate(parameters)
                if p.nuisance and p.spread is not None
            }
    for i, parameter in enumerate(parameters):
        if not parameter.nuisance:
            leaning[parameter.name] = {
                p.name: float(covariance[i, j] / p.spread)
                for j, p in enumerate(parameters)
                if p.nuisance and p.spread is not None
            }
    return quantities, leaning
