"""Photographs without their water, the page of a fit, the nearest water type."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import OpenImageIO as oiio
import pytest

import oceaninv as oi
from fitting import Background, Photo, Photograph, Quantity, fit_photo
from fitting.observations.photo import WAVELENGTH
from fitting.photo.restore import restore
from fitting.report.web_page import write_html
from fitting.water_model.quantities import nearest_jerlov
from tests.fitting.photo.test_fit_photo import CAMERA, clean, fitted, water


def scene():
    """Grey steps at 1-4 m in the true water by the front ends; their ranges and reflectances.

    Each is so large that its light is lost with a + bb, as that of what fills the view.
    """
    sun = jnp.asarray(oi.spectrum.daylight(WAVELENGTH))
    there = oi.Scene(water(WAVELENGTH), oi.Light(40.0, sun), oi.FlatSurface())
    distance = np.tile(np.linspace(1.0, 4.0, 12)[None], (10, 1))
    grey = np.tile(np.linspace(0.01, 0.9, 10)[:, None], (1, 12))
    across = np.tile([[0.0, 1.0, -6e-17]], (12, 1))
    ahead = np.asarray(oi.radiance(there, oi.Rays(np.array([0.0, 0.0, 5.0]), across)).value)
    lit = np.asarray(oi.irradiance(there, [5.0]).Ed.value)[0] / np.pi
    iops = water(WAVELENGTH)
    through = np.exp(-np.asarray(iops.a + iops.bb) * distance[0][:, None])
    spectra = grey[:, :, None] * (lit * through)[None] + ((1.0 - through) * ahead)[None]
    weights = np.asarray(oi.spectrum.camera_response(CAMERA).weights(WAVELENGTH))
    values = spectra @ weights.T * np.array([0.4, 0.2, 0.3])
    distance[0, 0] = np.nan
    return Photograph(values, values > 0, 0.0, 0.0, {}, "made"), distance, grey


@pytest.mark.slow
def test_the_water_comes_out_of_a_picture(tmp_path):
    picture, distance, grey = scene()
    found = restore(fitted(), picture, distance)
    assert np.isnan(found.reflectance[0, 0]).all()
    assert found.noise[0, 0] == np.inf
    # Up to one gain (the light on the charts is free) and the error of the fit.
    share = found.reflectance / grey[:, :, None]
    spread = share / np.nanmedian(share)
    assert np.nanmax(np.abs(np.log(spread[2:]))) < 0.08
    assert np.nanmax(np.abs(found.residual)) < 0.02 + np.nanmax(np.maximum(share - 1, 0.0))
    # A veil of half as much again is more than the dark pixels hold.
    thick = dataclasses.replace(
        fitted(), x=fitted().x + 0.5 * np.array([n.startswith("veil") for n in fitted().value])
    )
    over = restore(thick, picture, distance)
    assert np.nanmin(over.residual) < -0.15
    # The darkest pixels say so, and no more is taken off than they hold.
    np.testing.assert_array_equal(found.veil, 1.0)
    assert found.message() is None
    assert 0.5 < over.veil.max() < 0.9
    assert "of the fitted veil was subtracted" in str(over.message())
    assert np.mean(over.reflectance < 0) < 0.02
    # One direction a row: each as if the whole picture were seen in it.
    tilt = np.full((10, 1), 90.0)
    tilt[0] = 95.0
    rows = restore(fitted(), picture, distance, zenith=tilt, dark=1.0).reflectance
    down = restore(fitted(), picture, distance, zenith=95.0, dark=1.0).reflectance
    np.testing.assert_allclose(rows[1:], found.reflectance[1:], rtol=1e-6)
    np.testing.assert_allclose(rows[0], down[0], rtol=1e-6)
    assert np.nanmax(np.abs(down[0] - found.reflectance[0])) > 1e-3
    with pytest.raises(ValueError, match="zenith must be degrees"):
        restore(fitted(), picture, distance, zenith=200.0)
    assert np.mean(restore(thick, picture, distance, dark=1.0).reflectance < 0) > 0.05
    exr, png, residual = found.save(tmp_path / "out")
    back = np.asarray(oiio.ImageBuf(str(exr)).get_pixels(oiio.FLOAT))
    np.testing.assert_allclose(back, found.reflectance, rtol=1e-6)
    assert oiio.ImageBuf(str(png)).spec().nchannels == 3
    assert residual.stat().st_size > 5_000
    with pytest.raises(ValueError, match=r"distance has shape \(3, 3\)"):
        restore(fitted(), picture, np.ones((3, 3)))


def test_the_page_holds_all_and_needs_nothing(tmp_path):
    page = tmp_path / "fit.html"
    fit = fitted()
    own = tmp_path / "own.png"
    fit.report(own)
    write_html(fit, page, [("Where <it> was read", own)])
    text = page.read_text()
    assert "Where &lt;it&gt; was read" in text
    assert text.count("data:image/png;base64,") == 2
    assert not re.search(r"(src|href)='(?!data:)", text)
    # No bare number for what is not identifiable.
    row = re.search(r"<tr><td>detritus</td>.*?</tr>", text)
    assert row is not None
    assert "not identifiable" in row.group()
    low, high = fit.quantities["c_550"].interval()
    assert f"{float(low):.3g} - {float(high):.3g}" in text
    # Sensitivity to what has no prior.
    fixed = text.split("took something else for granted")[1]
    assert "backscatter_split" in fixed.split("</table>")[0]


@pytest.mark.parametrize("name", ["I", "II", "3C", "9C"])
def test_the_nearest_type_is_the_type_itself(name):
    kd = np.asarray(oi.attenuation.kd_jerlov1976(name, WAVELENGTH))
    quantity = Quantity(kd * 1.05, np.full(16, 0.1), "m-1", "Kd")
    assert nearest_jerlov(WAVELENGTH, quantity) == (name, pytest.approx(np.log(1.05)))


@pytest.mark.slow
def test_background_alone_is_not_identifiable_but_covered():
    """Open water in one direction, exposure unknown: intervals that hold the truth, few numbers."""
    frame = Photo((), [Background(clean()[8:])], depth=5.0,
                  response=oi.spectrum.camera_response(CAMERA))  # fmt: skip
    fit = fit_photo(frame)
    assert not any(fit.identifiable[n] for n in ("chlorophyll", "cdom", "detritus"))
    for name, value in {"chlorophyll": 1.5, "cdom": 0.15, "detritus": 0.08}.items():
        low, high = fit.interval(name)
        assert low < value < high
    exact = water(np.array([440.0, 550.0]))
    for name, value in (("c_550", exact.c[1]), ("bb_550", exact.bb[1]),
                        ("a_cdm_440", exact.a_components[2:, 0].sum())):  # fmt: skip
        low, high = fit.quantities[name].interval()
        assert low < float(value) < high, name
        assert fit.quantities[name].sd > 0.5
