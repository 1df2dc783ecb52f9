"""Photographs: checks on the way in, fits that return the truth, sensitivities."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import oceaninv as oi
from fitting import (
    Background,
    Board,
    Chart,
    Parameter,
    Photo,
    Pixels,
    design,
    fit_photo,
    fit_photos,
)
from fitting.core import jaxopt_solver
from fitting.core.least_squares import covariance
from fitting.observations.photo import WAVELENGTH
from fitting.photo.forward_model import predict
from fitting.photo.problem import _unknowns, photo_residual, prepare
from fitting.water_model.quantities import water_quantities
from fitting.water_model.unknowns import water_iops
from oceaninv.transport.closed_form._two_moment_field import DeltaScaledWater

GREY = np.array([0.9, 0.5, 0.2, 0.08])
TRUTH = {"chlorophyll": 1.5, "cdom": 0.15, "detritus": 0.08}
CAMERA = "Nikon D850"
# Too small to hide water or to shine past itself: `test_surroundings.py` tests larger ones.
POINT = Board(1e-6, 1e-6, size_sd=0.0)


def photo(values=None, sigma=0.01, board=POINT, **changes):
    """Four grey patches at two ranges and open water; readings of 1 unless given (reading, 3)."""
    values = np.ones((9, 3)) if values is None else values
    arguments = {"depth": 5.0, "response": oi.spectrum.camera_response(CAMERA)} | changes
    charts = [
        Chart(part, GREY, r, sigma * np.abs(part), board=board)
        for r, part in ((1.0, values[:4]), (3.0, values[4:8]))
    ]
    return Photo(charts, [Background(values[8:], sigma=sigma * np.abs(values[8:]))], **arguments)


def water(wavelength):
    """The true water: the default model with the spectral slopes that fits start from."""
    model = oi.BioOpticalModel(
        (
            oi.bio_optics.Phytoplankton(exponent=0.5),
            oi.bio_optics.CDOM(),
            oi.bio_optics.Detritus(exponent=0.6),
        )
    )
    return model.iops(oi.Constituents(**TRUTH), wavelength)


def seen(board=POINT, **changes):
    """Noise-free readings at the truth, nuisances at their centres but for `changes`; and its
    quantities."""
    parameters, (readings,), sunlight = prepare([photo(board=board)], oi.TwoStream())
    values = {p.name: jnp.asarray(p.centre) for p in parameters}
    values |= {name: jnp.asarray(v) for name, v in (TRUTH | changes).items()}
    values |= {"chart_0_0": jnp.asarray(1.3), "chart_0_1": jnp.asarray(0.6)}
    values |= {f"gain_0_{c}": jnp.asarray(g) for c, g in zip("RGB", (0.4, 0.2, 0.3), strict=True)}
    of_water = water_quantities(values, WAVELENGTH, oi.TwoStream())
    return np.asarray(predict(values, readings, oi.TwoStream(), sunlight)), of_water


@functools.cache
def clean():
    """Readings with nuisances at their centres, gains and lights arbitrary."""
    return seen()[0]


def test_packaging_gives_algae_the_shape_of_another_chlorophyll():
    wavelength = np.array([412.0, 440.0, 550.0, 675.0])

    def absorption(chlorophyll, **changes):
        values = {"chlorophyll": jnp.asarray(chlorophyll)} | changes
        found = water_iops(values, wavelength)
        return np.asarray(found.a_components[found.absorbers.index("chlorophyll")])

    packaged = absorption(1.5, phytoplankton_package=jnp.asarray(2.0))
    ratio = packaged / absorption(3.0)
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-12)
    assert packaged[1] == pytest.approx(absorption(1.5)[1], rel=1e-12)
    assert packaged[2] > 1.2 * absorption(1.5)[2]


@functools.cache
def fitted():
    return fit_photo(photo(clean()))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Chart(np.ones((3, 3)), [0.1, 0.2], 1.0), r"one row per patch \(3\)"),
        (lambda: Chart(np.ones((2, 3)), [0.1, 1.7], 1.0), "must lie between 0 and 1.5"),
        (lambda: Chart(np.ones((2, 3)), [0.1, np.nan], 1.0), "must lie between 0 and 1.5"),
        (lambda: Chart(np.ones((2, 3)), [0.1, 0.2], 0.0), "distance of chart 'chart' must be posi"),
        (lambda: Chart(np.ones((2, 3)), [0.1, 0.2], np.nan, name="far"), "distance of chart 'far'"),
        (lambda: Chart(np.ones(3), [0.1, 0.2, 0.3], 1.0), "values must have 2 dimension"),
        (lambda: Chart(np.ones((2, 3)), [0.1, 0.2], 1.0, np.ones((2, 2))), "sigma of 'chart'"),
        (lambda: Chart(np.ones((2, 3)), [0.1, 0.2], 1.0, zenith=181.0), "between 0 and 180"),
        (lambda: Background(np.ones((2, 3)), zenith=-1.0), "zenith of 'background'"),
        (lambda: Photo([], [Background(np.ones((1, 4)))], depth=5.0), "has 4 channels"),
        (lambda: photo(depth=0.0), "depth must be positive metres, not 0"),
        (lambda: photo(solar_zenith=95.0), r"solar_zenith must lie in \[0, 90\) degrees, not 95"),
        (lambda: Photo(depth=5.0), "0 of 0 readings are usable"),
        (lambda: photo(np.full((9, 3), np.nan)), "0 of 27 readings are usable"),
        (lambda: photo(-np.ones((9, 3))), "0 of 27 readings are usable"),
    ],
)
def test_bad_input_is_a_sentence(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_unknowns_know_their_photograph_chart_and_channel():
    frames = [photo(), photo(exposure=0.01)]
    found = {p.name: p for p in _unknowns(frames, False)}
    places = {n: (p.kind, p.photograph, p.chart, p.channel) for n, p in found.items()}
    assert places["chart_1_0"] == ("chart", 1, 0, None)
    assert places["gain_0_R"] == ("gain", 0, None, "R")
    assert places["gain_B"] == ("gain", None, None, "B")
    assert places["exposure_1"] == ("exposure", 1, None, None)
    assert places["depth_1"] == ("depth", 1, None, None)
    assert places["veil_G"] == ("veil", None, None, "G")
    assert places["cdom"] == ("cdom", None, None, None)


def test_a_channel_without_readings_is_named():
    values = np.ones((9, 3))
    values[:, 2] = np.nan
    with pytest.raises(ValueError, match="photograph 0 has no usable reading in channel B"):
        fit_photo(photo(values))


def test_reflectances_must_be_on_the_fits_wavelengths():
    chart = Chart(np.ones((2, 3)), np.full((2, 7), 0.5), 1.0, name="card")
    with pytest.raises(ValueError, match="chart 'card' must be given at the 16 wavelengths"):
        fit_photo(Photo([chart], depth=5.0))


def test_unknown_names_are_answered_with_near_ones():
    with pytest.raises(ValueError, match=r"Nikon D85.*Nikon D850"):
        oi.spectrum.camera_response("Nikon D85")
    with pytest.raises(ValueError, match=r"'backscater'.*backscatter"):
        fit_photo(photo(clean()), priors={"backscater": Parameter("backscater", 1.0, 0.1)})


@pytest.mark.parametrize(("side", "exact"), [(1e-6, 1e-5), (0.2, 3e-3)])
def test_predicted_values_are_those_of_the_forward_chain(side, exact):
    # By the public front ends, written out, against `predict`.
    model = water(WAVELENGTH)
    sun = jnp.asarray(oi.spectrum.daylight(WAVELENGTH))
    scene = oi.Scene(model, oi.Light(40.0, sun), oi.FlatSurface())
    # Just above the horizon, as cos(90 degrees) is in floating point.
    across = np.array([[0.0, 1.0, -6e-17]])
    weights = np.asarray(oi.spectrum.camera_response(CAMERA).weights(WAVELENGTH))
    # An upright chart across the sun: 1.35 / 4 of the diffuse scalar irradiance, to the power that
    # its colour is assumed to have.
    mu0, beam = scene.beam()
    lost = DeltaScaledWater(model).attenuation.c_star
    field = oi.irradiance(scene, [5.0])
    around = np.asarray(field.E0.value)[0] - np.asarray(beam * jnp.exp(-lost * 5.0 / mu0))
    colour = around / np.asarray(field.Ed.value)[0]
    middle = np.argmin(np.abs(WAVELENGTH - 550.0))
    lit = 1.35 / 4 * around * (colour / colour[middle]) ** -0.25
    endless = oi.Rays(np.array([0.0, 0.0, 5.0]), across)
    water_seen = np.asarray(oi.radiance(scene, endless).value)[0]
    rows = []
    for r, light in ((1.0, 1.3), (3.0, 0.6)):
        # Patches that are not laid out are discs in the board's middle.
        half, at = jnp.asarray([side / 2]), jnp.asarray([r])
        board = np.asarray(oi.target_transmission(model, at, half, peak_width=1.5))[0]
        patch = np.asarray(oi.disc_transmission(model, at, 0.2 * half[None], 1.5))[0, 0]
        arriving = light * lit / np.pi
        behind = (1.0 - board) * water_seen
        rows += [(rho * patch + GREY.mean() * (board - patch)) * arriving + behind for rho in GREY]
    expected = np.stack([*rows, water_seen]) @ weights.T * np.array([0.4, 0.2, 0.3])
    # A board's rings are 10 steps, and its corners are counted by points.
    found = seen(Board(side, side, size_sd=0.0))[0]
    np.testing.assert_allclose(found, expected, rtol=exact)


def test_a_shifted_response_is_the_response_moved_to_the_red():
    from fitting.photo.forward_model import _shifted

    response = oi.spectrum.camera_response(CAMERA)
    still, moved = np.asarray(response.weights(WAVELENGTH)), np.asarray(_shifted(response, 2.0))
    samples = np.asarray(response.samples)
    exact = oi.spectrum.Response(response.values, samples + 2.0, response.channels)
    change = np.asarray(exact.weights(WAVELENGTH)) - still
    assert np.abs(moved - still - change).max() < 0.15 * np.abs(change).max()
    # Named by the photograph, it is one more nuisance.
    assert "response_shift" not in fitted().value
    names = prepare([photo(response_shift=2.0)], oi.TwoStream())[0].names
    assert "response_shift" in names
    with pytest.raises(ValueError, match="response_shift must lie"):
        photo(response_shift=-1.0)


def test_noise_free_readings_return_the_truth():
    fit = fitted()
    assert fit.converged
    # The weak priors of the constituents pull the mode by a small part of the uncertainty; values
    # are that less what the mode of noisy readings errs by on average.
    for name, value in TRUTH.items():
        i = fit.parameters.names.index(name)
        assert abs(fit.x[i] - np.log(value)) / fit.sd[name] < 0.35, name
        assert np.log(fit.value[name]) == pytest.approx(fit.x[i] - fit.bias[i])
        assert abs(fit.bias[i]) <= 0.5 * fit.sd[name]
    exact = water(np.array([440.0, 550.0]))
    c_550 = fit.quantities["c_550"]
    assert abs(np.log(float(c_550.value) / float(exact.c[1]))) < 0.2 * float(c_550.sd)
    assert float(c_550.sd) < 0.06
    cdm = float(exact.a_components[2, 0] + exact.a_components[3, 0])
    low, high = fit.quantities["a_cdm_440"].interval()
    assert low < cdm < high
    misfit = fit.posterior_predictive
    assert np.nanmax(np.abs(misfit.observed / misfit.predicted - 1)) < 2e-3


def test_a_photograph_does_not_claim_what_it_cannot_see():
    flags = fitted().identifiable
    # CDOM and detritus differ by the scattering of detritus alone, which only its prior knows.
    assert not flags["detritus"]
    assert not flags["detritus_scattering_ratio"]
    assert not flags["cdom_slope"]
    assert flags["gain_0_G"] == (fitted().sd["gain_0_G"] <= 0.5)


def test_readings_that_scatter_more_than_stated_widen_the_intervals():
    values = clean() * (1 + 0.04 * np.random.default_rng(0).standard_normal((9, 3)))
    fit = fit_photo(photo(values))
    factor = fit.noise_factor
    assert 2.5 < factor < 5.5
    assert fit.metadata["reduced_chi2"] > 4.0
    told = fit_photo(photo(values, sigma=0.01 * factor))
    assert told.noise_factor == fitted().noise_factor == 1.0
    for name in ("c_550", "Kd_490", "a_cdm_440"):
        ours, theirs = fit.quantities[name], told.quantities[name]
        assert abs(np.log(theirs.value / ours.value)) < 3e-3 * ours.sd
        assert theirs.sd == pytest.approx(ours.sd, rel=3e-3)
    assert fit.quantities["c_550"].sd > 2.0 * fitted().quantities["c_550"].sd


def test_exposure_and_white_balance_do_not_matter():
    other = fit_photo(photo(clean() * np.array([300.0, 0.02, 5.0])))
    for name in ("c_550", "Kd_490", "a_cdm_440"):
        ours, theirs = fitted().quantities[name], other.quantities[name]
        assert abs(np.log(theirs.value / ours.value)) < 1e-3 * ours.sd
        assert theirs.sd == pytest.approx(ours.sd, rel=1e-3)


def test_clipped_or_missing_readings_are_masked_and_counted():
    values = clean().copy()
    values[2, 1], values[5, 0], values[6, 2] = np.nan, 0.0, -1.0
    frame = photo(values)
    assert frame.masked == 3
    fit = fit_photo(frame)
    assert fit.metadata["masked_values"] == 3
    assert fit.metadata["readings"] == 24
    assert np.isnan(fit.posterior_predictive.observed[2, 1])
    ours = fitted().quantities["c_550"]
    assert abs(np.log(fit.quantities["c_550"].value / ours.value)) < 0.1 * ours.sd


def test_a_known_constituent_sharpens_the_rest():
    known = {"cdom": Parameter("cdom", TRUTH["cdom"], 0.02, unit="m-1")}
    fit = fit_photo(photo(clean()), priors=known)
    assert fit.sd["cdom"] < 0.021
    assert fit.value["cdom"] == pytest.approx(TRUTH["cdom"], rel=0.02)
    for name in ("a_cdm_440", "Kd_490"):
        assert fit.quantities[name].sd < fitted().quantities[name].sd


@pytest.mark.parametrize("nuisance", ["detritus_scattering_ratio", "veil_R", "veil_B"])
def test_the_sensitivity_table_is_what_moving_a_prior_does(nuisance):
    fit = fitted()
    old = next(p for p in fit.parameters if p.name == nuisance)
    # A tenth of a spread up and down: small enough to be linear.
    moved = []
    for share in (0.1, -0.1):
        centre = float(
            old.transform.physical(old.transform.coordinate(old.centre) + share * old.spread)
        )
        new = Parameter(nuisance, centre, old.spread, old.transform, old.unit, True)
        moved.append(fit_photo(photo(clean()), priors={nuisance: new}))
    for name in ("Kd_490", "c_550", "a_cdm_440"):
        up, down = (np.log(float(m.quantities[name].value)) for m in moved)
        said = fit.sensitivity[name][nuisance]
        assert (up - down) / 0.2 == pytest.approx(said, rel=0.1, abs=0.06 * fit.quantities[name].sd)
    for i, name in enumerate(("chlorophyll", "cdom", "detritus")):
        # It speaks of the mode: the correction for curvature moves, too.
        up, down = (m.x[i] for m in moved)
        said = fit.sensitivity[name][nuisance]
        assert (up - down) / 0.2 == pytest.approx(said, rel=0.1, abs=0.06 * fit.sd[name])


def _off(fit, of_water):
    """Errors of ln quantities and constituents in standard deviations, and what the table says of
    them by nuisance, likewise."""
    scalars = ("Kd_490", "c_550", "a_cdm_440", "bb_550")
    away = [np.log(fit.quantities[n].value / of_water[n]) for n in scalars]
    away += [fit.x[fit.parameters.names.index(n)] - np.log(v) for n, v in TRUTH.items()]
    sd = np.array([*(fitted().quantities[n].sd for n in scalars), *(fitted().sd[n] for n in TRUTH)])
    names = list(fit.sensitivity["Kd_490"])
    table = [[fitted().sensitivity[q][n] for n in names] for q in (*scalars, *TRUTH)]
    return np.array(away) / sd, dict(zip(names, (np.array(table) / sd[:, None]).T, strict=True))


@pytest.mark.parametrize(
    ("nuisance", "value"),
    [
        ("backscatter", 1.2),
        ("detritus_scattering_ratio", 6.0),
        ("detritus_slope", 0.0105),
        ("phytoplankton_absorption", 1.4),
        ("phytoplankton_scattering", 1.5),
    ],
)
def test_the_sensitivity_table_names_the_assumption_that_is_broken(nuisance, value):
    """Of all assumptions, the errors follow the row of the one that does not hold."""
    readings, of_water = seen(**{nuisance: value})
    fit = fit_photo(photo(readings))
    # Residuals say nothing: what does not hold is to be known from the table alone.
    assert fit.metadata["reduced_chi2"] < 0.2
    away, table = _off(fit, of_water)
    away = away - _off(fitted(), seen()[1])[0]
    near = {n: abs(away @ row) / max(np.linalg.norm(row), 1e-9) for n, row in table.items()}
    assert max(near, key=near.get) == nuisance
    assert near[nuisance] > 0.9 * np.linalg.norm(away)
    # And by as much as it says, to first order.
    known = next(p for p in fit.parameters if p.name == nuisance)
    there, centre = known.transform.coordinate(value), known.transform.coordinate(known.centre)
    said = -(there - centre) / known.spread * table[nuisance]
    assert np.max(np.abs(away - said)) < 0.25


@pytest.mark.slow
def test_another_library_reaches_the_same_optimum():
    noise = np.random.default_rng(0).standard_normal((9, 3))
    frame = photo(clean() * (1 + 0.01 * noise))
    fit = fit_photo(frame)
    parameters, readings, sunlight = prepare([frame], oi.TwoStream())
    residual = photo_residual(parameters, readings, oi.TwoStream(), sunlight)
    prior, values = parameters.prior(), tuple(r.values for r in readings)
    other = jax.jit(lambda x: jaxopt_solver.least_squares(residual, x, values, prior.scale, 2000))(
        prior.centre
    )
    assert int(other.code) == fit.status
    sd = np.sqrt(np.diag(fit.covariance))
    # Measured: 1e-6.
    assert np.max(np.abs(np.asarray(other.x) - fit.x) / sd) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [optx.Dogleg(1e-8, 1e-8), optx.BFGS(1e-9, 1e-9)],
    ids=lambda one: type(one).__name__,
)
def test_another_solver_ends_at_the_same_optimum(solver):
    noise = np.random.default_rng(0).standard_normal((9, 3))
    frame = photo(clean() * (1 + 0.01 * noise))
    fit, other = fit_photo(frame), fit_photo(frame, solver=solver)
    assert other.converged
    assert np.max(np.abs(other.x - fit.x) / np.sqrt(np.diag(fit.covariance))) < 1e-4


def test_what_is_no_solver_is_refused_in_a_sentence():
    with pytest.raises(TypeError, match="solver is 'BFGS'; give a least-squares solver"):
        fit_photo(photo(clean()), solver="BFGS")


def test_fitting_touches_no_configuration():
    before = jax.config.values.copy()
    fit_photo(photo(clean()))
    assert jax.config.values == before


@pytest.mark.slow
def test_an_ancillary_value_is_an_observation():
    """A known parameter or quantity pulls as one more reading: precisions add."""
    free = fitted()
    known = fit_photo(photo(clean()), know={"c_550": (float(free.quantities["c_550"].value), 0.01)})
    sd, stated = float(free.quantities["c_550"].sd), 0.01 / float(free.quantities["c_550"].value)
    assert float(known.quantities["c_550"].sd) == pytest.approx(
        1 / np.hypot(1 / sd, 1 / stated), rel=0.02
    )
    with pytest.raises(ValueError, match=r"'c_55'.*c_550"):
        fit_photo(photo(clean()), know={"c_55": (0.3, 0.01)})
    with pytest.raises(ValueError, match="both must be positive"):
        fit_photo(photo(clean()), know={"cdom": (0.1, 0.0)})


@pytest.mark.slow
def test_a_stray_patch_moves_a_robust_fit_less():
    values = clean().copy()
    values[1] *= 1.3
    away = {}
    for limit in (None, 2.0):
        fit = fit_photo(photo(values), robust=limit)
        away[limit] = abs(
            np.log(fit.quantities["Kd_490"].value / fitted().quantities["Kd_490"].value)
        )
    assert away[None] > 0.05
    assert away[2.0] < 0.1 * away[None]


@pytest.mark.slow
def test_a_plan_expects_what_the_fit_of_its_readings_states():
    """The uncertainty expected at the truth is that of the fit of clean readings of that truth."""
    # At the mode, where the fit takes its slopes; values are corrected for curvature.
    mode = zip(fitted().parameters, fitted().x, strict=True)
    truth = {p.name: float(p.transform.physical(x)) for p, x in mode if "gain" not in p.name}
    planned = design(photo(), truth, noise=0.01)
    for name in ("c_550", "Kd_490", "bb_550"):
        assert planned.quantities[name].sd == pytest.approx(fitted().quantities[name].sd, rel=0.02)
    # A plan is linear; a fit profiles over what is poorly determined.
    slope = jax.jit(jax.jacfwd(fitted().problem.residual))(jnp.asarray(fitted().x))
    i = planned.parameters.names.index("detritus")
    linear = np.sqrt(np.asarray(covariance(slope))[i, i])
    assert planned.sd["detritus"] == pytest.approx(linear, rel=0.02)
    assert fitted().sd["detritus"] > 0.99 * linear
    with pytest.raises(ValueError, match=r"'cdm'.*cdom"):
        design(photo(), {"cdm": 0.1})


@pytest.mark.slow
def test_a_batch_is_its_fits():
    # The second scatters more than stated: its noise is estimated, that of the first is not.
    scatter = 0.04 * np.random.default_rng(1).standard_normal((9, 3))
    frames = [photo(clean()), photo(clean() * (1.02 + scatter))]
    both = fit_photos(frames)
    for frame, one in zip(frames, both, strict=True):
        alone = fit_photo(frame)
        factor = alone.noise_factor
        assert one.noise_factor == pytest.approx(factor, rel=1e-2)
        assert (factor > 2.0) is (frame is frames[1])
        assert np.max(np.abs(one.x - alone.x) / np.sqrt(np.diag(alone.covariance))) < 0.01
    with pytest.raises(ValueError, match="photograph 1 differs"):
        fit_photos([frames[0], Photo(frames[0].charts, depth=5.0)])


def scenery(count, seed=0):
    """Pixels of a reef at 1-6 m in the true water, reflectances from the fit's own prior: their
    mean is lost as that of an endless board, differences as those of discs of 0.03 of the range."""
    from fitting.photo.forward_model import _ALBEDO, _BASIS, ALBEDO_TERMS

    rng = np.random.default_rng(seed)
    sun = jnp.asarray(oi.spectrum.daylight(WAVELENGTH))
    model = water(WAVELENGTH)
    scene = oi.Scene(model, oi.Light(40.0, sun), oi.FlatSurface())
    spacing = np.linspace(1.0, 6.0, 12)
    distance = np.repeat(spacing, -(-count // 12))[:count]
    across = np.tile([[0.0, 1.0, -6e-17]], (12, 1))
    ahead = oi.radiance(scene, oi.Rays(np.array([0.0, 0.0, 5.0]), across)).value
    whole = np.exp(-np.asarray(model.a + model.bb)[None] * spacing[:, None])
    veil = (1.0 - whole) * np.asarray(ahead)
    lit = np.asarray(oi.irradiance(scene, [5.0]).Ed.value)[0] / np.pi
    which = np.searchsorted(spacing, distance)
    change = rng.standard_normal((count, ALBEDO_TERMS)) @ _BASIS.T
    sizes = jnp.asarray(0.03 * spacing[:, None])
    part = np.asarray(oi.disc_transmission(model, jnp.asarray(spacing), sizes, 1.5))[:, 0]
    weights = np.asarray(oi.spectrum.camera_response(CAMERA).weights(WAVELENGTH))
    values = (lit * (_ALBEDO * whole[which] + change * part[which]) + veil[which]) @ weights.T
    return np.maximum(values * (1 + 0.03 * rng.standard_normal(values.shape)), 1e-6), distance


@pytest.mark.slow
def test_pixels_of_unknown_reflectance_measure_attenuation():
    """1500 surfaces in 3000 pixels, with the forward peak known: c within its interval, far better
    known than a priori."""
    values, distance = scenery(3000)
    frame = Photo((), (), Pixels(values, distance, 1500.0), depth=5.0,
                  response=oi.spectrum.camera_response(CAMERA))  # fmt: skip
    fit = fit_photo(frame, know={"peak_width": (1.5, 0.1)})
    assert fit.converged
    exact = water(np.array([550.0]))
    low, high = fit.quantities["c_550"].interval(0.99)
    assert low < float(exact.c[0]) < high
    assert fit.quantities["c_550"].sd < 0.2
