"""The scene that the unknowns of a fit describe."""

import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from fitting.core.parameters import Parameters
from fitting.water_model.unknowns import water_iops


def scene_at(parameters: Parameters, x: np.ndarray, wavelength: np.ndarray, sun=None) -> oi.Scene:
    """Water and light of a fit; `sun`: (wl,) its spectrum, even unless given."""
    values = parameters.values(jnp.asarray(x))
    sun = jnp.ones(len(wavelength)) if sun is None else jnp.asarray(sun)
    zenith = float(np.minimum(values["solar_zenith"], 89.0))
    return oi.Scene(water_iops(values, wavelength), oi.Light(zenith, sun), oi.FlatSurface())
