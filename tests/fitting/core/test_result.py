"""Intervals, identifiability and derived quantities."""

import dataclasses
import json

import jax
import numpy as np
import pytest
import xarray as xr
from matplotlib.image import imread
from scipy.stats import norm, t

import oceaninv as oi
from fitting import Fit, Identity, Logit, Parameter, Profile, Quantity, fit_profile
from fitting.core.diagnostics import ModelChoice, Status
from fitting.core.parameters import Parameters
from fitting.core.result import (
    Predictive,
    amount_bias,
    derived_quantity,
    half_width,
    quantile,
    sensitivity_text,
)


def fit(parameters, x, sd, correlation=0.0, dof=None, ended=Status.CONVERGED):
    sd = np.asarray(sd, dtype=float)
    matrix = np.full((len(sd), len(sd)), correlation)
    np.fill_diagonal(matrix, 1.0)
    nothing = Predictive(np.zeros(1), np.zeros(1), np.ones(1), ("reading",), "1")
    return Fit(
        Parameters(parameters),
        np.asarray(x, dtype=float),
        matrix * np.outer(sd, sd),
        {},
        np.array([440.0]),
        ended,
        nothing,
        {"source": "here", "count": np.int64(3)},
        dof,
    )


@pytest.mark.parametrize("level", [0.5, 0.68, 0.95, 0.999])
def test_quantiles_are_those_of_the_distributions(level):
    tail = 0.5 + level / 2
    assert quantile(level) == pytest.approx(norm.ppf(tail), rel=1e-12)
    for dof in (1.0, 3.0, 18.0, 4000.0):
        assert quantile(level, dof) == pytest.approx(t.ppf(tail, dof), rel=1e-9)
    assert quantile(level, 3.0) > quantile(level, 30.0) > quantile(level)


def test_intervals_live_where_their_transform_does():
    one = fit(
        [
            Parameter("kd", 0.2),
            Parameter("tilt", 0.0, 0.1, Identity()),
            Parameter("share", 0.5, None, Logit(0.0, 1.0)),
        ],
        [np.log(0.3), -0.2, 0.0],
        [0.1, 0.05, 3.0],
    )
    reach = 1.959963984540054
    assert one.interval("kd") == pytest.approx(
        (0.3 * np.exp(-0.1 * reach), 0.3 * np.exp(0.196)), rel=1e-4
    )
    assert one.interval("tilt", 0.68) == pytest.approx((-0.2 - 0.0497, -0.2 + 0.0497), abs=1e-4)
    low, high = one.interval("share")
    assert 0 < low < 0.5 < high < 1
    assert low == pytest.approx(1 - high, rel=1e-9)
    assert one.value == {
        "kd": pytest.approx(0.3),
        "tilt": pytest.approx(-0.2),
        "share": pytest.approx(0.5),
    }


def test_an_estimated_noise_widens_intervals_by_students_t():
    known = fit([Parameter("kd", 0.2)], [0.0], [0.1])
    estimated = fit([Parameter("kd", 0.2)], [0.0], [0.1], dof=3.0)
    ratio = np.log(estimated.interval("kd")[1]) / np.log(known.interval("kd")[1])
    assert ratio == pytest.approx(t.ppf(0.975, 3) / norm.ppf(0.975), rel=1e-9)


@pytest.mark.parametrize("level", [0.68, 0.95])
def test_a_bent_error_stays_inside_its_half_width(level):
    """x = z + c (z^2 - 1): the interval of the mode holds as much as it says, for either sign."""
    z = np.random.default_rng(1).standard_normal(400_000)
    for c in (0.15, -0.15, 0.3):
        inside = np.abs(z + c * (z * z - 1)) < half_width(level, 1.0, np.sqrt(2.0) * abs(c))
        assert level - 0.03 < inside.mean() < level + 0.035
    assert half_width(level, 0.2, 0.0, 5.0) == pytest.approx(0.2 * quantile(level, 5.0))


def test_the_mode_of_an_amounts_logarithm_is_off_by_its_bias():
    """Of an amount of 1 read with an error of 0.05, and no further than half a deviation."""
    z = np.random.default_rng(2).standard_normal(1_000_000)
    assert np.mean(np.log(1 + 0.05 * z)) == pytest.approx(amount_bias(np.array(0.05)), abs=2e-4)
    np.testing.assert_allclose(amount_bias(np.array([0.5, 1.0, 3.0])), [-0.125, -0.5, -1.5])


def test_the_value_is_the_mode_less_its_bias_and_the_interval_is_about_the_mode():
    one = dataclasses.replace(
        fit([Parameter("a", 1.0)], [0.3], [0.2]),
        bias=np.array([-0.05]),
        second_order_sd=np.array([0.1]),
    )
    assert one.value["a"] == pytest.approx(np.exp(0.35))
    low, high = one.interval("a")
    assert np.log(low * high) == pytest.approx(0.6)
    reach = np.hypot(1.959964 * 0.2, (1.959964**2 - 1) * 0.1 / np.sqrt(2))
    assert np.log(high / low) == pytest.approx(2 * reach, rel=1e-6)


@pytest.mark.parametrize(
    ("parameter", "sd", "expected"),
    [
        (Parameter("cdom", 0.1, 2.3), 0.1, True),
        (Parameter("cdom", 0.1, 2.3), 0.6, False),  # nobody should quote a factor of 1.8
        (Parameter("detritus_scattering_ratio", 5.0, 0.3), 0.29, False),  # the prior speaks
        (Parameter("detritus_scattering_ratio", 5.0, 0.3), 0.1, True),
        (Parameter("kd", 0.1, None), 0.49, True),
        (Parameter("kd", 0.1, None), np.inf, False),
        (Parameter("kd", 0.1, None), np.nan, False),
        (Parameter("tilt", 0.0, 3.0, Identity()), 0.7, True),
        (Parameter("tilt", 0.0, 0.7, Identity()), 0.69, False),
    ],
)
def test_identifiable_means_narrow_and_not_from_the_prior(parameter, sd, expected):
    assert fit([parameter], [0.0], [sd]).identifiable == {parameter.name: expected}


def test_correlation_follows_from_the_covariance():
    one = fit([Parameter("a", 1.0), Parameter("b", 1.0)], [0.0, 0.0], [0.1, 20.0], -0.7)
    np.testing.assert_allclose(one.correlation, [[1.0, -0.7], [-0.7, 1.0]], rtol=1e-12)
    assert one.sd == {"a": pytest.approx(0.1), "b": pytest.approx(20.0)}


def test_the_result_is_the_message_of_the_status():
    one = fit([Parameter("a", 1.0)], [0.0], [0.1])
    assert one.converged
    assert one.result == "converged"
    short = fit([Parameter("a", 1.0)], [0.0], [0.1], ended=Status.STEP_LIMIT)
    assert not short.converged
    assert short.result == Status.STEP_LIMIT.message
    assert len({status.message for status in Status}) == len(Status) == 6
    assert [Status(code).value for code in range(6)] == list(range(6))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["value", "sd", "quantity", "its sd"])
def test_a_number_that_is_not_finite_is_never_converged(where, bad):
    numbers = dict.fromkeys(("value", "sd", "quantity", "its sd"), 0.1) | {where: bad}
    quantity = Quantity(np.array(numbers["quantity"]), np.array(numbers["its sd"]), "1", "q")
    one = fit([Parameter("a", 1.0)], [numbers["value"]], [numbers["sd"]])
    one = dataclasses.replace(one, quantities={"q": quantity})
    assert one.status is Status.NUMBERS_NOT_FINITE
    assert not one.converged
    assert "not finite" in one.result
    # What was wrong with the search comes first.
    assert dataclasses.replace(one, ended=Status.STEP_LIMIT).status is Status.STEP_LIMIT


def test_a_negative_kd_is_never_converged():
    """A closed form beyond its domain may give one; all derived quantities are positive."""
    one = fit([Parameter("a", 1.0)], [0.0], [0.1])
    kd = Quantity(np.array([0.2, -2.7]), np.array([0.1, 0.1]), "m-1", "Kd")
    wrong = dataclasses.replace(one, quantities={"Kd": kd})
    assert wrong.status is Status.OUTSIDE_MODEL
    assert not wrong.converged
    assert "does not describe" in wrong.result


def test_bands_without_data_and_nuisances_may_lack_numbers():
    parameters = [Parameter("a", 1.0), Parameter("b", 1.0, nuisance=True)]
    one = fit(parameters, [0.0, np.nan], [0.1, np.nan])
    spectrum = np.array([0.1, np.nan])
    half = dataclasses.replace(one, quantities={"Rrs": Quantity(spectrum, spectrum, "sr-1", "R")})
    assert half.converged
    nowhere = Quantity(spectrum * np.nan, spectrum, "sr-1", "R")
    none = dataclasses.replace(one, quantities={"Rrs": nowhere})
    assert none.status is Status.NUMBERS_NOT_FINITE


def test_an_interval_wider_than_its_prior_is_not_identifiable():
    """sd of 0.75 of the prior's counts as narrow, but not with a second-order error as large."""
    one = fit([Parameter("a", 1.0, 0.5)], [0.0], [0.375])
    assert one.identifiable["a"]
    half_width = np.hypot(1.959964 * 0.375, (1.959964**2 - 1) * 0.375 / np.sqrt(2))
    assert half_width > 1.959964 * 0.5
    wide = dataclasses.replace(one, second_order_sd=np.array([0.375]))
    assert not wide.identifiable["a"]
    # So is Student's t with few degrees of freedom: 4.30 standard deviations of 2.
    assert not dataclasses.replace(one, dof=2.0).identifiable["a"]
    assert dataclasses.replace(one, dof=2.0, covariance=np.array([[0.04]])).identifiable["a"]


def test_numbers_are_scalar_quantities_and_what_was_asked_for():
    parameters = [
        Parameter("cdom", 0.1, 2.3, unit="m-1"),
        Parameter("Kd_490", 0.1, unit="m-1", wavelength=490.0),
        Parameter("tilt", 1.0, nuisance=True),
    ]
    quantities = {
        "c": Quantity(np.ones(2), np.ones(2), "m-1", "c"),
        "c_550": Quantity(np.array(0.3), np.array(0.6), "m-1", "c"),
    }
    one = fit(parameters, np.log([0.2, 0.3, 1.0]), [0.1, 0.6, 0.1])
    one = dataclasses.replace(one, quantities=quantities)
    found = one.numbers()
    assert [number.name for number in found] == ["c_550", "cdom", "Kd_490"]
    assert [number.identifiable for number in found] == [False, True, False]
    assert [number.wavelength for number in found] == [None, None, 490.0]
    cdom = found[1]
    assert (cdom.value, cdom.unit) == (pytest.approx(0.2), "m-1")
    assert (cdom.low, cdom.high) == one.interval("cdom")
    assert (cdom.value_text, cdom.interval_text) == ("0.2", "0.164 - 0.243")
    assert (found[0].low, found[0].high) == quantities["c_550"].interval()
    assert found[0].value_text == "not identifiable"
    assert [number.name for number in one.parameter_numbers()] == ["cdom", "Kd_490", "tilt"]


def test_sensitivities_are_the_largest_in_per_cent():
    shifts = {"a": 0.02, "b": -0.31, "c": 0.1}
    assert sensitivity_text(shifts, 2) == "b -31 %, c +10 %"


def test_facts_are_metadata_and_how_the_fit_was_found():
    plan = ModelChoice("TwoStream()", ("TwoStream()",), 0.03, 0.05)
    assert not plan.within_tolerance
    plan = dataclasses.replace(plan, corrections=2, remaining_error=0.01)
    assert plan.within_tolerance
    one = fit([Parameter("a", 1.0)], [0.0], [0.1])
    assert one.facts == one.metadata
    one = dataclasses.replace(one, plan=plan, noise_factor=1.5)
    facts = json.loads(one.metadata_json())
    assert facts["source"] == "here"
    assert facts["noise_factor"] == 1.5
    assert facts["plan"]["tolerance"] == 0.03
    assert facts["plan"]["within_tolerance"] is True
    assert "settled" not in facts["plan"]


def test_metadata_is_one_line_of_json():
    text = fit([Parameter("a", 1.0)], [0.0], [0.1]).metadata_json()
    assert "\n" not in text
    assert json.loads(text)["source"] == "here"


def test_a_derived_quantity_is_what_samples_of_its_parameters_say():
    rng = np.random.default_rng(4)
    cov = np.array([[0.01, -0.006], [-0.006, 0.0064]])
    x = np.log([0.2, 0.05])

    def total(x):
        return np.stack([np.exp(x[..., 0]) + np.exp(x[..., 1]), np.exp(x[..., 0])], axis=-1)

    value = total(x)
    slope = np.array([[0.2, 0.05], [0.2, 0.0]])
    found = derived_quantity(value, slope, cov, "m-1", "sum")
    samples = np.log(total(rng.multivariate_normal(x, cov, 200_000)))
    np.testing.assert_allclose(found.sd, samples.std(axis=0), rtol=0.02)
    low, high = found.interval(0.95)
    inside = (samples > np.log(low)) & (samples < np.log(high))
    np.testing.assert_allclose(inside.mean(axis=0), 0.95, atol=0.005)


def test_intervals_of_quantities_are_symmetric_in_the_logarithm():
    one = Quantity(np.array([0.1, 2.0]), np.array([0.3, 0.0]), "m-1", "x")
    low, high = one.interval(0.68, dof=5.0)
    np.testing.assert_allclose(low * high, one.value**2, rtol=1e-12)
    assert low[1] == high[1] == 2.0
    np.testing.assert_allclose(np.log(high[0] / 0.1), 0.3 * quantile(0.68, 5.0), rtol=1e-12)


def test_relative_and_absolute_deviations_have_names_of_their_own():
    quantity = Quantity(np.array([0.04, 2.0]), np.array([0.1, 0.02]), "m-1", "Kd")
    np.testing.assert_array_equal(quantity.relative_sd, quantity.sd)
    np.testing.assert_allclose(quantity.absolute_sd, [0.004, 0.04], rtol=1e-12)


def with_residuals(residuals, **changes):
    """A fit of two unknowns, the first fixed by the data, whose sd of a datum is 2."""
    residuals = np.asarray(residuals, dtype=float)
    seen = Predictive(2.0 * residuals, 0.0 * residuals, 2.0 + 0.0 * residuals, ("reading",), "1")
    one = fit([Parameter("a", 1.0), Parameter("b", 1.0, 0.5)], [0.0, 0.0], [0.1, 0.5])
    return dataclasses.replace(one, posterior_predictive=seen, **changes)


def test_reduced_chi_square_is_per_degree_of_freedom():
    assert with_residuals([1, -1, 2, np.nan]).reduced_chi2 == pytest.approx(6.0 / 2.0, rel=1e-12)
    assert with_residuals([1, -1, 2]).doubt is None  # 3 is not above 3
    assert with_residuals([1, np.nan]).reduced_chi2 is None
    # Noise that was estimated from the residuals says nothing about the model.
    assert with_residuals([9, 9, 9], dof=5.0).reduced_chi2 is None
    # The Birge ratio brings the residuals to 1; what counts is what they were before.
    assert with_residuals([1, 1, 1], noise_factor=3.0).reduced_chi2 == 9.0
    assert with_residuals([1, 1, 1], noise_factor=1.0).reduced_chi2 == pytest.approx(1.5)


def test_a_model_that_does_not_describe_the_data_is_doubted_first():
    one = with_residuals([3, -3, 4])
    sentence = (
        "The model does not describe these data: reduced chi-square 17.0; the numbers below are "
        "doubtful."
    )
    assert one.doubt == one.summary().splitlines()[0] == sentence
    assert one._repr_html_().startswith(f"<p><strong>{sentence}</strong></p><table>")
    assert with_residuals([1, 1, 1]).summary().startswith("search: converged")
    assert "strong" not in with_residuals([1, 1, 1])._repr_html_()


def test_summary_and_repr_are_short():
    one = fit(
        [
            Parameter("a<b", 1.0, unit="m-1"),
            Parameter("b", 1.0, 0.5),
            Parameter("c", 1.0),
            Parameter("d", 1.0, nuisance=True),
            Parameter("e", 1.0),
        ],
        [0.0] * 5,
        [0.1, 0.5, 0.1, 0.1, 0.1],
    )
    assert one.summary().splitlines() == [
        "search: converged",
        "quantity  unit             value  95 % interval",
        "a<b       m-1                  1   0.822 - 1.22",
        "b         1     not identifiable   0.375 - 2.66",
        "c         1                    1   0.822 - 1.22",
        "e         1                    1   0.822 - 1.22",
    ]
    assert repr(one) == (
        "Fit(a<b 1 m-1 (0.822 - 1.22), b not identifiable, c 1 1 (0.822 - 1.22), and 1 more; "
        "converged)"
    )
    assert "a&lt;b</td><td>m-1</td><td>1</td><td>0.822 - 1.22" in one._repr_html_()


def light(kd, noise=0.01):
    depth = np.linspace(0.5, 20.0, 60)
    error = 1.0 + noise * np.random.default_rng(0).standard_normal((60, len(kd)))
    return Profile(depth, [490.0, 555.0, 750.0], np.exp(-np.array(kd) * depth[:, None]) * error)


def test_light_that_no_water_makes_is_doubted_and_that_of_water_is_not():
    """Pure water absorbs 2.5 m-1 at 750 nm: a Kd of 0.12 there is the sensor's own floor."""
    with jax.enable_x64(True):
        absurd = fit_profile(light([0.06, 0.09, 0.12]), transport=oi.TwoStream())
        sound = fit_profile(light([0.06, 0.09, 2.6]), transport=oi.TwoStream())
    assert absurd.reduced_chi2 > 4.5
    assert absurd.doubt is not None
    assert 0.5 < sound.reduced_chi2 < 2.0
    assert sound.doubt is None


def test_a_fit_is_written_and_drawn_from_python(tmp_path):
    depth = np.linspace(0.5, 20.0, 40)
    one = fit_profile(Profile(depth, [490.0], np.exp(-0.1 * depth)[:, None]))
    one.to_netcdf(tmp_path / "a.nc")
    with xr.open_dataset(tmp_path / "a.nc") as data:
        np.testing.assert_array_equal(data.Kd, one.quantities["Kd"].value)
        assert data.attrs["history"].endswith(f"Z: written by oceaninv {oi.__version__}")
    (tmp_path / "a.nc").write_text("mine")
    with pytest.raises(ValueError, match="overwrite=True"):
        one.to_netcdf(tmp_path / "a.nc")
    figure = one.plot()
    assert len(figure.axes) == 3
    one.report(tmp_path / "a.png")
    figure.savefig(tmp_path / "b.png", dpi=130)
    pixels = [imread(tmp_path / name) for name in ("a.png", "b.png")]
    np.testing.assert_array_equal(*pixels)
