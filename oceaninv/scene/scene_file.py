"""Scenes from toml files.  `scenes/README.md` lists every key."""

import contextlib
import dataclasses
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from oceaninv.foundation import spectrum
from oceaninv.scene._toml_section import Section, depths, grid, numbers, picture, read, spectra
from oceaninv.scene.camera import Camera, Sensor
from oceaninv.scene.light import AbstractLamp, Light, PointLamp, SpotLamp, clear_sky
from oceaninv.scene.objects import AbstractObject, Box, HeightField, Sphere
from oceaninv.scene.range_map import RangeMap, colour_parts
from oceaninv.scene.scene import FlatSurface, Floor, Scene
from oceaninv.scene.scene_file_water import read_water
from oceaninv.scene.waves import Waves, random_waves
from oceaninv.water.inelastic import CDOMFluorescence, ChlorophyllFluorescence, Inelastic, Raman
from oceaninv.water.iops import IOPs, Layers

_NO_LIMIT = 1e30


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """The contents of a scene file.

    `scene`, `camera`, `sensor`: as their classes say.  `kd`: (wl,) the measured Kd of a water that
    was given by one, for `KdTransport(kd)`; `None` otherwise.  `title`: text.  `fine_light`: the
    table of D65 where all light is that, `ranges`: a range map, each for `photograph` by that name,
    or `None`.  `files`: the scene file and every file it names.
    """

    scene: Scene
    camera: Camera
    sensor: Sensor
    kd: np.ndarray | None
    title: str
    fine_light: tuple[np.ndarray, np.ndarray] | None = None
    ranges: RangeMap | None = None
    files: tuple[Path, ...] = ()


def load_scene(path: str | Path, *, bands: int | None = None) -> SceneFile:
    """Read a scene file.

    **Arguments:** `path`: toml; `bands`: number of wavelength bands instead of the file's
    (equal ones where the file's spacing has no such number).

    **Raises:** `ValueError` that names the file, the key, the value and what is allowed.
    """
    file = read(path)
    wavelength = _bands(file.section("bands"), bands)
    title = file.text("title", default=Path(path).stem)
    day = file.section("light").text("spectrum", default="D65") == "D65"
    with _naming(path, "water"):
        water, kd = read_water(file.section("water"), wavelength)
    with _naming(path, "light"):
        light, azimuth = _light(file.section("light"), wavelength)
    surface = None
    if file.has("surface"):
        table = file.section("surface")
        index, waves = table.number("index", 1.0, 2.0, 1.34), None
        if table.has("waves"):
            waves = _waves(table.section("waves"), azimuth)
        surface = FlatSurface(index, waves)
        table.finish()
    floor = None
    if file.has("floor"):
        table = file.section("floor")
        with _naming(path, "floor"):
            floor = Floor(table.number("depth_m", 1e-3, 1e4), _reflectance(table, wavelength))
        table.finish()
    inelastic = None
    if file.has("inelastic"):
        with _naming(path, "inelastic"):
            inelastic = _inelastic(file.section("inelastic"), water)
    turn = _Turn(azimuth)
    with _naming(path, "objects"):
        objects = [_object(table, wavelength, turn) for table in file.sections("objects")]
    with _naming(path, "lamps"):
        lamps = [_lamp(table, wavelength, turn) for table in file.sections("lamps")]
    with _naming(path, "camera"):
        camera, sensor = _camera(file.section("camera"), wavelength, turn)
    depth = float(camera.position[2])
    if depth < 0:
        raise file.section("camera").error(
            "position_m",
            camera.position.tolist(),
            "under water, its third number >= 0: views through the surface from above are not"
            " modelled",
        )
    if floor is not None and depth >= float(floor.depth):
        raise file.section("camera").error(
            "position_m", camera.position.tolist(), f"above the floor at {float(floor.depth):g} m"
        )
    ranges = None
    if file.has("range_map"):
        with _naming(path, "range_map"):
            ranges = _ranges(file.section("range_map"), wavelength)
        waves = surface is not None and surface.waves is not None
        if objects or lamps or waves or inelastic is not None:
            raise ValueError(
                f"{path}: a range_map holds all things that are seen: it goes without objects,"
                " lamps, waves and inelastic."
            )
    file.finish()
    with _naming(path):
        scene = Scene(water, light, surface, floor, objects, lamps, inelastic)
    # Light that changed its wavelength has lost the structure of daylight.
    smooth = not day or lamps or inelastic is not None
    fine_light = None if smooth else spectrum.daylight_table()
    return SceneFile(scene, camera, sensor, kd, title, fine_light, ranges, tuple(file.files))


@contextlib.contextmanager
def _naming(path: str | Path, table: str = ""):
    """Adds the file and its table to errors of packages that do not know them."""
    try:
        yield
    except (ValueError, ImportError) as error:
        if str(error).startswith(str(Path(path))):
            raise
        place = f"{path}: {table}: " if table else f"{path}: "
        raise ValueError(f"{place}{error}") from None


def _bands(table: Section, count: int | None) -> np.ndarray:
    given = table.integer("count", 2, 1000, 16)
    low = table.number("from_nm", 200.0, 1000.0, 400.0)
    high = table.number("to_nm", 200.0, 1000.0, 700.0)
    if high <= low:
        raise table.error("to_nm", high, f"more than from_nm = {low:g}")
    spacing = table.text("spacing", ("equal", "cameras"), "equal")
    table.finish()
    number = given if count is None else count
    if spacing == "equal":
        return spectrum.bands(number, low, high)
    try:
        return spectrum.camera_bands(number, low, high)
    except ValueError as error:
        if count is not None:
            return spectrum.bands(number, low, high)
        raise ValueError(f"{table.path}: bands.spacing is 'cameras': {error}") from None


class _Turn:
    """Rotates about the vertical, since a scene has its sun towards +x but a file may not."""

    def __init__(self, azimuth: float):
        angle = np.radians(azimuth)
        self.azimuth = azimuth
        self._cos, self._sin = np.cos(angle), np.sin(angle)

    def __call__(self, v: np.ndarray) -> np.ndarray:
        x, y, z = v
        return np.array([self._cos * x + self._sin * y, self._cos * y - self._sin * x, z])

    def refuse(self, table: Section, kind: str) -> None:
        if self.azimuth % 360 != 0:
            raise ValueError(
                f"{table.path}: {table.name} is a {kind}, whose sides lie along x and y: it needs"
                f" light.sun_azimuth_deg = 0, not {self.azimuth:g}; turn the camera instead."
            )


def _light(table: Section, wavelength: np.ndarray) -> tuple[Light, float]:
    zenith = table.number("sun_zenith_deg", 0.0, 89.9)
    azimuth = table.number("sun_azimuth_deg", -360.0, 360.0, 0.0)
    kind = table.text("spectrum", default="D65")
    scale = table.number("scale", 0.0, _NO_LIMIT, 1.0)
    diffuse = None
    if kind == "clear sky":
        direct, diffuse = clear_sky(
            wavelength,
            zenith,
            aerosol=table.number("aerosol_optical_depth_500", 0.0, 5.0, 0.1),
            water_vapour=table.number("precipitable_water_cm", 0.0, 10.0, 1.5),
            ozone=table.number("ozone_atm_cm", 0.0, 1.0, 0.3),
        )
    else:
        direct = _shape(table, "spectrum", kind, wavelength)
        share = table.number("diffuse_share", 0.0, 0.99, 0.0)
        if share > 0:
            horizontal = direct * np.cos(np.radians(zenith))
            diffuse = share / (1 - share) * horizontal / np.pi
    table.finish()
    diffuse = None if diffuse is None else jnp.asarray(scale * diffuse)
    return Light(zenith, jnp.asarray(scale * direct), diffuse), azimuth


def _shape(table: Section, key: str, kind: str, wavelength: np.ndarray) -> np.ndarray:
    """A spectrum by name or file."""
    if kind == "D65":
        return spectrum.daylight(wavelength)
    if kind == "flat":
        return np.ones_like(wavelength)
    if kind.endswith(".csv"):
        return spectra(table.file(key), wavelength, "value")[0]
    raise table.error(key, kind, "D65, flat, clear sky (the sun's) or a csv file")


def _reflectance(table: Section, wavelength: np.ndarray) -> jnp.ndarray:
    wanted = "a number, a ColorChecker patch or a csv file with wavelength_nm and reflectance"
    value = table.take("reflectance", wanted)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return jnp.asarray(np.full(wavelength.size, table.number("reflectance", 0.0, 1.0)))
    if not isinstance(value, str):
        raise table.error("reflectance", value, wanted)
    if value.endswith(".csv"):
        result = spectra(table.file("reflectance"), wavelength, "reflectance")[0]
    else:
        try:
            result = spectrum.colour_checker(value, wavelength)
        except ValueError as error:
            raise table.error("reflectance", value, f"{wanted}. {error}") from None
    result = result * table.number("reflectance_scale", 0.0, 100.0, 1.0)
    if result.min() < 0 or result.max() > 1:
        low, high = result.min(), result.max()
        raise table.error("reflectance", value, f"between 0 and 1, not {low:g} to {high:g}")
    return jnp.asarray(result)


def _inelastic(table: Section, water: IOPs | Layers) -> Inelastic:
    """The processes of a section; ValueError where the water lacks what they need."""
    quantum_yield = table.number("chlorophyll_quantum_yield", 0.0, 1.0, 0.02)
    found = Inelastic(
        Raman() if table.flag("raman") else None,
        ChlorophyllFluorescence(quantum_yield) if table.flag("chlorophyll_fluorescence") else None,
        CDOMFluorescence() if table.flag("cdom_fluorescence") else None,
    )
    table.finish()
    if not found.terms:
        raise ValueError(
            "no process is on: set raman, chlorophyll_fluorescence or cdom_fluorescence to true, "
            "or leave the table out."
        )
    for iops in water.iops if isinstance(water, Layers) else (water,):
        for term in found.terms:
            term.coefficient(iops)
    return found


def _object(table: Section, wavelength: np.ndarray, turn: _Turn) -> AbstractObject:
    kind = table.text("kind", ("sphere", "box", "height field"))
    reflectance = _reflectance(table, wavelength)
    if kind == "sphere":
        thing = Sphere(
            turn(table.vector("centre_m")), table.number("radius_m", 1e-6, 1e4), reflectance
        )
    elif kind == "box":
        turn.refuse(table, kind)
        lower, upper = table.vector("lower_m"), table.vector("upper_m")
        if not np.all(lower < upper):
            raise table.error("upper_m", upper.tolist(), f"above lower_m = {lower.tolist()}")
        thing = Box(lower, upper, reflectance)
    else:
        turn.refuse(table, kind)
        thing = HeightField(
            grid(table.file("depth_m")),
            table.number("x0_m", -_NO_LIMIT, _NO_LIMIT, 0.0),
            table.number("y0_m", -_NO_LIMIT, _NO_LIMIT, 0.0),
            table.number("spacing_m", 1e-6, 1e4),
            reflectance,
        )
    table.finish()
    return thing


def _waves(table: Section, azimuth: float) -> Waves:
    keys = {
        "tile": table.number("tile_m", 0.1, 1e3, 4.0),
        "slope": table.number("slope", 0.0, 0.3, 0.1),
        "longest": table.number("longest_m", 0.01, 1e3, 2.0),
        "shortest": table.number("shortest_m", 1e-3, 1e3, 0.2),
        "wind": table.number("wind_azimuth_deg", -360.0, 360.0, 0.0) - azimuth,
        "seed": table.integer("seed", 0, 2**31, 0),
        "time": table.number("time_s", 0.0, 1e6, 0.0),
    }
    table.finish()
    try:
        return random_waves(**keys)
    except ValueError as error:
        raise ValueError(f"{table.path}: {table.name}: {error}") from None


def _ranges(table: Section, wavelength: np.ndarray) -> RangeMap:
    path = table.file("range_m")
    pixels, unit = depths(path)
    # The unit of COLMAP is arbitrary, and its depths lie along the axis.
    kind = table.text("kind", ("line", "z"), "z" if unit is None else "line")
    unit = table.number("m_per_unit", 1e-12, 1e12, *(() if unit is None else (unit,)))
    if pixels.shape[2] != 1:
        wanted = f"a map of one channel, not {pixels.shape[2]}"
        raise table.error("range_m", table.text("range_m"), wanted)
    reflectance, texture = _reflectance(table, wavelength)[None], None
    if table.has("texture"):
        texture = picture(table.file("texture"))[:, :, :3]
        if texture.shape[:2] != pixels.shape[:2] or texture.shape[2] not in (1, 3):
            wanted = f"a linear picture of 1 or 3 channels and the map's {pixels.shape[:2]} pixels"
            raise table.error("texture", table.text("texture"), f"{wanted}, not {texture.shape}")
        texture = np.clip(texture, 0.0, 1.0)
        if texture.shape[2] == 3:
            reflectance = reflectance * colour_parts(wavelength)
    table.finish()
    try:
        return RangeMap(unit * pixels[:, :, 0], reflectance, texture, kind)
    except ValueError as error:
        raise ValueError(f"{table.path}: {table.name}: {error}") from None


def _lamp(table: Section, wavelength: np.ndarray, turn: _Turn) -> AbstractLamp:
    kind = table.text("kind", ("point", "spot"))
    position = turn(table.vector("position_m"))
    shape = _shape(table, "spectrum", table.text("spectrum", default="flat"), wavelength)
    intensity = jnp.asarray(table.number("intensity_w_sr_nm", 0.0, _NO_LIMIT) * shape)
    if kind == "point":
        lamp = PointLamp(position, intensity)
    else:
        lamp = SpotLamp(
            position,
            turn(table.vector("direction")),
            table.number("half_angle_deg", 0.01, 90.0),
            intensity,
        )
    table.finish()
    return lamp


def _camera(table: Section, wavelength: np.ndarray, turn: _Turn) -> tuple[Camera, Sensor]:
    position = table.vector("position_m")
    if table.has("look_at_m"):
        direction = table.vector("look_at_m") - position
    else:
        direction = table.vector("direction")
    up = table.vector("up", np.array([0.0, 0.0, -1.0]))
    response = _response(table, wavelength)
    bits = table.integer("bits", 1, 16, None)
    sensor = Sensor(
        None
        if table.take("exposure", "a number or auto", "auto") == "auto"
        else table.number("exposure", 1e-30, _NO_LIMIT),
        table.number("full_well_electrons", 1.0, _NO_LIMIT, None),
        table.number("read_noise_electrons", 0.0, _NO_LIMIT, None),
        bits,
    )
    try:
        camera = Camera(
            turn(position),
            turn(direction),
            turn(up),
            table.number("fov_deg", 1e-3, 179.0),
            table.integer("width", 1, 20000),
            table.integer("height", 1, 20000),
            response,
            table.number("flat_port_index", 1.0, 2.0, None),
        )
    except ValueError as error:
        raise ValueError(f"{table.path}: {table.name}: {error}") from None
    table.finish()
    return camera, sensor


def _response(table: Section, wavelength: np.ndarray) -> spectrum.Response:
    name = table.text("response", default="CIE 1931")
    if name == "CIE 1931":
        response = spectrum.cie_1931()
    elif name == "generic":
        response = spectrum.generic_camera()
    elif name.endswith(".csv"):
        names, columns = numbers(table.file("response"))
        if names[0] != "wavelength_nm":
            raise table.error("response", name, "a csv whose first column is wavelength_nm")
        response = spectrum.Response(columns[1:], columns[0], tuple(names[1:]))
    else:
        try:
            response = spectrum.camera_response(name)
        except ValueError as error:
            wanted = "CIE 1931, generic, a csv file or a camera by name"
            raise table.error("response", name, f"{wanted}. {error}") from None
    lost = float(np.max(np.asarray(response.outside(wavelength))))
    if lost > 0.05:
        warnings.warn(
            f"{table.path}: {100 * lost:.0f} % of a channel of {name} lies outside the bands.",
            stacklevel=3,
        )
    return response
