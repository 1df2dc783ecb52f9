"""Scene files: what they become, and a sentence for everything that is wrong with one."""

import sys

import jax
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.scene import _toml_section, scene_file_water
from tests.paths import SCENES

FILES = sorted(SCENES.glob("*.toml"))
TEXT = """
title = "test"
[bands]
count = 4
[water]
chlorophyll_mg_m3 = 1
[light]
sun_zenith_deg = 30
diffuse_share = 0.25
[surface]
index = 1.34
[floor]
depth_m = 9
reflectance = 0.5
[[objects]]
kind = "sphere"
centre_m = [0, 3, 4]
radius_m = 0.5
reflectance = "orange"
[camera]
position_m = [0, 0, 4]
look_at_m = [0, 3, 4]
fov_deg = 60
width = 6
height = 4
"""


def _load(tmp_path, *changes, text=TEXT, **options):
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return oi.load_scene(path, **options)


@pytest.mark.parametrize(
    "path", [p for p in FILES if p.stem != "north_sea"], ids=lambda path: path.stem
)
def test_every_scene_of_the_project(path):
    found = oi.load_scene(path, bands=4)
    assert len(found.scene.wavelength) == 4
    assert found.title != path.stem
    assert found.camera.rays().direction.shape == (found.camera.width * found.camera.height, 3)


def test_values(tmp_path):
    found = _load(tmp_path)
    scene = found.scene
    np.testing.assert_allclose(scene.wavelength, oi.spectrum.bands(4))
    expected = oi.BioOpticalModel().iops(oi.Constituents(chlorophyll=1.0), scene.wavelength)
    np.testing.assert_allclose(scene.water.a, expected.a)
    daylight = oi.spectrum.daylight(scene.wavelength)
    np.testing.assert_allclose(scene.light.direct, daylight)
    horizontal = daylight * np.cos(np.radians(30))
    sky = np.pi * np.asarray(scene.light.diffuse)
    np.testing.assert_allclose(sky / (sky + horizontal), 0.25)
    np.testing.assert_allclose(scene.floor.reflectance, 0.5)
    orange = oi.spectrum.colour_checker("orange", scene.wavelength)
    np.testing.assert_allclose(scene.objects[0].reflectance, orange)
    np.testing.assert_allclose(found.camera.direction, [0.0, 3.0, 0.0])
    assert found.kd is None


def test_sun_azimuth_turns_the_rest(tmp_path):
    """A sun towards y, seen by a camera that looks at it, is the usual sun for one that looks to
    +x; the ball stays ahead."""
    found = _load(tmp_path, ("sun_zenith_deg = 30", "sun_zenith_deg = 30\nsun_azimuth_deg = 90"))
    np.testing.assert_allclose(found.camera.direction, [3.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(found.scene.objects[0].centre, [3.0, 0.0, 4.0], atol=1e-15)


def test_tables_and_layers(tmp_path):
    (tmp_path / "w.csv").write_text(
        "# made up\nwavelength_nm,a_per_m,b_per_m\n400,0.1,0.2\n700,0.4,0.2\n"
    )
    (tmp_path / "relief.csv").write_text("8,8,8\n8,7.5,8\n")
    found = _load(
        tmp_path,
        ("chlorophyll_mg_m3 = 1", 'table = "w.csv"\nphase = "HenyeyGreenstein"\nasymmetry = 0.8'),
        ('kind = "sphere"', 'kind = "height field"'),
        ("centre_m = [0, 3, 4]", 'depth_m = "relief.csv"'),
        ("radius_m = 0.5", "spacing_m = 2"),
        ("fov_deg", 'response = "Nikon D850"\nexposure = 2\nbits = 8\nfov_deg'),
    )
    np.testing.assert_allclose(
        found.scene.water.a, np.interp([437.5, 512.5, 587.5, 662.5], [400, 700], [0.1, 0.4])
    )
    np.testing.assert_allclose(found.scene.water.b, 0.2)
    # The stated phase function is that of particles: sea water scatters half backwards.
    of_water, of_particles = found.scene.water.b_components
    np.testing.assert_allclose(of_water, oi.water.scattering(found.scene.water.wavelength))
    ratio = oi.phase.HenyeyGreenstein(0.8).backscatter_ratio
    np.testing.assert_allclose(found.scene.water.bb, 0.5 * of_water + ratio * of_particles)
    assert found.scene.objects[0].depth.shape == (2, 3)
    assert (float(found.sensor.exposure), found.sensor.bits) == (2.0, 8)
    two = """[[water.layers]]
bottom_m = 3
jerlov_type = "IB"
[[water.layers]]
chlorophyll_mg_m3 = 2"""
    layered = _load(tmp_path, ("[water]\nchlorophyll_mg_m3 = 1", two))
    assert isinstance(layered.scene.water, oi.Layers)


def test_light_lamps_and_response_from_tables(tmp_path):
    """A measured sun, a lamp with a spectrum and a camera given by csv."""
    (tmp_path / "sun.csv").write_text("wavelength_nm,value\n400,1\n700,4\n")
    (tmp_path / "eye.csv").write_text("wavelength_nm,grey\n400,0\n550,1\n700,0\n")
    lamp = """[[lamps]]
kind = "spot"
position_m = [1, 0, 4]
direction = [0, 2, 0]
half_angle_deg = 20
intensity_w_sr_nm = 2
[camera]
response = "eye.csv"
flat_port_index = 1.34"""
    found = _load(
        tmp_path,
        ("sun_zenith_deg = 30", 'sun_zenith_deg = 30\nspectrum = "sun.csv"\nscale = 2'),
        ("[camera]", lamp),
    )
    centres = np.array([437.5, 512.5, 587.5, 662.5])
    np.testing.assert_allclose(found.scene.light.direct, 2 * (1 + (centres - 400) / 100))
    assert found.fine_light is None
    np.testing.assert_allclose(found.scene.lamps[0].intensity, 2.0)
    np.testing.assert_allclose(found.scene.lamps[0].direction, [0.0, 1.0, 0.0])
    assert found.camera.response.channels == ("grey",)
    assert float(found.camera.port_index) == 1.34


MEDIA = {
    'medium = "milk"\nfat_percent = 1\nprotein_percent = 3': lambda: oi.media.milk(1.0, 3.0),
    'medium = "ice"\nair_fraction = 1e-3': lambda: oi.media.ice(air=1e-3),
    'medium = "natural water"\nsea = "Baltic"': lambda: oi.media.natural_water("Baltic"),
}


@pytest.mark.parametrize("keys", MEDIA)
def test_media(tmp_path, keys):
    """The medium that a file asks for; what it does to light is tested with `media`."""
    (tmp_path / "water.toml").write_text(keys)
    found = scene_file_water._medium(_toml_section.read(tmp_path / "water.toml"))
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(MEDIA[keys]()), strict=True)
    assert all(np.array_equal(one, other) for one, other in pairs)


def test_reef_is_its_range_map():
    """The range map is what the camera of the height field sees, to half a millimetre."""
    reef, ranged = (oi.load_scene(SCENES / f"{n}.toml", bands=2) for n in ("reef", "reef_range"))
    some = slice(17, None, 97)
    rays, again = reef.camera.rays(), ranged.camera.rays()
    np.testing.assert_array_equal(rays.direction, again.direction)
    meet = jax.jit(jax.vmap(lambda o, d: oi.objects.nearest(reef.scene.objects, o, d).distance))
    distance = np.asarray(meet(rays.origin[some], rays.direction[some]))
    fall = np.asarray(rays.direction[some, 2])
    sand = np.where(fall > 0, (6.0 - 3.9) / np.where(fall > 0, fall, 1.0), np.inf)
    distance = np.minimum(distance, sand)
    known = np.asarray(ranged.ranges.distance).ravel()[some]
    assert 50 < np.sum(np.isinf(distance)) < 150
    np.testing.assert_allclose(
        known, np.where(np.isinf(distance), 0.0, distance), rtol=1e-6, atol=2.6e-4
    )


def test_water_from_kd(tmp_path):
    """The a and b that were found give the measured Kd back, by the model that was inverted."""
    (tmp_path / "kd.csv").write_text("wavelength_nm,kd_per_m\n400,0.1\n500,0.07\n700,0.7\n")
    found = _load(
        tmp_path, ("chlorophyll_mg_m3 = 1", 'kd_table = "kd.csv"\nbackscatter_ratio = 0.012')
    )
    water = found.scene.water
    np.testing.assert_allclose(
        found.kd, np.interp(water.wavelength, [400, 500, 700], [0.1, 0.07, 0.7])
    )
    again = oi.attenuation.kd_lee2005(water.a, water.bb, 30.0)
    np.testing.assert_allclose(again, found.kd, rtol=2e-3)
    ratio = np.asarray(water.bb - 0.5 * water.b_components[0]) / np.asarray(water.b_components[1])
    np.testing.assert_allclose(ratio, 0.012, rtol=1e-2)
    with pytest.raises(ValueError, match="the backscattering alone exceeds Kd"):
        _load(
            tmp_path,
            (
                "chlorophyll_mg_m3 = 1",
                'kd_table = "kd.csv"\nbackscatter_ratio = 0.2\nb_550_per_m = 1.0',
            ),
        )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("count = 4", "count = 1", r"scene.toml: bands.count is 1; .* between 2 and 1000"),
        (
            "count = 4",
            "count = 4\nform_nm = 3",
            r"bands.form_nm means nothing here. Did you mean",
        ),
        ("[water]", "[watre]", "water must describe its water in one way.* it has none"),
        ("chlorophyll_mg_m3 = 1", 'jerlov_type = "IV"', "jerlov_type is 'IV'; .*1C, 3C.*near it"),
        ("chlorophyll_mg_m3 = 1", 'medium = "beer"', "water.medium is 'beer'; .* milk"),
        ("chlorophyll_mg_m3 = 1", 'table = "none.csv"', r"none.csv'; .* does not exist"),
        ("chlorophyll_mg_m3 = 1", "chlorophyll_mg_m3 = -1", r"chlorophyll_mg_m3 is -1; .* least 0"),
        ("chlorophyll_mg_m3 = 1", 'chlorophyll_mg_m3 = "1"', "is '1'; it must be a number"),
        ("sun_zenith_deg = 30", "sun_zenith_deg = 95", "sun_zenith_deg is 95.*at most 89.9"),
        ("sun_zenith_deg = 30", "", "light.sun_zenith_deg is missing"),
        ("diffuse_share = 0.25", 'spectrum = "D50"', "light.spectrum is 'D50'; .* D65, flat"),
        ("reflectance = 0.5", "reflectance = -0.5", "floor.reflectance is -0.5"),
        ('"orange"', '"ornge"', r"objects\[0\].reflectance is 'ornge'; .*Near it: orange"),
        ('"sphere"', '"spere"', r"objects\[0\].kind is 'spere'; .*near it: sphere"),
        ("centre_m = [0, 3, 4]", "centre_m = [0, 3]", "centre_m is .0, 3.; .* three numbers"),
        ("centre_m = [0, 3, 4]", "centre_m = [0, 3, 0.2]", r"scene.toml: objects\[0\] reaches 0.3"),
        ("position_m = [0, 0, 4]", "position_m = [0, 0, -1]", "views through the surface from abo"),
        ("position_m = [0, 0, 4]", "position_m = [0, 0, 9.5]", "must be above the floor at 9 m"),
        ("look_at_m = [0, 3, 4]", "direction = [0, 0, 1]", "must not be parallel or of length 0"),
        ("fov_deg = 60", 'fov_deg = 60\nresponse = "Nikn D850"', "Near it: Nikon D850"),
        ("fov_deg = 60", "fov_deg = 60\nbits = 20", "bits is 20; .* between 1 and 16"),
        ('title = "test"', 'titel = "test"', "titel means nothing here. Did you mean title"),
        ("[bands]", "[bands", "is not a toml file"),
        ("count = 4", 'count = 9\nspacing = "cameras"', "known for 8 on 400-650 nm; .* not for 9"),
        ("[floor]", "[flor]", r"scene.toml: flor means nothing here. Did you mean floor\?"),
        ("radius_m = 0.5", "radius_cm = 50", r"objects\[0\].radius_m is missing; it must be a num"),
        ("fov_deg = 60", "fov_deg = 60\nexposre = 2", "exposre means .* Did you mean exposure"),
        ('"orange"', "1.5", r"objects\[0\].reflectance is 1.5; .* at most 1"),
        ('"orange"', '"none.csv"', r"scene.toml: objects\[0\].reflectance .* does not exist"),
        ('"orange"', '"white"\nreflectance_scale = 2', "between 0 and 1, not 1."),
        ("fov_deg = 60", 'fov_deg = 60\nresponse = "none.csv"', "camera.response is .*not exist"),
        ("count = 4", "from_nm = 250", "scene.toml: water: Table IOCCG2018 covers 300-800 nm"),
        ("diffuse_share = 0.25", 'spectrum = "scene.toml.csv"', "light.spectrum is .* not exist"),
        (
            "sun_zenith_deg = 30\ndiffuse_share = 0.25",
            'sun_zenith_deg = 88\nspectrum = "clear sky"',
            "scene.toml: light: zenith must be .* between 0 and 85",
        ),
        ("[floor]", "[inelastic]\n[floor]", "inelastic: no process is on: set raman, chlor"),
        ("[floor]", "[inelastic]\nraman = 1\n[floor]", "inelastic.raman is 1; .* true or false"),
        (
            "[floor]",
            "[inelastic]\ncdom_fluorescence = true\n[floor]",
            "scene.toml: inelastic: fluorescence needs an absorber named 'cdom'",
        ),
        ("[floor]", "[surface.waves]\nslope = 0.4\n[floor]", "surface.waves.slope is 0.4"),
        ("[floor]", "[surface.waves]\ntile_m = 1\n[floor]", "surface.waves: wave lengths need"),
    ],
)
def test_refusals(tmp_path, old, new, message):
    with pytest.raises(ValueError, match=message):
        _load(tmp_path, (old, new))


def test_inelastic(tmp_path):
    """Processes as their classes are built; absent without the table."""
    assert _load(tmp_path).scene.inelastic is None
    table = "[inelastic]\nraman = true\nchlorophyll_fluorescence = true\n"
    change = ("[floor]", table + "chlorophyll_quantum_yield = 0.01\n[floor]")
    found = _load(tmp_path, change)
    assert isinstance(found.scene.inelastic.raman, oi.Raman)
    assert found.scene.inelastic.cdom is None
    np.testing.assert_allclose(found.scene.inelastic.chlorophyll.quantum_yield, 0.01)
    # The structure of daylight is not that of emitted light.
    assert found.fine_light is None
    default = _load(tmp_path, ("[floor]", table + "[floor]")).scene.inelastic.chlorophyll
    np.testing.assert_allclose(default.quantum_yield, 0.02)
    bare = TEXT[: TEXT.index("[[objects]]")] + TEXT[TEXT.index("[camera]") :]
    np.save(tmp_path / "r.npy", np.ones((4, 6)))
    ranged = "[range_map]\nrange_m = 'r.npy'\nreflectance = 0.5\n"
    with pytest.raises(ValueError, match="goes without objects, lamps, waves and inelastic"):
        _load(tmp_path, ("[floor]", table + ranged + "[floor]"), text=bare)


def test_missing_file(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        oi.load_scene(tmp_path / "nothing.toml")


def test_sensor():
    values = jax.random.uniform(jax.random.key(1), (40, 50, 3)) * 3.0
    exposed = oi.Sensor(bits=8).expose(values)
    np.testing.assert_allclose(np.percentile(exposed, 99, axis=(0, 1)).max(), 0.9, atol=0.01)
    np.testing.assert_allclose(np.asarray(exposed) * 255, np.round(exposed * 255), atol=1e-9)
    noisy = oi.Sensor(0.2, full_well=1e4, read_noise=20.0)
    grey = np.full((200, 200, 3), 2.0)
    seen = noisy.expose(jax.numpy.asarray(grey), jax.random.key(2))
    np.testing.assert_allclose(np.mean(seen), 0.4, atol=5 * 0.0067 / np.sqrt(grey.size))
    expected = np.sqrt(0.4 / 1e4 + 0.002**2)  # photon noise and the reading's
    np.testing.assert_allclose(np.std(seen), expected, rtol=0.012)
    with pytest.raises(ValueError, match="give expose a key"):
        noisy.expose(values)
    with pytest.raises(ValueError, match="state full_well"):
        oi.Sensor(read_noise=2.0)


def test_flat_port():
    """The picture's edge at 30 degrees in air sees 21.9 degrees in water."""
    response = oi.spectrum.camera_response("Nikon D850")
    pose = ((0.0, 0, 3), (0.0, 1, 0), (0.0, 0, -1), 60.0, 2000, 1, response)
    looks = oi.Camera(*pose, port_index=1.34).rays().direction
    free = oi.Camera(*pose).rays().direction
    seen, air = (np.arcsin(np.abs(np.asarray(x)[:, 0])) for x in (looks, free))
    np.testing.assert_allclose(np.sin(air), 1.34 * np.sin(seen), rtol=1e-12)
    np.testing.assert_allclose(np.degrees(seen.max()), np.degrees(np.arcsin(0.5 / 1.34)), 1e-3)


def test_clear_sky():
    """A summer noon: 1.3 to 1.5 W/m2/nm at 550 nm, a blue sky of some 12 % of it."""
    direct, sky = oi.light.clear_sky([450.0, 550.0, 650.0], 30.0)
    assert 1.25 < direct[1] < 1.5
    share = np.pi * sky / (np.pi * sky + direct * np.cos(np.radians(30)))
    assert 0.09 < share[1] < 0.16
    assert share[0] > 1.3 * share[2]
    with pytest.raises(ValueError, match="zenith must be finite and between 0 and 85"):
        oi.light.clear_sky([500.0], 88.0)


def test_clear_sky_without_pvlib(monkeypatch):
    """It says what to install, and what else to take."""
    monkeypatch.setitem(sys.modules, "pvlib.atmosphere", None)
    with pytest.raises(ImportError, match="pip install pvlib, or give the light another spectrum"):
        oi.light.clear_sky([450.0, 550.0], 30.0)
