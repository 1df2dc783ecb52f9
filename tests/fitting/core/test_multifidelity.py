"""Fits that choose their transport by a tolerance."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from fitting import fit_photo, fit_profile
from fitting.core.diagnostics import Status
from fitting.core.multifidelity import AccuracyTarget, multifidelity_fit
from fitting.core.parameters import Parameter, Parameters
from fitting.core.result import Fit, Predictive
from fitting.photo.exact_correction import exact_ratios, tangent, uncorrected
from fitting.photo.problem import PhotoProblem, predict_all, prepare, search
from fitting.water_model.scene_of_fit import scene_at
from fitting.water_model.unknowns import constituents
from oceaninv.fidelity import planning, sufficient
from tests.fitting.photo.test_fit_photo import clean, fitted, photo
from tests.fitting.profile.test_fit_profile import constituent_cast

WAVELENGTH = oi.spectrum.bands(6)
TARGET = AccuracyTarget("irradiance")


def _stand_in(chlorophyll: float, transport) -> Fit:
    unknowns = Parameters([*constituents(), Parameter("solar_zenith", 40.0, 0.1, nuisance=True)])
    x = np.array([p.transform.coordinate(p.centre) for p in unknowns])
    x[0] = np.log(chlorophyll)
    name = type(transport).__name__
    one = np.ones((1, 1))
    nothing = Predictive(one, one, one, ("depth", "wavelength"), "1")
    return Fit(
        unknowns, x, np.eye(4), {}, WAVELENGTH, Status.CONVERGED, nothing, {"transport": name}
    )


def _scene(fit):
    return scene_at(fit.parameters, fit.x, WAVELENGTH)


def test_the_plan_follows_the_water_that_is_found():
    """Clear water to begin with, murky at the first optimum: the check asks for a costlier one."""
    starts = []

    def solve(transport, start):
        starts.append(None if start is None else np.exp(start[0]))
        return _stand_in(0.03 if start is None else 20.0, transport)

    fit, used = multifidelity_fit(0.01, None, solve, _scene, [TARGET])
    plan = fit.plan
    assert plan.tried[0] == "TwoStream()"
    assert len(plan.tried) > 1
    assert planning.model_label(used) == plan.transport == plan.tried[-1]
    assert starts[:2] == [None, pytest.approx(0.03)]
    assert plan.within_tolerance
    assert plan.predicted_error <= 0.01
    chosen, error = sufficient(_scene(fit), 0.01)
    labels = [planning.model_label(t) for t in planning.CANDIDATES["irradiance"]]
    assert labels.index(plan.transport) >= labels.index(planning.model_label(chosen))
    assert error <= 0.01


def test_a_tolerance_that_nothing_keeps_ends_with_the_best_rung_and_says_so():
    fit, _ = multifidelity_fit(1e-6, None, lambda t, _: _stand_in(20.0, t), _scene, [TARGET])
    assert not fit.plan.within_tolerance
    assert fit.plan.predicted_error > 1e-6


@pytest.mark.slow
def test_one_search_is_enough_where_the_cheapest_rung_is():
    fit = fit_photo(photo(clean()), tolerance=0.9)
    plan = fit.plan
    assert plan.tried == ("TwoStream()",)
    assert plan.within_tolerance
    assert plan.settled
    assert json.loads(fit.to_xarray().attrs["metadata"])["plan"]["tolerance"] == 0.9


def test_a_transport_and_a_tolerance_exclude_each_other():
    for fit in (lambda **more: fit_photo(photo(), transport=oi.TwoStream(), **more),
                lambda **more: fit_profile(constituent_cast(np.array([490.0, 510.0, 532.0]))[1],
                                           transport=oi.TwoStream(), **more)):  # fmt: skip
        with pytest.raises(ValueError, match="leave one out"):
            fit(tolerance=0.1)
    with pytest.raises(ValueError, match="between 0 and 1"):
        fit_photo(photo(), tolerance=1.5)


@pytest.mark.slow
def test_a_corrected_model_is_the_exact_one_to_first_order():
    """About the point of the evaluation, in every unknown at once."""
    exact = oi.KdTransport()
    parameters, readings, sunlight = prepare([photo(clean())], oi.TwoStream())
    layout, prior = parameters.layout(), parameters.prior()
    x, unit = jnp.asarray(prior.centre), np.full(len(parameters), 0.1)
    problem = PhotoProblem(layout, prior, readings, oi.TwoStream(), sunlight)
    ratios = exact_ratios(problem, x, exact)
    correction = tangent(problem, np.asarray(x), ratios, unit, exact)
    model = dataclasses.replace(problem, correction=correction).residual
    true = dataclasses.replace(problem, transport=exact).residual
    np.testing.assert_allclose(model(x), true(x), rtol=1e-9, atol=1e-9)
    step = jnp.asarray(0.1 * unit * np.random.default_rng(0).standard_normal(len(unit)))
    off, apart = np.asarray(model(x + step) - true(x + step)), true(x + step) - true(x)
    assert np.linalg.norm(off) < 0.03 * np.linalg.norm(apart)
    same = exact_ratios(problem, x, oi.TwoStream())
    np.testing.assert_allclose(same[0], 1.0)


@pytest.mark.slow
def test_the_proximal_term_is_no_datum():
    """A search held firmly stays; its covariance is that of the readings and priors alone."""
    parameters, readings, sunlight = prepare([photo(clean())], oi.TwoStream())
    problem = PhotoProblem(
        parameters.layout(), parameters.prior(), readings, oi.TwoStream(), sunlight
    )
    start = jnp.asarray(fitted().x) + 0.1
    still = dataclasses.replace(uncorrected(problem), about=start, noise_inflation=jnp.ones(()))
    held = dataclasses.replace(
        still, proximal_weight=jnp.asarray(1e4), unit=0.1 * jnp.ones_like(start)
    )
    found = jax.jit(lambda c: search(dataclasses.replace(problem, correction=c), start))(held)
    np.testing.assert_allclose(found.x, start, atol=1e-4)
    size = problem.residual(start).shape[0]
    assert found.residual.shape == (size,)
    assert found.jacobian.shape == (size, len(start))


@pytest.mark.slow
def test_a_photo_fit_within_a_tolerance_is_that_of_the_exact_light(monkeypatch):
    """Readings of the exact light (few streams do for that)."""
    exact = oi.PlaneParallel(4, 4)
    monkeypatch.setattr("fitting.photo.fit_photo.EXACT", exact)
    parameters, readings, sunlight = prepare([photo()], exact)
    x = parameters.prior().centre
    ((seen, _),) = predict_all(parameters.layout(), readings, exact, sunlight, x)
    made = photo(np.asarray(seen))
    planned = fit_photo(made, tolerance=0.03)
    plan = planned.plan
    assert plan.tried == ("TwoStream()",)
    assert 0.01 < plan.largest_correction < 0.5
    assert plan.remaining_error <= 1e-3
    assert plan.settled
    assert plan.within_tolerance
    assert plan.corrected_by == planning.model_label(exact)
    straight = fit_photo(made, transport=exact)
    for name in ("chlorophyll", "cdom", "detritus"):
        i = straight.parameters.names.index(name)
        assert abs(planned.x[i] - straight.x[i]) < 0.1 * straight.sd[name]
    np.testing.assert_allclose(planned.posterior_predictive.observed, seen, rtol=1e-10)


@pytest.mark.slow
def test_the_planned_fit_is_that_of_the_exact_light(monkeypatch):
    """A cast of the exact light (few streams do for that): noise averages out, a model's error does
    not."""
    exact = oi.PlaneParallel(4)
    monkeypatch.setattr("fitting.profile.fit_profile.EXACT", exact)
    profile = constituent_cast(np.array([440.0, 510.0, 580.0]), transport=exact)[1]
    planned = fit_profile(profile, tolerance=0.03)
    plan = planned.plan
    assert plan.within_tolerance
    assert 0.001 < plan.largest_correction < 0.1
    assert 1 <= plan.corrections <= 3
    assert plan.corrected_by == planning.model_label(exact)
    straight = fit_profile(profile, transport=exact)
    for name in ("chlorophyll", "cdom", "detritus"):
        i = straight.parameters.names.index(name)
        assert abs(planned.x[i] - straight.x[i]) < 0.1 * straight.sd[name]
