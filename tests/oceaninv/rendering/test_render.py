"""The command `oceaninv render`: files, layers, metadata, refusals."""

import json
import os
import struct
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import OpenImageIO as oiio
import pytest

import oceaninv as oi
from fitting.commands import main as cli
from oceaninv.rendering import display, render
from tests.oceaninv.foundation.test_colmap_file import write_colmap

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
    transport = oi.WithObjects(oi.TwoStream(), 48)
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


def test_photograph_is_what_the_command_draws(drawn):
    """The same weights in both, of the fine structure of daylight, too."""
    found, picture, _ = drawn
    again = oi.photograph(found.scene, found.camera, fine_light=found.fine_light).value
    expected = render.channels(found, picture.radiance)
    np.testing.assert_allclose(again, expected, rtol=1e-5, atol=1e-6 * expected.max())
    smooth = oi.photograph(found.scene, found.camera).value
    assert np.max(np.abs(smooth / again - 1)) > 1e-3


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
            render.to_display(found, seen).srgb
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
        xyz = display.display_matrix(response) @ (np.asarray(response.weights(grid)) @ light)
        rgb = oi.spectrum.linear_srgb(xyz)
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
        (["-o", "x.png", "--white-balance", "sun"], "--white-balance is 'sun'; it must be surface"),
        (["-o", "x.png", "--white-balance", "9,0"], "pixel 9,0; the picture has the columns 0 to"),
        (["-o", "x.png", "--animate", "3", "--rise", "9"], "--rise is 9"),
        (["-o", "x.png", "--animate", "3", "--seconds", "1"], "no [surface.waves]"),
    ],
)
def test_refusals(scene, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert cli.run(["render", str(scene), *arguments]) == 3
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fov_deg", "fov = 5\nfov_deg", "camera.fov means nothing here. Did you mean fov_deg?"),
        ("[0, 0, 4]", "[0, 0, -1]", "views through the surface from above are not modelled"),
        ("[camera]", "[floor]\ndepth_m = 3\nreflectance = 0.1\n[camera]", "above the floor at 3 m"),
        ("reflectance = 0.6", "reflectance = -0.6", "objects[0].reflectance is -0.6"),
        ("0.6", '"none.csv"', "none.csv does not exist"),
        (
            "direction = [0, 1, 0]",
            "direction = [0, 0.3, -1]\n[surface.waves]",
            "a view up through waves into the air is not modelled",
        ),
    ],
)
def test_bad_scenes(tmp_path, capsys, old, new, message):
    """Exit code 3, a sentence, and no picture."""
    path = tmp_path / "bad.toml"
    text = TEXT.replace(old, new)
    if "[surface.waves]" in text:
        text = text.replace("[surface.waves]\n", "") + "[surface]\n[surface.waves]\nslope = 0.1\n"
    path.write_text(text)
    assert cli.run(["render", str(path), "-o", str(tmp_path / "x.png")]) == 3
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize("kind", ["layers", pytest.param("inelastic", marks=pytest.mark.slow)])
def test_default_transport(tmp_path, capsys, kind):
    """Scenes that the closed forms do not solve are drawn by the exact model unless one is named,
    and a closed form says which would do."""
    text = TEXT[: TEXT.index("[[objects]]")] + TEXT[TEXT.index("[camera]") :]
    if kind == "layers":
        layer = '[[water.layers]]\njerlov_type = "IB"\n'
        layers = layer + "bottom_m = 8.0\n" + layer.replace("IB", "III")
        text = text.replace('[water]\njerlov_type = "IB"\n', layers)
    else:
        text = text.replace("[light]", "[inelastic]\nraman = true\n[light]")
    path = tmp_path / "deep.toml"
    path.write_text(text)
    output = str(tmp_path / "x.png")
    assert cli.run(["render", str(path), "-o", output]) == 0
    assert "plane-parallel" in capsys.readouterr().out
    output = str(tmp_path / "y.png")
    assert cli.run(["render", str(path), "-o", output, "--transport", "two-stream"]) == 3
    assert "PlaneParallel" in capsys.readouterr().err


def test_unwritable_output(scene, tmp_path, capsys):
    """A folder of that name is in the way."""
    (tmp_path / "x.png").mkdir()
    assert cli.run(["render", str(scene), "-o", str(tmp_path / "x.png")]) == 3
    assert "x.png" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["x.png"]


def test_read_only_folder(scene, tmp_path, capsys, monkeypatch):
    """Refused before anything is drawn."""
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o555)
    if os.access(folder, os.W_OK):  # root writes into any folder but those of the kernel
        folder = Path("/proc")
    monkeypatch.setattr(render, "draw", None)
    for name in ("x.png", "x.exr"):
        assert cli.run(["render", str(scene), "-o", str(folder / name)]) == 3
        assert f"cannot write {folder / name}: " in capsys.readouterr().err


def test_animation(scene, tmp_path):
    path = tmp_path / "up.png"
    arguments = ["-o", str(path), "--animate", "2", "--rise", "2"]
    assert cli.run(["render", str(scene), *arguments]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["up_0001.png", "up_0002.png"]


WAVES = """
[surface]
[surface.waves]
slope = 0.1
shortest_m = 0.5
[floor]
depth_m = 5
reflectance = 0.4
"""


def test_moving_caustics(tmp_path):
    """Frames of moving waves differ on the floor, not beside it."""
    path = tmp_path / "waves.toml"
    empty = TEXT[: TEXT.index("[[objects]]")] + WAVES + TEXT[TEXT.index("[camera]") :]
    path.write_text(empty.replace("fov_deg = 60", "fov_deg = 60\nexposure = 0.01"))
    arguments = ["-o", str(tmp_path / "f.tif"), "--animate", "2", "--seconds", "0.4"]
    assert cli.run(["render", str(path), *arguments]) == 0
    (first, spec), (second, _) = (_read(tmp_path / f"f_000{i}.tif") for i in (1, 2))
    change = np.abs(first[..., 1] / second[..., 1] - 1)
    assert change[:3].max() < 1e-3
    assert change[5:].max() > 0.02
    note = json.loads(spec.getattribute("ImageDescription"))
    assert 0.0 < note["predicted_error"] < 0.6
    assert note["predicted_error_covers"] == "water, floor and sky, not waves"


@pytest.fixture
def ranged(tmp_path, scene, drawn):
    """The ball again, as a range map of its own picture."""
    _, picture, _ = drawn
    lines = TEXT.splitlines()
    ball = lines.index("[[objects]]")
    map_ = ["[range_map]", 'range_m = "r.npz"', "reflectance = 0.6"]
    path = tmp_path / "ranged.toml"
    path.write_text("\n".join(lines[:ball] + map_ + lines[ball + 5 :]))
    np.savez(tmp_path / "r.npz", np.where(picture.range < 10, picture.range, 0.0))
    return path


def test_range_map(tmp_path, ranged, drawn):
    """What a range map shows of a ball is what the ball shows: the water's light, save for the
    ball's shadow in it, and what it reflects, as far as normals from so few pixels go."""
    _, whole, _ = drawn
    found = oi.load_scene(ranged)
    picture = render.draw(found, oi.TwoStream(), veil=True)
    met = (whole.range > 0) & (whole.range < 10)
    np.testing.assert_allclose(picture.range[met], whole.range[met], 1e-6)
    assert 3 < met.sum() < 40
    np.testing.assert_allclose(picture.veil[met], whole.veil[met], rtol=0.03)
    direct, expected = (p.radiance - p.veil for p in (picture, whole))
    centre = met.shape[0] // 2, met.shape[1] // 2
    np.testing.assert_allclose(direct[centre], expected[centre], rtol=0.05)
    again = oi.photograph(
        found.scene, found.camera, ranges=found.ranges, fine_light=found.fine_light
    ).value
    np.testing.assert_allclose(again, render.channels(found, picture.radiance), rtol=1e-5)
    assert cli.run(["render", str(ranged), "-o", str(tmp_path / "r.png")]) == 0


def test_range_map_of_depths_along_the_axis(tmp_path, ranged):
    """The same ball by depths along the axis, from COLMAP, in metres and in millimetres."""
    line = np.load(tmp_path / "r.npz")["arr_0"]
    rows, columns = line.shape
    half = np.tan(np.radians(30.0))  # of the field of view of 60 degrees
    x = half * ((np.arange(columns) + 0.5) / columns * 2 - 1)
    y = half * ((np.arange(rows) + 0.5) * 2 - rows) / columns
    depth = line / np.sqrt(1 + x**2 + y[:, None] ** 2)
    expected = oi.load_scene(ranged)
    expected = expected.ranges.seen_by(expected.camera)
    text = ranged.read_text()
    np.savez(tmp_path / "z.npz", depth)
    write_colmap(tmp_path / "z.bin", depth / 0.25)
    spec = oiio.ImageSpec(columns, rows, 1, "uint16")
    out = oiio.ImageOutput.create(str(tmp_path / "z.png"))
    assert out.open(str(tmp_path / "z.png"), spec)
    assert out.write_image((depth / 65.535).astype(np.float32)[:, :, None])
    out.close()
    for new, error in (('"z.npz"\nkind = "z"', 1e-12), ('"z.bin"\nm_per_unit = 0.25', 3e-7),
                       ('"z.png"\nkind = "z"', 3e-4)):  # fmt: skip
        ranged.write_text(text.replace('"r.npz"', new))
        found = oi.load_scene(ranged)
        found = found.ranges.seen_by(found.camera)
        np.testing.assert_array_equal(found.met, expected.met)
        np.testing.assert_allclose(found.distance, expected.distance, rtol=error)
        np.testing.assert_allclose(found.normal, expected.normal, atol=100 * error)
    ranged.write_text(text.replace('"r.npz"', '"z.bin"'))
    with pytest.raises(ValueError, match="m_per_unit is missing"):
        oi.load_scene(ranged)


@pytest.mark.slow
def test_range_map_by_exact_transports(ranged):
    """PlaneParallel and MonteCarlo draw the same range map: within five standard errors."""
    found = oi.load_scene(ranged)
    exact = render.draw(found, oi.PlaneParallel(8, knots=24)).radiance
    drawn = render.draw(found, oi.MonteCarlo(paths=512), seed=3)
    error = np.abs(drawn.radiance - exact) / np.mean(exact)
    assert error.max() < 5 * drawn.stderr + 0.05


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("r.npz", "none.npz", "does not exist"),
        ("reflectance = 0.6", "reflectance = -0.1", "reflectance is -0.1"),
        ("reflectance = 0.6", 'reflectance = 0.6\ntexture = "r.npz"\ntextur = 1', "textur means"),
        ("r.npz", "text.npy", "holds no numpy array"),
        ("r.npz", "text.exr", "is no picture"),
        ("r.npz", "cut.npz", "damaged or cut short"),
        ("r.npz", "huge.npz", "claims an array of shape (1000000, 1000000)"),
        ("r.npz", "cut.bin", "cut short"),
        ('"r.npz"', '"r.npz"\nkind = "depth"', "one of line, z"),
        ('"r.npz"', '"r.npz"\nm_per_unit = 0.0', "m_per_unit is 0.0"),
        ("r.npz", "below.npy", "must not be negative"),
        ("[range_map]", "[[lamps]]\nkind = 'point'\nposition_m = [0,0,1]\nintensity_w_sr_nm = 1\n"
         "[range_map]", "without objects, lamps, waves and inelastic"),
    ],
)  # fmt: skip
def test_range_map_refusals(ranged, capsys, old, new, message):
    for name in ("text.npy", "text.exr"):
        (ranged.parent / name).write_text("no picture")
    np.save(ranged.parent / "below.npy", -np.ones((7, 9)))
    whole = (ranged.parent / "r.npz").read_bytes()
    (ranged.parent / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (ranged.parent / "cut.bin").write_bytes(b"1000000&1000000&1&" + bytes(100))
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }"
    with zipfile.ZipFile(ranged.parent / "huge.npz", "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    ranged.write_text(ranged.read_text().replace(old, new))
    output = ranged.parent / "x.png"
    assert cli.run(["render", str(ranged), "-o", str(output)]) == 3
    assert message in capsys.readouterr().err
    assert not output.exists()
