"""What readings of absorption, attenuation and reflectance are worth in a search."""

import numpy as np
import pytest

import oceaninv as oi
from fitting import Profile
from fitting.core.result import Quantity
from fitting.profile.constituents import reduced_data

DEPTH = np.linspace(0.5, 10.0, 20)
BEAM = np.array([412.0, 532.0, 676.0])


def profile(a, c=None):
    light = np.exp(-0.2 * DEPTH)[:, None]
    return Profile(DEPTH, np.array([490.0]), light, a=a, c=c, beam_wavelength=BEAM)


@pytest.mark.parametrize("value", [0.0, 0.05, 0.3, 4.0])
def test_a_steady_reading_is_known_to_three_percent_and_five_thousandths(value):
    """AC-9: 0.005 1/m is what its calibration drifts by (Twardowski et al. 1999 give 0.003 to
    0.005), 3 % stands for the correction for scattered light."""
    table = np.full((20, 3), value)
    mean, weight = reduced_data.beam_of(profile(table, 2.0 * table), np.ones((20, 1), bool))
    np.testing.assert_allclose(mean, [[value] * 3, [2.0 * value] * 3], rtol=1e-12)
    sd = np.sqrt((0.03 * mean) ** 2 + 0.005**2)
    np.testing.assert_allclose(1.0 / weight, sd, rtol=1e-9)


def test_a_scattered_reading_is_known_as_the_mean_of_its_samples():
    """Scatter of means of simulated samples, against the deviation that each states."""
    rng = np.random.default_rng(0)
    means, stated = [], []
    for _ in range(400):
        table = 0.4 + 0.2 * rng.standard_normal((20, 3))
        mean, weight = reduced_data.beam_of(profile(table), np.ones((20, 1), bool))
        means.append(mean[0])
        stated.append(weight[0] ** -2.0)
        assert np.all(weight[1] == 0.0)  # no c
    calibration = (0.03 * 0.4) ** 2 + 0.005**2
    noise = np.mean(stated) - calibration
    # 1,200 means: their variance is known to 4 %.
    assert noise / np.var(means) == pytest.approx(1.0, abs=0.08)
    assert noise / (0.2**2 / 20) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(
    ("transport", "error"),
    [(oi.TwoStream(), 0.1), (oi.FourStream(), 0.05), (oi.PlaneParallel(), 0.02)],
)
def test_reflectance_is_known_as_well_as_the_transport_computes_it(transport, error):
    """10 % by two streams, 5 % by four, 2 % for the scene where the transport is exact."""
    R = Quantity(np.array([0.02, 0.05, np.nan]), np.array([0.0, 0.08, 0.1]), "1", "")
    ln_r, weight = reduced_data.reflected(R, 3, transport)
    np.testing.assert_allclose(np.exp(ln_r[:2]), [0.02, 0.05], rtol=1e-12)
    expected = [error**-2, 1.0 / (0.08**2 + error**2), 0.0]
    np.testing.assert_allclose(weight**2, expected, rtol=1e-12)
