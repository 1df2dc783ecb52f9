"""Colours that a developer mixed are told by the greys beside them."""

import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from fitting import Background, Chart, Photo
from fitting.images.chart_targets import target
from fitting.photo.developed import fit_checked, only_greys
from fitting.photo.forward_model import predict
from fitting.photo.problem import prepare
from tests.fitting.photo.test_fit_photo import CAMERA, TRUTH

COLOURS = target("ColorChecker24").reflectance
# What cameras do to make colours vivid: rows sum to one, so that greys stay grey.
DEVELOPER = np.array([[1.9, -0.7, -0.2], [-0.3, 1.6, -0.3], [0.0, -0.6, 1.6]])


def photo(values):
    charts = [
        Chart(values[24 * k : 24 * k + 24], COLOURS, r, 0.02 * np.abs(values[24 * k : 24 * k + 24]))
        for k, r in enumerate((0.6, 2.0))
    ]
    background = Background(values[48:], sigma=0.02 * np.abs(values[48:]))
    return Photo(charts, [background], depth=4.0, response=oi.spectrum.camera_response(CAMERA))


def readings(developer):
    parameters, (seen,), sunlight = prepare([photo(np.ones((49, 3)))], oi.TwoStream())
    values = {p.name: jnp.asarray(p.centre) for p in parameters}
    values |= {name: jnp.asarray(v) for name, v in TRUTH.items()}
    values |= {f"gain_0_{c}": jnp.asarray(g) for c, g in zip("RGB", (1.2, 0.8, 1.0), strict=True)}
    linear = np.asarray(predict(values, seen, oi.TwoStream(), sunlight))
    # White balance on the nearer chart's white, then the matrix, as developers do.
    balanced = linear / linear[18]
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal(linear.shape)
    return np.maximum(balanced @ developer.T, 1e-4) * noise


def test_greys_are_told_by_their_spectra():
    found = only_greys(photo(np.ones((49, 3))))
    assert found is not None
    assert [len(chart.values) for chart in found.charts] == [6, 6]
    assert only_greys(found) is None


@pytest.mark.slow
def test_a_developed_picture_is_not_fitted_as_raw():
    raw, said = fit_checked([photo(readings(np.eye(3)))])
    assert said == ""
    developed, said = fit_checked([photo(readings(DEVELOPER))])
    assert "greys and colours contradict each other" in said
    for fit in (raw, developed):
        low, high = fit.quantities["c_550"].interval(0.99, fit.dof)
        assert low < float(raw.quantities["c_550"].value) < high
    # Fitted as raw the same picture misses by far, and says so.
    from fitting import fit_photo

    wrong = fit_photo(photo(readings(DEVELOPER)))
    assert wrong.noise_factor is not None
    assert wrong.noise_factor**2 > 3
