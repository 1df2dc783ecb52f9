"""What is lit, by what light, and seen by which camera."""

# fmt: off
# isort: off
from oceaninv.scene.camera import Camera, Sensor
from oceaninv.scene.light import CardioidalSky, Light, PointLamp, SpotLamp, TabulatedSky
from oceaninv.scene.objects import Box, HeightField, Sphere
from oceaninv.scene.range_map import RangeMap
from oceaninv.scene.scene import FlatSurface, Floor, Scene
from oceaninv.scene.scene_file import SceneFile, load_scene

__all__ = [
    "Box", "Camera", "CardioidalSky", "FlatSurface", "Floor", "HeightField", "Light", "PointLamp",
    "RangeMap", "Scene", "SceneFile", "Sensor", "Sphere", "SpotLamp", "TabulatedSky", "load_scene"]
