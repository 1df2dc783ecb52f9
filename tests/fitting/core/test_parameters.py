"""Unknowns of a fit: transforms, priors, and the water they describe."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from fitting import Identity, Log, Logit, Parameter
from fitting.core.parameters import Parameters
from fitting.water_model.layered_water import layer_unknowns
from fitting.water_model.unknowns import constituents, shape_nuisances, water_iops

WAVELENGTH = oi.spectrum.bands(8)
NAMES = ("chlorophyll", "cdom", "detritus")


@pytest.mark.parametrize(
    ("transform", "values"),
    [
        (Identity(), (-3.0, 0.0, 1e-9, 7.0)),
        (Log(), (1e-12, 0.3, 1.0, 4e5)),
        (Logit(-1.0, 3.0), (-0.999, 0.0, 1.0, 2.9999)),
    ],
    ids=["identity", "log", "logit"],
)
def test_transforms_return_what_went_in(transform, values):
    for value in values:
        x = transform.coordinate(value)
        assert transform.physical(np.float64(x)) == pytest.approx(value, rel=1e-12, abs=1e-12)
        assert float(transform.physical(jnp.asarray(x))) == pytest.approx(value, rel=1e-12)
        single = transform.physical(jnp.asarray(x, jnp.float32))
        assert single.dtype == jnp.float32
        assert float(single) == pytest.approx(value, rel=3e-6, abs=1e-6)


@pytest.mark.parametrize("transform", [Identity(), Log(), Logit(0.1, 0.9)])
def test_transforms_rise_and_their_slopes_match_differences(transform):
    x = jnp.asarray([-2.0, -0.1, 0.0, 1.5])
    slope = jax.vmap(jax.grad(transform.physical))(x)
    step = 1e-6
    difference = (transform.physical(x + step) - transform.physical(x - step)) / (2 * step)
    assert np.all(np.asarray(slope) > 0)
    np.testing.assert_allclose(slope, difference, rtol=1e-8)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_log_parameter_stays_finite_wherever_the_search_looks(dtype):
    for x in (-1e4, 1e4):
        value, slope = jax.value_and_grad(Log().physical)(jnp.asarray(x, dtype))
        assert jnp.isfinite(value)
        assert value > 0
        assert jnp.isfinite(slope)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Parameter("cdom", 0.0), "must be positive"),
        (lambda: Parameter("cdom", -0.1), "must be positive"),
        (lambda: Parameter("cdom", 0.1, 0.0), "spread of cdom must be positive"),
        (lambda: Parameter("share", 2.0, None, Logit(0.0, 1.0)), "not between 0 and 1"),
        (lambda: Parameters([Parameter("cdom", 0.1)] * 2), "names must differ: cdom, cdom"),
    ],
)
def test_bad_parameters_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_an_unknown_name_is_answered_with_near_ones():
    parameters = Parameters([*constituents(), *shape_nuisances()])
    with pytest.raises(ValueError, match=r"'detritis'.*detritus"):
        parameters.replace({"detritis": Parameter("detritis", 0.1)})


def test_unknowns_of_layers_know_their_layer():
    found = {p.name: (p.kind, p.layer) for p in layer_unknowns([8.0, 12.0], 40.0)}
    for layer in (1, 2, 3):
        assert found[f"chlorophyll_{layer}"] == ("chlorophyll", layer)
    assert found["thickness_2"] == ("thickness", 2)
    assert "thickness_3" not in found
    assert found["cdom_slope"] == ("cdom_slope", None)


def test_priors_can_be_exchanged_by_name():
    known = Parameter("cdom", 0.12, 0.1)
    before = Parameters([*constituents(), *shape_nuisances()])
    after = before.replace({"cdom": known})
    assert after.names == before.names
    assert after[1] == known
    # What replaces an unknown of a layer belongs to that layer.
    layered = Parameters(layer_unknowns([8.0], 40.0)).replace({"cdom_2": Parameter("cdom_2", 0.1)})
    assert [(p.kind, p.layer) for p in layered if p.name == "cdom_2"] == [("cdom", 2)]
    assert after[0] is before[0]


def test_prior_counts_spreads_and_leaves_flat_parameters_free():
    parameters = Parameters(
        [
            Parameter("a", 2.0, 0.5),
            Parameter("b", 3.0, None),
            Parameter("c", -1.0, 4.0, Identity()),
        ]
    )
    prior = parameters.prior()
    np.testing.assert_allclose(prior.centre, [np.log(2), np.log(3), -1.0])
    np.testing.assert_allclose(prior.scale, [0.5, 1.0, 4.0])
    np.testing.assert_allclose(prior.residual(prior.centre), 0.0)
    moved = prior.residual(prior.centre + jnp.asarray([1.0, 9.0, -2.0]))
    np.testing.assert_allclose(moved, [2.0, 0.0, -0.5])
    values = parameters.values(prior.centre)
    assert {k: pytest.approx(float(v)) for k, v in values.items()} == {"a": 2.0, "b": 3.0, "c": -1}


def test_the_layout_forgets_numbers_so_that_programs_are_shared():
    first = Parameters([Parameter("a", 2.0, 0.5), Parameter("b", 1.0, None, Logit(0.0, 4.0))])
    second = Parameters([Parameter("a", 7.0, None), Parameter("b", 3.0, 2.0, Logit(0.0, 4.0))])
    other = Parameters([Parameter("a", 2.0), Parameter("b", 1.0, None, Logit(0.0, 5.0))])
    assert first.layout() == second.layout()
    assert hash(first.layout()) == hash(second.layout())
    assert first.layout() != other.layout()
    x = jnp.asarray([0.3, -0.2])
    assert first.layout().values(x) == first.values(x)


def test_nuisances_at_their_centres_are_the_default_model_but_for_two_slopes():
    amounts = {"chlorophyll": 1.5, "cdom": 0.15, "detritus": 0.08}
    values = {n: jnp.asarray(v) for n, v in amounts.items()}
    for p in shape_nuisances():
        # Fits start half-way between published slopes; the model keeps those of its sources.
        if not p.name.endswith("_exponent"):
            values[p.name] = jnp.asarray(p.centre)
    ours = water_iops(values, WAVELENGTH)
    default = oi.BioOpticalModel().iops(oi.Constituents(**amounts), WAVELENGTH)
    np.testing.assert_allclose(ours.a, default.a, rtol=1e-12)
    np.testing.assert_allclose(ours.b, default.b, rtol=1e-12)
    np.testing.assert_allclose(ours.bb, default.bb, rtol=1e-12)


@pytest.mark.parametrize("nuisance", shape_nuisances(), ids=lambda p: p.name)
def test_every_nuisance_moves_the_water_as_its_docstring_says(nuisance):
    amounts = {"chlorophyll": 1.5, "cdom": 0.15, "detritus": 0.08}
    values = {n: jnp.asarray(v) for n, v in amounts.items()}
    grid = np.array([400.0, 440.0, 550.0, 650.0])
    before = water_iops(values | {nuisance.name: jnp.asarray(nuisance.centre)}, grid)
    after = water_iops(values | {nuisance.name: jnp.asarray(1.1 * nuisance.centre)}, grid)
    a = np.asarray(after.a - before.a)
    b = np.asarray(after.b - before.b)
    bb = np.asarray(after.bb - before.bb)
    phytoplankton = 0.30 * 1.5**0.62
    away = (grid - np.array({"cdom_slope": 440.0}.get(nuisance.name, 400.0))) / 100
    expected = {
        "detritus_scattering_ratio": (0 * a, 0.08 * 0.5 * (400 / grid) ** 0.9),
        "cdom_slope": (0.15 * (np.exp(-1.936 * away) - np.exp(-1.76 * away)), 0 * b),
        "detritus_slope": (0.08 * (np.exp(-1.353 * away) - np.exp(-1.23 * away)), 0 * b),
        "detritus_exponent": (0 * a, 0.4 * ((400 / grid) ** 0.66 - (400 / grid) ** 0.6)),
        "phytoplankton_exponent": (
            0 * a,
            phytoplankton * ((550 / grid) ** 0.55 - (550 / grid) ** 0.5),
        ),
        "phytoplankton_scattering": (0 * a, 0.1 * phytoplankton * 550 / grid),
        "backscatter": (0 * a, 0 * b),
    }
    if nuisance.name == "phytoplankton_absorption":
        alone = oi.bio_optics.Phytoplankton().absorption(jnp.asarray(1.5), grid)
        expected[nuisance.name] = (0.1 * np.asarray(alone), 0 * b)
    np.testing.assert_allclose(a, expected[nuisance.name][0], atol=1e-12)
    np.testing.assert_allclose(b, expected[nuisance.name][1], atol=1e-12)
    if nuisance.name == "backscatter":
        particles = 0.010 * phytoplankton * 550 / grid + 0.018 * 0.4 * (400 / grid) ** 0.9
        np.testing.assert_allclose(bb, 0.1 * particles, rtol=2e-3)


def test_wavelengths_beyond_the_table_use_the_named_extension():
    values = {n: jnp.asarray(0.5) for n in NAMES}
    wide = water_iops(values, np.array([390.0, 450.0, 720.0]))
    assert np.all(np.isfinite(np.asarray(wide.a)))
    inside = water_iops(values, np.array([450.0, 500.0]))
    np.testing.assert_allclose(wide.a[1], inside.a[0], rtol=1e-12)
