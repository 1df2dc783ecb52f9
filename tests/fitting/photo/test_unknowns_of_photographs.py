"""Priors and noise of photographs, a number a row, and what becomes of more scatter than stated."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from fitting import Background, Chart, Identity, Log, Photo, Pixels
from fitting.core.least_squares import Optimum
from fitting.observations.photo import WAVELENGTH
from fitting.photo import fit_photo as photo_fits
from fitting.photo import forward_model
from fitting.photo import problem as photo_problem
from fitting.photo.exact_correction import uncorrected
from fitting.water_model.unknowns import shape_nuisances

VALUES = np.linspace(0.1, 0.9, 18).reshape(6, 3)
GREYS = np.linspace(0.05, 0.9, 6)


def photo(**changes):
    chart = Chart(VALUES, GREYS, 2.0, **changes.pop("chart", {}))
    return Photo([chart], depth=5.0, **changes)


def found(one, matrix=False):
    return {p.name: p for p in photo_problem._unknowns([one], matrix)}


def problem_of(one):
    """The posterior of a photograph; gains stay at 1, so that no light need be computed."""
    unknowns = photo_problem._unknowns([one], False)
    sunlight = jnp.ones(len(WAVELENGTH))
    return photo_problem.PhotoProblem(
        unknowns.layout(), unknowns.prior(), (forward_model.readings_of(one),), oi.TwoStream(),
        sunlight,
    )  # fmt: skip


def check(parameter, centre, spread, unit, transform):
    assert parameter.centre == pytest.approx(centre, rel=1e-9), parameter.name
    assert parameter.spread == pytest.approx(spread, rel=1e-9), parameter.name
    assert (parameter.unit, parameter.transform) == (unit, transform), parameter.name
    assert parameter.nuisance


def test_priors_of_a_photograph_in_daylight():
    rng = np.random.default_rng(0)
    pixels = Pixels(rng.uniform(0.1, 0.5, (200, 3)), rng.uniform(1.0, 5.0, 200))
    changes = {"chart": {"distance_sd": 0.04}, "response_shift": 3.0, "exposure": 1.0}
    known = found(photo(solar_zenith=30.0, pixels=pixels, **changes), matrix=True)
    # The sun is seen from a boat to a tenth; daylight is bluer or redder by 5 % in 100 nm.
    check(known["solar_zenith"], 30.0, 0.1, "degree", Log())
    check(known["sunlight_tilt"], 0.0, 0.05, "1", Identity())
    # Errors of the closed forms: 3.5 % of Kd, 6 % of the path radiance in a channel.
    check(known["kd_model_error"], 0.0, 0.035, "1", Identity())
    for channel in "RGB":
        check(known[f"veil_{channel}"], 1.0, 0.06, "1", Log())
    # Bricaud et al. 1998 in the open ocean 0.4, Massicotte et al. 2023 on coasts 0.6.
    check(known["phytoplankton_absorption"], 1.0, 0.55, "1", Log())
    check(known["phytoplankton_package"], 1.0, 1.2, "1", Log())
    # What the diver says: depth to 2 %, exposure to 3 %, distance and shift as given.
    check(known["depth_0"], 5.0, 0.02, "m", Log())
    check(known["exposure_0"], 1.0, 0.03, "1", Log())
    check(known["range_0_0"], 1.0, 0.04, "1", Log())
    check(known["response_shift"], 0.0, 3.0, "nm", Identity())
    # Light on a chart is unknown to a factor of e; cross-talk of channels to 0.3.
    check(known["chart_0_0"], 1.0, 1.0, "1", Log())
    check(known["mix_RG"], 0.0, 0.3, "1", Identity())
    # Scores of principal components have unit variance.
    for name in ("response_1", "response_2", "response_3", "albedo_0_0", "albedo_0_3"):
        check(known[name], 0.0, 1.0, "1", Identity())
    assert "albedo_0_4" not in known
    shapes = {p.name: p for p in shape_nuisances()}
    for name in set(shapes) - {"phytoplankton_absorption"}:
        assert known[name] == shapes[name]


def test_priors_by_lamplight():
    """A lamp lights charts evenly to a tenth, and the line of sight from 0.2 m on, within a factor
    of two."""
    known = found(photo(lamp=True))
    check(known["chart_0_0"], 1.0, 0.1, "1", Log())
    check(known["overlap_distance"], 0.2, 0.7, "m", Log())


def test_noise_that_is_not_given_is_that_of_the_kind_of_reading():
    """1 % of charts and open water, 3 % of pixels, which are 200 surfaces unless said otherwise."""
    chart, water = Chart(VALUES, GREYS, 2.0), Background(VALUES[:1])
    np.testing.assert_allclose(chart.sigma, 0.01 * VALUES, rtol=1e-12)
    np.testing.assert_allclose(water.sigma, 0.01 * VALUES[:1], rtol=1e-12)
    pixels = Pixels(np.full((300, 3), 0.4), np.linspace(1.0, 5.0, 300))
    np.testing.assert_allclose(pixels.sigma, 0.012, rtol=1e-12)
    assert pixels.surfaces == 200.0
    assert photo().solar_zenith == 40.0
    assert photo().azimuth == 90.0


def test_natural_reflectance_varies_by_half_in_brightness_and_a_quarter_in_colour():
    """Covariance 0.2^2 (0.5^2 + 0.25^2 exp(-(distance/100 nm)^2/2)), by its first four terms."""
    apart = WAVELENGTH[:, None] - WAVELENGTH[None, :]
    covariance = 0.2**2 * (0.5**2 + 0.25**2 * np.exp(-0.5 * (apart / 100.0) ** 2))
    left, sizes, right = np.linalg.svd(covariance)
    expected = left[:, :4] * sizes[:4] @ right[:4]
    basis = forward_model._BASIS
    np.testing.assert_allclose(basis @ basis.T, expected, rtol=1e-9, atol=1e-12)
    # Four terms hold all but a hundredth of it, and the mean is that of the model's readings.
    assert np.trace(expected) > 0.99 * np.trace(covariance)


def test_a_correction_changes_by_a_factor_of_e_to_the_half_at_most():
    plain = uncorrected(problem_of(photo()))
    slope = tuple(one.at[0, 0, 0].set(1.0) for one in plain.slope)
    correction = type(plain)(**{**vars(plain), "slope": slope})
    for move, expected in ((1e-3, 1e-3), (0.25, 0.5 * math.tanh(0.5)), (1e3, 0.5)):
        x = correction.about.at[0].add(move)
        factor = float(correction.factor(0, x)[0, 0])
        assert math.log(factor) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("excess", "counts"), [(2.9, False), (3.1, True), (8.0, True)])
def test_the_birge_ratio_counts_from_three_deviations_of_chi_squared(excess, counts):
    """Of a linear problem: 18 readings, two unknowns, so 16 degrees of freedom of variance 2/16."""
    problem = problem_of(photo())
    rng = np.random.default_rng(1)
    slope = np.linalg.qr(rng.standard_normal((18, 2)))[0]
    noise = rng.standard_normal(18)
    noise -= slope @ (slope.T @ noise)
    square = 1.0 + excess * math.sqrt(2.0 / 16.0)
    noise *= math.sqrt(16.0 * square / np.sum(noise**2))
    optimum = Optimum(
        jnp.zeros(2), jnp.asarray(noise), jnp.asarray(slope), jnp.zeros((), jnp.int32)
    )
    ratio, reduced = photo_fits.birge_ratio(problem, optimum, np.eye(2))
    assert ratio == pytest.approx(math.sqrt(square) if counts else 1.0, rel=1e-9)
    assert reduced == pytest.approx(16.0 * square / 18.0, rel=1e-9)
