"""Fits that choose their transport by a tolerance."""

import json

import numpy as np
import pytest

import oceaninv as oi
from fitting import fit_photo, fit_profile
from fitting._photo_problem import PhotoProblem, exact_ratios, predict_all, prepare, scaled
from fitting._planned import Demand, fit_within, scene_at
from fitting.parameters import Parameter, Parameters, constituents
from fitting.posterior import Fit, Predictive
from oceaninv.fidelity import choice, sufficient
from tests.test_photo import clean, fitted, photo
from tests.test_profile import constituent_cast

WAVELENGTH = oi.spectrum.bands(6)
DEMAND = Demand("irradiance")


def _stand_in(chlorophyll: float, transport) -> Fit:
    unknowns = Parameters([*constituents(), Parameter("solar_zenith", 40.0, 0.1, nuisance=True)])
    x = np.array([p.transform.coordinate(p.centre) for p in unknowns])
    x[0] = np.log(chlorophyll)
    name = type(transport).__name__
    one = np.ones((1, 1))
    nothing = Predictive(one, one, one, ("depth", "wavelength"), "1")
    return Fit(unknowns, x, np.eye(4), {}, WAVELENGTH, "", nothing, {"transport": name})


def _scene(fit):
    return scene_at(fit.parameters, fit.x, WAVELENGTH)


def test_the_plan_follows_the_water_that_is_found():
    """Clear water to begin with, murky at the first optimum: the check asks for a dearer rung."""
    starts = []

    def solve(transport, start):
        starts.append(None if start is None else np.exp(start[0]))
        return _stand_in(0.03 if start is None else 20.0, transport)

    fit, used = fit_within(0.01, None, solve, _scene, [DEMAND])
    plan = fit.metadata["plan"]
    assert plan["tried"][0] == "TwoStream()"
    assert len(plan["tried"]) > 1
    assert choice.rung(used) == plan["transport"] == plan["tried"][-1]
    assert starts[:2] == [None, pytest.approx(0.03)]
    assert plan["kept"]
    assert plan["predicted_error"] <= 0.01
    chosen, error = sufficient(_scene(fit), 0.01)
    ladder = [choice.rung(t) for t in choice.LADDERS["irradiance"]]
    assert ladder.index(plan["transport"]) >= ladder.index(choice.rung(chosen))
    assert error <= 0.01


def test_a_tolerance_that_nothing_keeps_ends_with_the_best_rung_and_says_so():
    fit, _ = fit_within(1e-6, None, lambda t, _: _stand_in(20.0, t), _scene, [DEMAND])
    assert not fit.metadata["plan"]["kept"]
    assert fit.metadata["plan"]["predicted_error"] > 1e-6


@pytest.mark.slow
def test_one_search_is_enough_where_the_cheapest_rung_is():
    fit = fit_photo(photo(clean()), tolerance=0.9)
    assert fit.metadata["plan"]["tried"] == ["TwoStream()"]
    np.testing.assert_allclose(fit.x, fitted().x, atol=1e-9)
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
def test_readings_divided_are_a_model_multiplied():
    """(reading - ratio model) / sd, as a photo fit within a tolerance is corrected."""
    parameters, readings, sunlight = prepare([photo(clean())], oi.KdTransport())
    layout, x = parameters.layout(), parameters.prior().centre
    problem = PhotoProblem(layout, parameters.prior(), readings, oi.KdTransport(), sunlight)
    ratio = [np.linspace(0.9, 1.2, readings[0].values.size).reshape(readings[0].values.shape)]
    ((seen, _),) = predict_all(layout, readings, oi.KdTransport(), sunlight, x)
    one, size = readings[0], readings[0].values.size
    expected = np.asarray((one.values - ratio[0] * seen) / one.sigma).reshape(-1)
    found = np.asarray(scaled(problem, ratio).residual(x))[:size]
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    same, largest = exact_ratios(problem, x, oi.KdTransport(), oi.KdTransport())
    np.testing.assert_allclose(same[0], 1.0)
    assert largest == 0.0


@pytest.mark.slow
def test_a_photo_fit_within_a_tolerance_is_that_of_the_exact_light(monkeypatch):
    """Readings of the exact light (few streams do for that)."""
    exact = oi.PlaneParallel(4, 4)
    monkeypatch.setattr("fitting.photo.EXACT", exact)
    parameters, readings, sunlight = prepare([photo()], exact)
    x = parameters.prior().centre
    ((seen, _),) = predict_all(parameters.layout(), readings, exact, sunlight, x)
    made = photo(np.asarray(seen))
    planned = fit_photo(made, tolerance=0.03)
    plan = planned.metadata["plan"]
    assert plan["tried"] == ["TwoStream()"]
    assert 0.01 < plan["largest_correction"] < 0.5
    assert plan["error_left"] <= 0.03
    assert plan["kept"]
    assert plan["corrected_by"] == choice.rung(exact)
    straight = fit_photo(made, transport=exact)
    for name in ("chlorophyll", "cdom", "detritus"):
        i = straight.parameters.names.index(name)
        assert abs(planned.x[i] - straight.x[i]) < 0.2 * straight.sd[name]
    np.testing.assert_allclose(planned.posterior_predictive.observed, seen, rtol=1e-10)


@pytest.mark.slow
def test_the_planned_fit_is_that_of_the_exact_light(monkeypatch):
    """A cast of the exact light (few streams do for that): noise averages out, a model's error does
    not."""
    exact = oi.PlaneParallel(4)
    monkeypatch.setattr("fitting.profile.EXACT", exact)
    profile = constituent_cast(np.array([440.0, 510.0, 580.0]), transport=exact)[1]
    planned = fit_profile(profile, tolerance=0.03)
    plan = planned.metadata["plan"]
    assert plan["kept"]
    assert 0.001 < plan["largest_correction"] < 0.1
    assert 1 <= plan["corrections"] <= 3
    assert plan["corrected_by"] == choice.rung(exact)
    straight = fit_profile(profile, transport=exact)
    for name in ("chlorophyll", "cdom", "detritus"):
        i = straight.parameters.names.index(name)
        assert abs(planned.x[i] - straight.x[i]) < 0.1 * straight.sd[name]
