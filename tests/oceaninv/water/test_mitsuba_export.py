"""The export to Mitsuba.  That Mitsuba loads it: tests/acceptance/mitsuba_export.py."""

import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi


def _water():
    phases = (oi.phase.Isotropic(), oi.phase.HenyeyGreenstein(0.8), oi.phase.petzold())
    b = jnp.asarray([[0.1, 0.1], [0.3, 0.1], [0.2, 0.2]])
    return oi.IOPs([500.0, 600.0], jnp.asarray([0.1, 0.2]), b, phases)


def _numbers(text):
    return np.array([float(x) for x in text.split(",")])


def test_medium():
    water = _water()
    medium = oi.mitsuba.mitsuba_medium(water)
    np.testing.assert_allclose(_numbers(medium["sigma_t"]["values"]), water.c, rtol=1e-5)
    np.testing.assert_allclose(_numbers(medium["albedo"]["values"]), water.albedo, rtol=1e-5)
    # Shares of 0.2, 0.4 and 0.4, nested.
    outer, inner = medium["phase"], medium["phase"]["phase_0"]
    np.testing.assert_allclose([outer["weight"], inner["weight"]], [0.4, 2 / 3])
    assert inner["phase_0"] == {"type": "isotropic"}
    np.testing.assert_allclose(inner["phase_1"]["g"], 0.8)
    np.testing.assert_allclose(outer["phase_1"]["g"], 0.924, atol=1e-3)


def test_refusals():
    clear = oi.IOPs([500.0, 600.0], jnp.ones(2), jnp.zeros(2), oi.phase.Isotropic())
    with pytest.raises(ValueError, match="does not scatter"):
        oi.mitsuba.mitsuba_medium(clear)
