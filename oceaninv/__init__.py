"""Differentiable inverse rendering under water.

Constituents -> inherent optical properties -> light field -> what a sensor saw: every arrow is a
pure, jit-able, differentiable JAX function.
"""

from oceaninv import (
    attenuation,
    inelastic,
    media,
    mie,
    mitsuba,
    objects,
    particles,
    phase,
    spectrum,
    tables,
    water,
    waves,
)
from oceaninv.bio_optics import (
    CDOM,
    BioOpticalModel,
    Constituents,
    Detritus,
    Minerals,
    Phytoplankton,
    gutierrez2008,
    jerlov,
)
from oceaninv.camera import Camera, Sensor
from oceaninv.fidelity import Plan, plan
from oceaninv.inelastic import CDOMFluorescence, ChlorophyllFluorescence, Inelastic, Raman
from oceaninv.iops import IOPs, Layers
from oceaninv.light import CardioidalSky, Light, PointLamp, SpotLamp, TabulatedSky
from oceaninv.objects import Box, HeightField, Sphere
from oceaninv.optics import Rays
from oceaninv.range_map import RangeMap
from oceaninv.scene import FlatSurface, Floor, Scene
from oceaninv.scene_file import SceneFile, load_scene
from oceaninv.transport import apparent
from oceaninv.transport.base import Estimate, Irradiance
from oceaninv.transport.energy import EnergyBudget, energy_budget
from oceaninv.transport.four_stream import FourStream
from oceaninv.transport.front import irradiance, photograph, radiance
from oceaninv.transport.kd import KdTransport
from oceaninv.transport.monte_carlo import MonteCarlo
from oceaninv.transport.plane_parallel import PlaneParallel
from oceaninv.transport.shadows import Shadows
from oceaninv.transport.two_stream import TwoStream

__all__ = [
    "CDOM",
    "BioOpticalModel",
    "Box",
    "CDOMFluorescence",
    "Camera",
    "CardioidalSky",
    "ChlorophyllFluorescence",
    "Constituents",
    "Detritus",
    "EnergyBudget",
    "Estimate",
    "FlatSurface",
    "Floor",
    "FourStream",
    "HeightField",
    "IOPs",
    "Inelastic",
    "Irradiance",
    "KdTransport",
    "Layers",
    "Light",
    "Minerals",
    "MonteCarlo",
    "Phytoplankton",
    "Plan",
    "PlaneParallel",
    "PointLamp",
    "Raman",
    "RangeMap",
    "Rays",
    "Scene",
    "SceneFile",
    "Sensor",
    "Shadows",
    "Sphere",
    "SpotLamp",
    "TabulatedSky",
    "TwoStream",
    "apparent",
    "attenuation",
    "energy_budget",
    "gutierrez2008",
    "inelastic",
    "irradiance",
    "jerlov",
    "load_scene",
    "media",
    "mie",
    "mitsuba",
    "objects",
    "particles",
    "phase",
    "photograph",
    "plan",
    "radiance",
    "spectrum",
    "tables",
    "water",
    "waves",
]
