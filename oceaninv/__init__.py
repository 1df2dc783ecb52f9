"""Inverse rendering under water: constituents -> optics -> light field -> sensor, in pure JAX."""

# fmt: off
# isort: off
from oceaninv import mie, transport, water
from oceaninv.fidelity import Plan, plan
from oceaninv.foundation import former_names  # noqa: F401
from oceaninv.foundation import interface_optics as optics, spectrum, tables
from oceaninv.foundation.provenance import version as _version
from oceaninv.foundation.interface_optics import Rays
from oceaninv.mie import media, particles
from oceaninv.rendering.display import show
from oceaninv.scene import (
    Box, Camera, CardioidalSky, FlatSurface, Floor, HeightField, Light, PointLamp, RangeMap, Scene,
    SceneFile, Sensor, Sphere, SpotLamp, TabulatedSky, camera, light, load_scene, objects,
    range_map, scene_file, waves)
from oceaninv.transport import (
    EnergyBudget, Estimate, FourStream, Irradiance, KdTransport, MonteCarlo, PlaneParallel,
    Shadows, TwoStream, WithObjects, apparent, energy_budget, irradiance, photograph, radiance)
from oceaninv.water import (
    CDOM, BioOpticalModel, CDOMFluorescence, ChlorophyllFluorescence, Constituents, Detritus, IOPs,
    Inelastic, Layers, Minerals, Phytoplankton, Raman, attenuation, bio_optics, disc_transmission,
    gutierrez2008, inelastic, iops, jerlov, measured_iops, phase, target_transmission)
from oceaninv.water import mitsuba_export as mitsuba

__version__ = _version()

__all__ = [
    "CDOM", "BioOpticalModel", "Box", "CDOMFluorescence", "Camera", "CardioidalSky",
    "ChlorophyllFluorescence", "Constituents", "Detritus", "EnergyBudget", "Estimate",
    "FlatSurface", "Floor", "FourStream", "HeightField", "IOPs", "Inelastic", "Irradiance",
    "KdTransport", "Layers", "Light", "Minerals", "MonteCarlo", "Phytoplankton", "Plan",
    "PlaneParallel", "PointLamp", "Raman", "RangeMap", "Rays", "Scene", "SceneFile", "Sensor",
    "Shadows", "Sphere", "SpotLamp", "TabulatedSky", "TwoStream", "WithObjects", "apparent",
    "attenuation", "bio_optics", "camera", "disc_transmission", "energy_budget", "gutierrez2008",
    "inelastic", "iops", "irradiance", "jerlov", "light", "load_scene", "measured_iops", "media",
    "mie", "mitsuba", "objects", "optics", "particles", "phase", "photograph", "plan", "radiance",
    "range_map", "scene_file", "show", "spectrum", "tables", "target_transmission", "transport",
    "water", "waves"]
