"""What a fit takes for granted: the alternatives, and how answers move with them."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from fitting import Background, Chart, Photo, assumptions, fit_photo
from fitting.core.diagnostics import Status
from fitting.core.parameters import Parameters
from fitting.core.result import Fit, Predictive
from fitting.observations.photo import WAVELENGTH
from fitting.photo.forward_model import predict
from fitting.photo.problem import prepare
from fitting.water_model.alternatives import ALTERNATIVES, PREFIX
from fitting.water_model.quantities import water_quantities
from fitting.water_model.unknowns import water_iops

TRUTH = {"chlorophyll": 1.5, "cdom": 0.15, "detritus": 0.08}
SCALARS = ("Kd_490", "c_550", "a_cdm_440", "bb_550")
GREY = np.array([0.9, 0.5, 0.2, 0.08])


def water(**shares):
    values = {name: jnp.asarray(value) for name, value in TRUTH.items()}
    return water_iops(values | {PREFIX + n: jnp.asarray(s) for n, s in shares.items()}, WAVELENGTH)


@pytest.mark.parametrize("name", ALTERNATIVES)
def test_no_share_of_an_alternative_is_the_model_as_it_is(name):
    ours, same = water(), water(**{name: 0.0})
    for part in ("a", "b", "bb"):
        np.testing.assert_allclose(getattr(same, part), getattr(ours, part), rtol=1e-12)


@pytest.mark.parametrize("table", ["PopeFry1997", "WOPPv3", "SmithBaker1981"])
def test_the_whole_of_a_table_is_that_table(table):
    changed = water(**{f"a_w_{table}": 1.0})
    np.testing.assert_allclose(changed.a_components[0], oi.water.absorption(WAVELENGTH, table),
                               rtol=1e-12)  # fmt: skip
    np.testing.assert_array_equal(changed.a_components[1:], water().a_components[1:])


def test_scattering_of_pure_water_is_that_of_morel():
    changed = water(b_w_Morel1974=1.0)
    expected = oi.water.scattering(WAVELENGTH, "Morel1974")
    np.testing.assert_allclose(changed.b_components[0], expected, rtol=1e-12)


def test_one_spectrum_of_algae_has_the_shape_of_its_table():
    row = water().absorbers.index("chlorophyll")
    algae = np.asarray(water(algae_Sathyendranath1987=1.0).a_components[row])
    shape = oi.tables.load("Gutierrez2008").at(WAVELENGTH, "a_phytoplankton")
    np.testing.assert_allclose(algae / algae[0], shape / shape[0], rtol=1e-10)


def test_petzold_takes_the_place_of_particles_without_changing_b_or_bb():
    ours, changed = water(), water(phase_Petzold1972=1.0)
    np.testing.assert_allclose(changed.b, ours.b, rtol=1e-12)
    np.testing.assert_allclose(changed.bb, ours.bb, rtol=1e-9)
    assert np.all(np.asarray(changed.b_components) >= -1e-15)
    # As much as the backscattering allows: nearly half of what particles scatter.
    share = np.asarray(changed.b_components[-1]) / np.sum(np.asarray(ours.b_components[1:]), axis=0)
    assert np.all((share > 0.4) & (share < 1.0))


def test_backscattering_is_split_and_slanted():
    ours, split, slanted = water(), water(backscatter_split=1.0), water(backscatter_slant=1.0)
    # bb/b of algae 0.010 to 0.005, of detritus 0.018 to 0.025.
    of_algae = 0.30 * 1.5**0.62 * 550 / WAVELENGTH
    of_detritus = 5 * 0.08 * (400 / WAVELENGTH) ** 0.9
    np.testing.assert_allclose(split.bb - ours.bb, 0.0072 * of_detritus - 0.005 * of_algae,
                               atol=3e-5)  # fmt: skip
    particles = np.asarray(ours.bb) - 0.5 * np.asarray(ours.b_components[0])
    expected = particles * ((550 / WAVELENGTH) ** 0.5 - 1)
    np.testing.assert_allclose(slanted.bb - ours.bb, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(slanted.b, ours.b, rtol=1e-12)


def photo(values=None):
    values = np.ones((9, 3)) if values is None else values
    charts = [Chart(values[4 * k : 4 * k + 4], GREY, r) for k, r in enumerate((1.0, 3.0))]
    response = oi.spectrum.camera_response("Nikon D850")
    return Photo(charts, [Background(values[8:])], depth=5.0, response=response)


@functools.cache
def fitted(name=None):
    """A fit of readings without noise of water that is like the alternative; its true answers."""
    parameters, (readings,), sunlight = prepare([photo()], oi.TwoStream())
    values = {p.name: jnp.asarray(p.centre) for p in parameters}
    values |= {n: jnp.asarray(v) for n, v in TRUTH.items()}
    values |= {} if name is None else {PREFIX + name: jnp.asarray(1.0)}
    true = water_quantities(values, WAVELENGTH, oi.TwoStream())
    readings = np.asarray(predict(values, readings, oi.TwoStream(), sunlight))
    return fit_photo(photo(readings)), np.log([*(float(true[n]) for n in SCALARS), *TRUTH.values()])


def off(name=None):
    """Errors of ln answers in standard deviations, modes."""
    fit, true = fitted(name)
    found = [np.log(float(fit.quantities[n].value)) for n in SCALARS]
    found += [fit.x[fit.parameters.names.index(n)] for n in TRUTH]
    sd = [*(float(fit.quantities[n].sd) for n in SCALARS), *(fit.sd[n] for n in TRUTH)]
    return (np.array(found) - true), np.array(sd)


@pytest.mark.slow
def test_answers_err_as_the_row_of_what_does_not_hold_says():
    table = assumptions(fitted()[0])
    plain, sd = off()
    rows = {n: np.array([table[q][n] for q in (*SCALARS, *TRUTH)]) / sd for n in ALTERNATIVES}
    told = []
    for name, row in rows.items():
        away = (off(name)[0] - plain) / sd
        # Another model's error is the opposite of how the answer would move with it.
        assert np.max(np.abs(away + row)) < 0.1 + 0.3 * np.max(np.abs(row))
        near = {n: abs(away @ r) / np.linalg.norm(r) for n, r in rows.items()}
        if np.linalg.norm(away) > 0.1:
            told.append(name)
            assert near[name] > 0.9 * max(near.values())
    assert len(told) >= 4


def test_only_photographs_have_these_assumptions():
    found = Predictive(np.ones(1), np.ones(1), np.ones(1), ("reading",), "1")
    fit = Fit(
        Parameters([]), np.zeros(0), np.zeros((0, 0)), {}, WAVELENGTH, Status.CONVERGED, found, {}
    )
    with pytest.raises(ValueError, match="need a fit of photographs"):
        assumptions(fit)
