"""Upward light and the light above: K, reflectances at the surface, depths of PAR."""

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy.stats import binom

from fitting import Profile, fit_profile, fit_profiles
from fitting.commands import main as cli
from fitting.files.cast_file import Reading, read_cast
from fitting.profile.kd.par_depths import light_of_sensor, light_quantities, photon_weights
from fitting.profile.kd.reflectances import _reflected
from oceaninv.foundation.interface_optics import fresnel_from_air
from tests.fitting.synthetic_casts import ED_BELOW, LU_BELOW, write_turbid_cast

BANDS = np.array([412.0, 490.0, 555.0])
DEPTH = np.linspace(0.4, 12.0, 40)
KD, KU, KLU = np.array([[0.2, 0.1, 0.15], [0.21, 0.11, 0.16], [0.22, 0.12, 0.17]])
ED, EU, LU = np.array([[0.9, 1.2, 1.1], [0.02, 0.03, 0.025], [0.005, 0.007, 0.006]])
ES = np.array([0.95, 1.25, 1.15])
LEAVING = (1 - (0.34 / 2.34) ** 2) / 1.34**2


def cast(noise=0.0, seed=0, below=0.3, **changes):
    """Upward sensors hang 0.3 m below that of Ed; noise multiplies."""
    rng = np.random.default_rng(seed)

    def light(surface, k, depth):
        clean = surface * np.exp(-k * depth[:, None])
        return clean * (1 + noise * rng.standard_normal(clean.shape))

    data = {
        "Ed": light(ED, KD, DEPTH),
        "Eu": light(EU, KU, DEPTH + below),
        "Lu": light(LU, KLU, DEPTH + below),
        "surface": np.tile(ES, (len(DEPTH), 1)),
    }
    return Profile(DEPTH, BANDS, **(data | changes), upward_below=below)


def test_upward_light_without_noise_is_exact():
    fit = fit_profile(cast())
    found = {name: quantity.value for name, quantity in fit.quantities.items()}
    for name, value in (
        ("Kd", KD),
        ("Ku", KU),
        ("KLu", KLU),
        ("Ed_0", ED),
        ("Eu_0", EU),
        ("Lu_0", LU),
        ("R", EU / ED),
        ("Rrs", LEAVING * LU / ES),
    ):
        np.testing.assert_allclose(found[name], value, rtol=1e-5, err_msg=name)
    # ASTM G173's sun outside the atmosphere, W m-2 nm-1 near these bands.
    np.testing.assert_allclose(found["nLw"] / found["Rrs"], [1.75, 1.95, 1.88], rtol=0.06)


def test_without_light_above_rrs_comes_from_below():
    fit = fit_profile(cast(surface=None, solar_zenith=30.0))
    assert fit.metadata["light_above"] == "from Ed(0-) through a flat surface"
    above = (ED - 0.48 * EU) / (1 - 0.7 * _reflected(30.0) - 0.3 * 0.066)
    np.testing.assert_allclose(fit.quantities["Rrs"].value, LEAVING * LU / above, rtol=1e-5)
    assert np.all(fit.quantities["Rrs"].sd >= 0.02)
    assert "R" not in fit_profile(cast(Eu=None)).quantities
    assert set(fit_profile(cast(Eu=None, Lu=None)).quantities) == {"Kd", "Ed_0"}


def test_the_surface_reflects_as_fresnel_says():
    angles = np.array([0.0, 30.0, 60.0])
    exact = fresnel_from_air(jnp.cos(jnp.deg2rad(jnp.asarray(angles))), 1.34)
    np.testing.assert_allclose([_reflected(a) for a in angles], exact, rtol=1e-12)


def test_intervals_of_reflectances_cover():
    fits = fit_profiles([cast(0.05, seed) for seed in range(60)])
    data = fits.to_xarray()
    for name, truth in (("R", EU / ED), ("Rrs", LEAVING * LU / ES), ("KLu", KLU), ("Lu_0", LU)):
        inside = (data[f"{name}_low"] <= truth) & (truth <= data[f"{name}_high"])
        # 180 bands, the noise of each its own; a little too wide, as the waves might be correlated.
        low = binom.ppf(0.005, 180, 0.95) / 180
        assert low <= float(inside.mean()) < 0.99, name
    one = fits[3]
    np.testing.assert_allclose(data.Rrs[3], one.quantities["Rrs"].value)
    alone = fit_profile(cast(0.05, 3))
    np.testing.assert_allclose(one.quantities["R"].sd, alone.quantities["R"].sd, rtol=1e-9)


def test_bands_without_upward_light_are_left_out():
    dim = cast().Lu
    assert dim is not None
    dim = np.where(np.arange(3) == 1, np.nan, dim)
    fit = fit_profile(cast(Lu=dim))
    assert np.isnan(fit.quantities["Rrs"].value).tolist() == [False, True, False]
    assert "Rrs" not in fit_profile(cast(Lu=np.full_like(dim, np.nan))).quantities


def test_par_as_measured_reaches_its_depths():
    par = 800.0 * np.exp(-0.3 * DEPTH)
    fit = fit_profile(cast(PAR=par))
    assert fit.quantities["PAR_0"].value == pytest.approx(800.0, rel=1e-6)
    assert fit.quantities["Z_10"].value == pytest.approx(np.log(10.0) / 0.3, rel=1e-6)
    assert fit.quantities["Z_eu"].value == pytest.approx(np.log(100.0) / 0.3, rel=1e-6)
    assert "extrapolated below" in fit.metadata["PAR_depths"]["Z_eu"]
    inside, count = 0, 40
    for seed in range(count):
        noise = 1 + 0.05 * np.random.default_rng(seed).standard_normal(len(DEPTH))
        bent = par * np.exp(0.1 * np.maximum(DEPTH - 5.0, 0.0))
        light = light_of_sensor(cast(PAR=bent * noise))
        assert light is not None
        low, high = light_quantities(light, True, None)[0]["Z_10"].interval()
        inside += low <= 5.0 + (np.log(10.0) - 1.5) / 0.2 <= high
    # The place of the bend is taken as known, which the interval does not hold.
    assert binom.ppf(0.005, count, 0.9) <= inside <= count


def test_par_from_bands_is_the_integral_of_photons():
    bands = np.arange(400.0, 701.0, 20.0)
    kd = 0.04 + 0.4 * ((bands - 450.0) / 250.0) ** 2
    sun = 1.5 - 0.001 * (bands - 400.0)
    profile = Profile(DEPTH, bands, sun * np.exp(-kd * DEPTH[:, None]))
    fit = fit_profile(profile, depth_range=(0.0, 12.0))

    def photons(depth):
        # h c N_A = 0.119626566 J m/mol.
        grid = np.linspace(400.0, 700.0, 3001)
        light = np.interp(grid, bands, sun * np.exp(-kd * depth))
        return np.trapezoid(light * grid * 1e-9 / 0.119626566e-6, grid)

    assert fit.quantities["PAR_0"].value == pytest.approx(photons(0.0), rel=1e-4)
    for name, share in (("Z_10", 0.1), ("Z_eu", 0.01)):
        depth = float(fit.quantities[name].value)
        assert photons(depth) == pytest.approx(share * photons(0.0), rel=1e-3)
    # Where all bands err together by 1 %, so does the depth: the deviation is that of one band.
    weights = photon_weights(bands)
    assert weights is not None
    assert photon_weights(BANDS) is None
    assert photon_weights(np.array([412.0, 443.0, 490.0, 665.0])) is None


def test_the_reflectance_of_a_turbid_cast_is_the_true_one(tmp_path):
    truth = write_turbid_cast(tmp_path)
    units = {"Ed": "uW cm-2 nm-1", "Lu": "uW cm-2 nm-1 sr-1", "surface": "uW cm-2 nm-1"}
    reading = Reading(units=units, depth_offset=ED_BELOW, upward_offset=LU_BELOW)
    profile = read_cast(truth.path, reading)
    np.testing.assert_allclose(profile.Es, truth.Es, rtol=0.002)
    fit = fit_profile(profile, depth_range=(1.0, 8.0))
    rrs = fit.quantities["Rrs"]
    # Bands of visible light; measured: 0.37 % at most, and 0.14 % for KLu.
    lit = slice(profile.wavelength.tolist().index(443), profile.wavelength.tolist().index(694))
    np.testing.assert_allclose(rrs.value[lit], truth.Rrs[lit], rtol=0.005)
    low, high = rrs.interval(0.95)
    assert np.all((low[lit] < truth.Rrs[lit]) & (truth.Rrs[lit] < high[lit]))
    np.testing.assert_allclose(fit.quantities["KLu"].value[lit], truth.KLu[lit], rtol=0.002)
    # Without the offset of the radiance sensor, Rrs is too low by exp(-KLu 0.34 m).
    wrong = read_cast(truth.path, Reading(units=units, depth_offset=ED_BELOW))
    shifted = fit_profile(wrong, depth_range=(1.0, 8.0)).quantities["Rrs"].value
    expected = truth.Rrs * np.exp(-truth.KLu * (LU_BELOW - ED_BELOW))
    np.testing.assert_allclose(shifted[lit], expected[lit], rtol=0.005)


def test_the_command_writes_upward_light(tmp_path):
    path = tmp_path / "cast.csv"
    profile = cast(0.02)
    names = [f"{kind}_{wl:g}" for kind in ("Ed", "Eu", "Lu", "Es") for wl in BANDS]
    above = np.tile(ES, (len(DEPTH), 1))
    table = np.hstack([getattr(profile, kind) for kind in ("Ed", "Eu", "Lu")] + [above])
    rows = [",".join(f"{v:.8g}" for v in (z, *row)) for z, row in zip(DEPTH, table, strict=True)]
    head = ",".join(["depth_m", *names])
    units = ", ".join(f"{kind}_*=W m-2 nm-1" for kind in ("Ed", "Eu", "Lu", "Es"))
    path.write_text("\n".join([f"# units: {units}", head, *rows]) + "\n")
    out = tmp_path / "out"
    command = ["fit-profile", str(path), "-o", str(out), "--kd-only", "--upward-offset", "0.3"]
    assert cli.run(command) == 0
    with xr.open_dataset(out.with_suffix(".nc")) as data:
        truth = LEAVING * LU / ES
        np.testing.assert_allclose(data.Rrs, truth, rtol=0.05)
        assert bool(np.all((data.Rrs_low < data.Rrs) & (data.Rrs < data.Rrs_high)))
        assert data.Rrs.attrs["units"] == "sr-1"
    assert out.with_suffix(".png").stat().st_size > 10_000
