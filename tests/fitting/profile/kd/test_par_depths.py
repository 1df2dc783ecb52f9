"""Which bands make PAR, and how deep a PAR sensor is believed."""

import numpy as np
import pytest

from fitting import Profile
from fitting.profile.kd.par_depths import light_of_sensor, photon_weights


@pytest.mark.parametrize(
    ("bands", "enough"),
    [
        ((430.0, 500.0, 580.0, 650.0), True),
        ((431.0, 500.0, 580.0, 650.0), False),
        ((430.0, 500.0, 580.0, 649.0), False),
        ((430.0, 500.0, 581.0, 650.0), False),
        ((390.0, 500.0, 580.0, 650.0), False),
    ],
)
def test_bands_span_photosynthesis_without_a_gap_of_eighty_nanometres(bands, enough):
    assert (photon_weights(np.array(bands)) is not None) == enough


def test_a_photon_counts_by_planck_avogadro_and_light():
    """umol of 1 W m-2 nm-1 from 400 to 700 nm, by the constants of the SI."""
    energy = 6.62607015e-34 * 299_792_458.0 * 6.02214076e23
    expected = 1e6 * 0.5 * (700.0**2 - 400.0**2) * 1e-9 / energy
    weights = photon_weights(np.arange(400.0, 701.0, 25.0))
    assert weights is not None
    assert weights.sum() == pytest.approx(expected, rel=1e-5)


def test_a_sensor_is_believed_down_to_half_a_percent_of_the_light():
    depth = np.linspace(0.0, 40.0, 801)
    light = np.exp(-0.2 * depth)
    profile = Profile(depth, np.array([490.0]), light[:, None], PAR=1000.0 * light)
    found = light_of_sensor(profile)
    assert found is not None
    # A running median of nine samples from the fifth sample on, 0.05 m apart.
    assert found.deepest == pytest.approx(np.log(200.0) / 0.2, abs=0.25)
