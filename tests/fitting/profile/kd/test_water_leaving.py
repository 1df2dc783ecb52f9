"""Light across the surface: the constants of remote sensing reflectance, from first principles."""

import numpy as np
import pvlib
import pytest

from fitting import Profile, fit_profile
from fitting.profile.kd import cast as kd_cast

# One between the whole nanometres at which the sun is tabulated.
BANDS = np.array([412.7, 490.0, 555.0])
DEPTH = np.linspace(0.4, 12.0, 40)
KD, KLU = np.array([[0.2, 0.1, 0.15], [0.22, 0.12, 0.17]])
ED, LU = np.array([[0.9, 1.2, 1.1], [0.005, 0.007, 0.006]])
INDEX = 1.34


def fresnel(outside, index):
    """Reflectance of unpolarised light at the cosine `outside` in the medium of index 1."""
    inside = np.sqrt(np.maximum(1.0 - (1.0 - outside**2) / index**2, 0.0))
    across = (outside - index * inside) / (outside + index * inside)
    along = (index * outside - inside) / (index * outside + inside)
    return 0.5 * (across**2 + along**2)


def diffuse(index):
    """Share of uniform radiance that a surface to a medium of `index` throws back."""
    mu = (np.arange(200_000) + 0.5) / 200_000
    return 2.0 * np.mean(mu * fresnel(mu, index))


def leaving(**changes):
    """Fit of light without noise, no light above measured."""
    light = {
        "Ed": ED * np.exp(-KD * DEPTH[:, None]),
        "Lu": LU * np.exp(-KLU * DEPTH[:, None]),
    }
    return fit_profile(Profile(DEPTH, BANDS, **(light | changes)))


@pytest.mark.parametrize("zenith", [None, 20.0, 60.0])
def test_without_light_above_it_follows_from_the_light_below(zenith):
    """Ed(0-) = Es (1 - 0.7 F(sun) - 0.3 F(sky)) + F(below) Eu(0-): 30 % of the light is the sky's;
    Eu = 4 Lu, between pi of uniform radiance and the 5 of clear water; the sun at 40 degrees where
    it is not known."""
    fit = leaving() if zenith is None else leaving(solar_zenith=zenith)
    sun = fresnel(np.cos(np.radians(40.0 if zenith is None else zenith)), INDEX)
    above = (ED - diffuse(1 / INDEX) * 4.0 * LU) / (1 - 0.7 * sun - 0.3 * diffuse(INDEX))
    expected = LU * (1 - ((INDEX - 1) / (INDEX + 1)) ** 2) / INDEX**2 / above
    # Reflectances of uniform light are rounded to 0.066 and 0.48 there: 4.7e-4 in the result.
    np.testing.assert_allclose(fit.quantities["Rrs"].value, expected, rtol=5e-4)


def test_light_above_that_was_not_measured_costs_two_percent():
    """Beside the errors of Lu(0-) and Ed(0-), which are independent."""
    q = leaving().quantities
    extra = q["Rrs"].sd ** 2 - q["Lu_0"].sd ** 2 - q["Ed_0"].sd ** 2
    np.testing.assert_allclose(np.sqrt(extra), 0.02, rtol=1e-6)
    measured = leaving(surface=np.tile(1.1 * ED, (len(DEPTH), 1))).quantities
    exact = measured["Rrs"].sd ** 2 - measured["Lu_0"].sd ** 2
    np.testing.assert_allclose(exact, 0.0, atol=1e-15)


def test_normalized_radiance_is_that_under_the_sun_over_ten_nanometres():
    q = leaving().quantities
    table = pvlib.spectrum.get_reference_spectra()["extraterrestrial"]
    wavelength, sun = table.index.to_numpy(), table.to_numpy()
    for i, band in enumerate(BANDS):
        inside = np.abs(wavelength - band) <= 5.0
        expected = q["Rrs"].value[i] * sun[inside].mean()
        assert q["nLw"].value[i] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("share", "seen"), [(4.95, False), (5.05, True)])
def test_a_band_holds_light_where_five_samples_exceed_five_times_the_noise(share, seen):
    dark = np.full(40, 1e-3)
    light = np.where(np.arange(40) < 5, share * 1e-3, dark)
    light[:4] *= 2.0
    profile = Profile(DEPTH, BANDS[:1], light[:, None], floor=1e-3)
    window = kd_cast.FitWindow(profile, profile.mask, np.zeros(0))
    assert kd_cast.bands_with_light(window).tolist() == [seen]


def test_kd_is_of_the_water_above_the_ten_percent_level():
    """Ten times darker than at the top: at ln 10 over Kd below the first sample, a running median
    of nine samples away from either end."""
    depth = np.linspace(0.0, 20.0, 401)
    profile = Profile(depth, BANDS[:1], np.exp(-0.2 * depth)[:, None])
    deepest = depth[kd_cast.light_level_mask(profile)[:, 0]].max()
    assert deepest == pytest.approx(np.log(10.0) / 0.2, abs=0.21)
