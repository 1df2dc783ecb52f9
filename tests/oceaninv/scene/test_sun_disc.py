"""The sun's disc blurs the pattern of light under waves."""

import jax.numpy as jnp
import numpy as np
import pytest

from oceaninv.scene import waves

INDEX = 1.34


def test_caustics_are_blurred_by_the_sun_of_half_a_degree():
    """Of low waves the pattern grows with depth, but for the disc: uniform, of radius 0.267
    degrees in air, it has a variance of a quarter of its square along each axis."""
    ripples = waves.Waves(2.0, [[4, 0]], [2e-6], [0.3])

    def contrast(depth):
        pattern = waves.caustics(
            ripples, jnp.asarray(1.0), jnp.asarray(INDEX), jnp.asarray(depth), 64
        )
        return abs(np.fft.rfft(np.asarray(pattern)[0])[4])

    faded = contrast(60.0) / contrast(0.1) / 600.0
    spread = 60.0 * np.radians(0.267) / INDEX / 2.0
    assert faded == pytest.approx(np.exp(-0.5 * (2 * np.pi * 4 / 2.0 * spread) ** 2), rel=2e-3)
