"""Pictures for looking at: white balance, exposure, metadata, refusals."""

import json

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.foundation.image_file import read_image
from oceaninv.rendering import display, render
from oceaninv.scene.scene_file import SceneFile

BANDS = oi.spectrum.bands(16)
DAY = jnp.asarray(oi.spectrum.daylight(BANDS))
RESPONSES = {
    "observer": oi.spectrum.cie_1931(),
    "generic": oi.spectrum.generic_camera(),
    "D850": oi.spectrum.camera_response("Nikon D850"),
}


LAMP = oi.PointLamp([0.0, 1.0, 5.0], jnp.ones(16))


def _scene(chlorophyll=1.0, **others):
    water = oi.BioOpticalModel().iops(oi.Constituents(chlorophyll, 0.05), BANDS)
    return oi.Scene(water, oi.Light(40.0, DAY, 0.1 * DAY), oi.FlatSurface(), **others)


def _camera(response, depth=8.0, width=6, height=5):
    return oi.Camera([0, 0, depth], [0, 1, 0], [0, 0, -1], 60.0, width, height, response)


def _grey(colour):
    return np.ptp(np.asarray(colour)) < 2.5e-3  # less than one of 255 steps


@pytest.mark.parametrize("name", RESPONSES)
def test_white_balance_makes_a_grey_card_grey(name):
    """At the pixel of a card, and in the light that comes down to the camera or to the surface.
    Without it, light under water is no grey."""
    scene, camera = _scene(), _camera(RESPONSES[name])
    weights = np.asarray(camera.response.smooth_weights(BANDS))
    below = oi.irradiance(scene, 8.0).Ed.value[0] * 0.18 / np.pi
    above = (DAY * np.cos(np.radians(40)) + np.pi * 0.1 * DAY) * 0.18 / np.pi
    for light, balance in ((below, "depth"), (below, (2, 1)), (above, "surface")):
        values = np.tile(weights @ np.asarray(light), (5, 6, 1))
        values[3:, :, 0] *= 1.3  # a thing of another colour
        found = display.shown(values, scene, camera, white_balance=balance)
        assert _grey(found.srgb[0, 0])
        assert np.ptp(found.srgb[4, 0]) > 0.02
        plain = display.shown(values, scene, camera, white_balance="none")
        assert balance == "surface" or not _grey(plain.srgb[0, 0])


@pytest.mark.parametrize("name", RESPONSES)
def test_white_keeps_its_brightness(name):
    """So that a stated exposure means the same with every white balance."""
    response = RESPONSES[name]
    white = np.asarray(response.weights(BANDS)) @ np.exp(-((BANDS - 480) ** 2) / 5000)
    before, after = (display.balanced_matrix(response, w) @ white for w in (None, white))
    np.testing.assert_allclose(after, before[1] * np.array([0.95047, 1.0, 1.08883]), rtol=1e-9)


@pytest.mark.parametrize("shape", [(5, 6), (20, 30)])
def test_one_bright_pixel_does_not_set_the_exposure(shape):
    """A pixel 1e5 times as bright moves the rule by one rank at most."""
    generator = np.random.default_rng(3)
    values = np.exp(0.2 * generator.normal(size=(*shape, 3)))
    spoiled = values.copy()
    spoiled[1, 2] *= 1e5
    camera = _camera(RESPONSES["generic"], width=shape[1], height=shape[0])
    found = [display.shown(v, _scene(), camera).facts["exposure"] for v in (values, spoiled)]
    assert 0.7 < found[1] / found[0] <= 1
    sensor = oi.Sensor()
    exposed = [np.asarray(sensor.expose(jnp.asarray(v)))[0, 0] for v in (values, spoiled)]
    assert np.all(exposed[1] > 0.7 * exposed[0])


def test_exposure_rule():
    """The 99th percentile of the brightest primary becomes 0.85; a stated factor is taken."""
    camera = _camera(RESPONSES["observer"], width=20, height=10)
    steps = np.linspace(0.1, 1.0, 200).reshape(10, 20, 1)
    values = steps * np.array([0.95047, 1.0, 1.08883])
    linear = np.sort(values[..., 1].ravel())
    found = display.shown(values, _scene(), camera, white_balance="none")
    np.testing.assert_allclose(found.facts["exposure"], 0.85 / linear[197], rtol=2e-3)
    stated = display.shown(values, _scene(), camera, exposure=0.5, white_balance="none")
    np.testing.assert_allclose(
        stated.srgb[..., 1].ravel(), 1.055 * (0.5 * linear) ** (1 / 2.4) - 0.055, atol=2e-3
    )


def test_black_pictures_stay_black():
    camera = _camera(RESPONSES["observer"])
    assert np.all(display.shown(np.zeros((5, 6, 3)), _scene(), camera).srgb == 0)


def test_show_draws_what_it_returns():
    matplotlib.use("agg")
    from matplotlib import pyplot

    scene, camera = _scene(), _camera(RESPONSES["observer"])
    _, axes = pyplot.subplots()
    estimate = oi.photograph(scene, camera)
    srgb = oi.show(estimate, scene, camera, axes=axes)
    np.testing.assert_array_equal(axes.images[0].get_array(), srgb)
    np.testing.assert_array_equal(oi.show(estimate.value, scene, camera), srgb)
    pyplot.close("all")


def test_one_channel_is_grey():
    response = oi.spectrum.Response(jnp.ones((1, 2)), [400.0, 700.0], ("V",))
    found = display.shown(np.full((5, 6, 1), 3.0), _scene(), _camera(response))
    np.testing.assert_allclose(found.srgb, 1.0)


def _found(scene, camera):
    return SceneFile(scene, camera, oi.Sensor(), None, "a test")


def _picture(scene, camera):
    return render.draw(_found(scene, camera), oi.TwoStream(), veil=True)


def test_metadata_and_linear_files(tmp_path):
    """A PNG says how it was developed; EXR and linear files do not depend on the balance."""
    scene, camera = _scene(), _camera(RESPONSES["generic"])
    found, picture = _found(scene, camera), _picture(scene, camera)
    read = {}
    for balance in ("none", "depth"):
        for name in ("a.png", "a.exr", "a.tif"):
            path = tmp_path / f"{balance}_{name}"
            render.save(
                path, found, picture, {}, linear=False, spectral=False, white_balance=balance
            )
            read[balance, name] = read_image(path, 10**6)
    for name, same in (("a.png", False), ("a.exr", True), ("a.tif", True)):
        one, other = (read[balance, name] for balance in ("none", "depth"))
        assert np.array_equal(one.values, other.values) == same
        assert ("display" in json.loads(one.attributes["ImageDescription"])) != same
    note = json.loads(read["depth", "a.png"].attributes["ImageDescription"])["display"]
    shown = render.to_display(found, render.channels(found, picture.radiance), "depth")
    assert note == shown.facts
    assert note["white_balance"] == "depth"
    assert len(note["white"]) == 3
    assert 0 <= note["share_outside_gamut"] <= 1
    np.testing.assert_allclose(read["depth", "a.png"].values, shown.srgb, atol=0.51 / 255)


def test_balance_by_default():
    """The light at the camera; where a lamp shines, the light above the surface."""
    camera, values = _camera(RESPONSES["generic"]), np.ones((5, 6, 3))
    for lamps, expected in (((), "depth"), ((LAMP,), "surface")):
        scene = _scene(lamps=lamps)
        found = display.shown(values, scene, camera)
        assert found.facts["white_balance"] == expected
        stated = display.shown(values, scene, camera, white_balance=expected)
        np.testing.assert_array_equal(found.srgb, stated.srgb)


def test_light_that_lacks_a_channel():
    """Night above the surface is no white: the picture is left as it is."""
    water = _scene().water
    night = oi.Scene(water, oi.Light(40.0, 0.0 * DAY))
    values, camera = np.ones((5, 6, 3)), _camera(RESPONSES["generic"])
    assert display.shown(values, night, camera).facts["white_balance"] == "none"
    with pytest.raises(ValueError, match="the light at 8 m has no light in the channel R"):
        display.shown(values, night, camera, white_balance="depth")


@pytest.mark.parametrize(
    ("balance", "lamps", "message"),
    [
        ("sun", (), "white_balance is 'sun'; it must be one of surface, depth, none or the column"),
        ((6, 0), (), "the pixel 6,0; the picture has the columns 0 to 5 and the rows 0 to 4"),
        ((0, -1), (), "the pixel 0,-1"),
        ("depth", (LAMP,), "but lamps shine: take surface, none or the column"),
    ],
)
def test_refusals(balance, lamps, message):
    scene, camera = _scene(lamps=lamps), _camera(RESPONSES["generic"])
    with pytest.raises(ValueError, match=message):
        display.shown(np.ones((5, 6, 3)), scene, camera, white_balance=balance)


def test_a_picture_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"with 3 channels, as the camera has, but has \(5, 6, 2"):
        display.shown(np.ones((5, 6, 2)), _scene(), _camera(RESPONSES["generic"]))
