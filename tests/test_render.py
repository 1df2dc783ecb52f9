"""The command `oceaninv render`: files, layers, metadata, refusals."""

import json

import jax.numpy as jnp
import numpy as np
import OpenImageIO as oiio
import pytest

import oceaninv as oi
from fitting import cli, render

TEXT = """
title = "a ball"
[bands]
count = 3
[water]
jerlov_type = "IB"
[light]
sun_zenith_deg = 30
[[objects]]
kind = "sphere"
centre_m = [0, 3, 4]
radius_m = 0.5
reflectance = 0.6
[camera]
position_m = [0, 0, 4]
direction = [0, 1, 0]
fov_deg = 60
width = 9
height = 7
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "ball.toml"
    path.write_text(TEXT)
    return path


@pytest.fixture(scope="module")
def drawn(scene):
    found = oi.load_scene(scene)
    transport = oi.Shadows(oi.TwoStream(), 48)
    picture = render.draw(found, transport, veil=True)
    return found, picture, render.metadata(scene, found, transport, 5, picture)


def _read(path):
    file = oiio.ImageInput.open(str(path))
    assert file is not None, oiio.geterror()
    values, spec = np.asarray(file.read_image(format="float")), file.spec()
    file.close()
    return values, spec


def test_picture(drawn):
    """The ball stands in the middle, 2.5 m away, and adds to the water's light there alone."""
    _, picture, _ = drawn
    np.testing.assert_allclose(picture.range[3, 4], 2.5, rtol=1e-6)
    beside = picture.radiance[3, 0] - picture.veil[3, 0]
    np.testing.assert_allclose(beside, 0.0, atol=1e-6)
    assert np.all(picture.radiance[3, 4] > 2 * picture.veil[3, 4])
    assert picture.range[3, 0] == 0.0  # endless water at eye level


def test_command_writes_exr_with_layers(scene, tmp_path, drawn):
    found, picture, _ = drawn
    path = tmp_path / "ball.exr"
    assert cli.run(["render", str(scene), "-o", str(path), "--seed", "5"]) == 0
    values, spec = _read(path)
    names = list(spec.channelnames)
    assert set(names) == {*"RGB", *(f"{k}.{c}" for k in ("direct", "veil") for c in "RGB"), "range"}
    for c in "RGB":
        parts = values[..., names.index(f"direct.{c}")] + values[..., names.index(f"veil.{c}")]
        np.testing.assert_allclose(parts, values[..., names.index(c)], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(values[..., names.index("range")], picture.range, rtol=1e-5)
    rgb = render.channels(found, picture.radiance) @ render._linear_srgb().T
    np.testing.assert_allclose(values[..., names.index("G")], rgb[..., 1], rtol=1e-5, atol=1e-6)
    note = json.loads(spec.getattribute("ImageDescription"))
    assert note["transport"] == "TwoStream"
    assert (note["seed"], note["scene"]) == (5, "ball.toml")
    assert [p.name for p in tmp_path.iterdir()] == ["ball.exr"]


def test_spectral_exr(tmp_path, drawn):
    found, picture, note = drawn
    path = tmp_path / "s.exr"
    render.save(path, found, picture, note, linear=False, spectral=True)
    values, spec = _read(path)
    at = list(spec.channelnames).index("S0.550,000nm")
    np.testing.assert_allclose(values[..., at], picture.radiance[..., 1], rtol=1e-6)


def test_pictures_for_the_eye_and_for_programs(tmp_path, drawn):
    found, picture, note = drawn
    for name, linear, kind, levels in (
        ("a.png", False, "uint8", 255),
        ("b.png", True, "uint16", 65535),
        ("c.tif", False, "uint16", 65535),
    ):
        path = tmp_path / name
        render.save(path, found, picture, note, linear=linear, spectral=False)
        values, spec = _read(path)
        assert str(spec.format) == kind
        assert json.loads(spec.getattribute("ImageDescription"))["title"] == "a ball"
        seen = render.channels(found, picture.radiance)
        expected = (
            render.to_display(found, seen)
            if kind == "uint8"
            else np.asarray(found.sensor.expose(jnp.asarray(seen)))
        )
        np.testing.assert_allclose(values, expected, atol=1.01 / levels)


def test_white_stays_white():
    """A grey card in daylight comes out grey, by any camera."""
    grid = oi.spectrum.bands(32)
    light = oi.spectrum.daylight(grid)
    for name in ("Nikon D850", "Canon EOS 5D Mark II"):
        if name not in oi.spectrum.camera_names():
            continue
        response = oi.spectrum.camera_response(name)
        xyz = render.display_matrix(response) @ (np.asarray(response.weights(grid)) @ light)
        rgb = render._linear_srgb() @ xyz
        np.testing.assert_allclose(rgb / rgb[1], 1.0, atol=0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-o", "x.jpg"], "must end in .exr, .tif or .png"),
        (["-o", "no/such/folder/x.png"], "does not exist"),
        (
            ["-o", "x.png", "--transport", "fast"],
            "--transport is 'fast'; it must be one of two",
        ),
        (["-o", "x.png", "--bands", "1"], "--bands is 1"),
        (["-o", "x.png", "--width", "0"], "--width is 0"),
        (["-o", "x.png", "--animate", "3", "--rise", "9"], "--rise is 9"),
    ],
)
def test_refusals(scene, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert cli.run(["render", str(scene), *arguments]) == 3
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_animation(scene, tmp_path):
    path = tmp_path / "up.png"
    arguments = ["-o", str(path), "--animate", "2", "--rise", "2"]
    assert cli.run(["render", str(scene), *arguments]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["up_0001.png", "up_0002.png"]
