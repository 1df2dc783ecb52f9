"""A sixth constituent in one small file: bubbles, by their scattering coefficient (1/m)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from oceaninv.water.bio_optics import AbstractConstituent
from oceaninv.water.phase import AbstractPhase, HenyeyGreenstein


class Bubbles(AbstractConstituent):
    """Air bubbles: they do not absorb and scatter alike at all wavelengths."""

    phase: AbstractPhase | None = eqx.field(default_factory=lambda: HenyeyGreenstein(0.85))
    name: str = eqx.field(static=True, default="bubbles")

    def absorption(self, amount, wavelength: np.ndarray):
        return None

    def scattering(self, amount, wavelength: np.ndarray):
        return jnp.broadcast_to(amount, wavelength.shape)
