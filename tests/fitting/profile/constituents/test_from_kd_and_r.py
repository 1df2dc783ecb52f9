"""Robust weights of a measured Kd, and the priors of a water of which nothing is known."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root_scalar
from scipy.special import gammaln

import oceaninv as oi
from fitting.core.parameters import Parameter, Parameters
from fitting.profile.constituents import from_kd_and_r
from fitting.profile.constituents.batched_search import Water
from fitting.water_model.unknowns import absorption_shapes, shape_nuisances, water_unknowns

KD = np.array([0.1, 0.2, 0.4, 0.8, 0.3, 0.15])


def water(ratio, reflected):
    """A search that ended where the model's Kd is `ratio` of the measured one; of two unknowns the
    data fix one, and half of the other's information is its prior's."""
    model = np.ones((len(KD) + 1, len(KD)))
    model[1:][np.diag_indices(len(KD))] = np.exp(-ratio)
    covariance = jnp.diag(jnp.asarray([0.0, 0.5]))
    zero = jnp.zeros((), jnp.int32)
    return Water(jnp.zeros(2), covariance, zero, {}, {}, jnp.asarray(model), jnp.asarray(reflected))


UNKNOWNS = Parameters([Parameter("a", 1.0, 1.0), Parameter("b", 1.0, 1.0)])


def test_weights_are_those_of_students_t_with_four_degrees_of_freedom():
    """The weight of a residual is the slope of -ln t over the residual: 1 for none would be a
    normal's.  The factor on all errors is that of 5 % worth four degrees of freedom."""
    exact = from_kd_and_r._spectra(KD, np.full(6, np.nan), 0.05, 0.05, oi.TwoStream())
    ratio = 1.0 + 0.05 * np.array([0.0, 0.5, -1.0, 2.0, -4.0, 8.0])
    at = water(ratio, np.zeros(6))
    weighed, scale, dof = from_kd_and_r._weighed(KD, exact, at, UNKNOWNS, 1.3, 0.05)

    def log_density(u):
        return gammaln(2.5) - gammaln(2.0) - 0.5 * np.log(4 * np.pi) - 2.5 * np.log1p(u**2 / 4)

    u = (ratio - 1.0) / 0.05 / 1.3
    step = 1e-5
    slope = (log_density(u + step) - log_density(u - step)) / (2 * step)
    trust = np.where(u == 0, 5.0 / 4.0, -slope / np.where(u == 0, 1.0, u))
    # Of two unknowns the data determine 1 and a half.
    assert dof == pytest.approx(4.0 + 6.0 - 1.5, rel=1e-9)
    square = (4.0 + np.sum(trust * (1.3 * u) ** 2)) / dof
    assert scale == pytest.approx(np.sqrt(square), rel=1e-6)
    np.testing.assert_allclose(
        np.asarray(weighed.sd)[0] / np.asarray(exact.sd)[0], scale / np.sqrt(trust), rtol=1e-6
    )


def test_the_error_of_a_kd_is_five_percent_to_begin_with():
    """Of the difference of two logarithms, each as well known as the other."""
    exact = from_kd_and_r._spectra(KD, np.full(6, np.nan), 0.05, 0.05, oi.TwoStream())
    relative = np.asarray(exact.sd) / np.asarray(exact.light)
    for i in range(6):
        np.testing.assert_allclose(np.hypot(relative[0, i], relative[i + 1, i]), 0.05, rtol=1e-9)
    assert from_kd_and_r._KD_ERROR == 0.05


def test_priors_of_any_sea_are_twice_as_wide():
    known = {p.name: p for p in (*water_unknowns(None), *absorption_shapes())}
    wide = {p.name: p for p in from_kd_and_r._widened_priors(None)}
    assert set(wide) == set(known)
    shapes = {p.name for p in shape_nuisances()}
    for name, parameter in wide.items():
        before = known[name]
        assert before.spread is not None
        expected = 2.0 * before.spread if name in shapes else before.spread
        # What all bands have wrong together, by tilt and waves: a tenth.
        expected = 0.1 if name == "kd_model_error" else expected
        assert parameter.spread == pytest.approx(expected, rel=1e-12), name
        assert dataclasses.replace(parameter, spread=before.spread) == before


def test_a_scale_that_explains_its_own_residuals_stays():
    """The fixed point of the reweighting: the scale at which the weighted squares are its own."""
    exact = from_kd_and_r._spectra(KD, np.full(6, np.nan), 0.05, 0.05, oi.TwoStream())
    ratio = 1.0 + 0.05 * np.array([0.3, 0.5, -1.0, 2.0, -1.5, 1.0])
    misfit = (ratio - 1.0) / 0.05

    def excess(scale):
        trust = 5.0 / (4.0 + (misfit / scale) ** 2)
        return (4.0 + np.sum(trust * misfit**2)) / 8.5 - scale**2

    fixed = root_scalar(excess, bracket=(0.2, 5.0)).root
    found = from_kd_and_r._weighed(KD, exact, water(ratio, np.zeros(6)), UNKNOWNS, fixed, 0.05)
    assert found[1] == pytest.approx(fixed, rel=1e-9)
