"""What users get wrong first is refused in a sentence that says what to do.

In a process of its own: in this one, the run-time checks of all tests would speak first."""

import os
import subprocess
import sys

import pytest

from tests.paths import ROOT

CALLS = {
    "oi.Scene(light, water)": "ValueError: water must be IOPs or Layers, but came as Light; the "
    "order is Scene(water, light, surface, floor, objects, lamps, inelastic).",
    "oi.Scene(water, light, oi.Floor(3.0, one))": "ValueError: surface must be FlatSurface or "
    "None, but came as Floor",
    "oi.Scene(water, light, oi.FlatSurface)": "ValueError: surface must be FlatSurface or None, "
    "but came as the class FlatSurface",
    "oi.Scene(water, light, objects=water)": "ValueError: objects[0] must be a Sphere, Box or "
    "HeightField, but came as IOPs",
    "oi.Scene(water, light, lamps=[3])": "ValueError: lamps[0] must be a PointLamp or SpotLamp, "
    "but came as int",
    "oi.Layers([water, water], [8.0])": "ValueError: iops must be a sequence of IOPs, one for each "
    "layer from the surface down: Layers(interfaces, iops), first the depths, then the waters.",
    "oi.Layers([8.0], water)": "ValueError: iops must be a sequence of IOPs",
    "oi.Layers([water, water], 8.0)": "ValueError: iops must be a sequence of IOPs",
    "oi.irradiance(scene, 1.0, oi.TwoStream)": "ValueError: transport is the class TwoStream: "
    "write TwoStream()",
    "oi.irradiance(scene, 1.0, oi.WithObjects(oi.FourStream))": "ValueError: transport is the "
    "class FourStream: write FourStream()",
    "oi.irradiance(scene, 1.0, 'two-stream')": "ValueError: transport is 'two-stream'; it must be "
    "a model such as oi.TwoStream() or oi.PlaneParallel(16).",
    "oi.photograph(scene, camera, oi.TwoStream)": "ValueError: transport is the class TwoStream",
    "fitting.fit_profile(profile, transport=oi.TwoStream)": "ValueError: transport is the class",
    "oi.Constituents(chlorofyl=1.0)": "ValueError: constituent 'chlorofyl' is unknown. Near "
    "it: chlorophyll. A constituent of your own needs a name that differs more.",
    "oi.Constituents(Cdom=1.0)": "ValueError: constituent 'Cdom' is unknown. Near it: cdom.",
    "oi.Constituents(chl=1.0)": "ValueError: constituent 'chl' is unknown. Near it: chlor",
    "oi.Constituents(1.0).cdom": "AttributeError: these Constituents hold no 'cdom'; they hold "
    "chlorophyll.",
    "oi.Constituents([1.0, 2.0])": "ValueError: chlorophyll must be one number, not an array of "
    "shape (2,): for many, build them one by one or inside jax.vmap.",
    "oi.Light([30.0, 40.0], one)": "ValueError: zenith must be one number",
    "oi.Light(30.0, 1.0)": "ValueError: direct must hold one value per wavelength",
    "oi.Floor([3.0, 4.0], one)": "ValueError: depth must be one number",
    "oi.FlatSurface([1.34])": "ValueError: index must be one number",
    "oi.Camera([0, 0], [0, 1, 0], [0, 0, -1], 60.0, 4, 3, camera.response)": "ValueError: "
    "position must be three numbers, not of shape (2,): x, y and the depth z, downwards.",
    "oi.Camera([0, 0, 1], [0, 1, 0], [0, 0, -1], [60.0], 4, 3, camera.response)": "ValueError: "
    "fov must be one number",
    "(oi.Constituents(2.0, bubbles=3.0, detritus_2=1.0).bubbles).item()": "3.0",
    "copy.deepcopy(oi.Constituents(2.0)).chlorophyll.item()": "2.0",
    "pickle.loads(pickle.dumps(oi.Constituents(2.0))).chlorophyll.item()": "2.0",
}
_SCRIPT = """
import copy, pickle, sys
import numpy as np
import fitting
import oceaninv as oi
one = np.ones(4)
light = oi.Light(30.0, one)
water = oi.BioOpticalModel().iops(oi.Constituents(1.0), oi.spectrum.bands(4))
scene = oi.Scene(water, light)
response = oi.spectrum.generic_camera()
camera = oi.Camera([0, 0, 1], [0, 1, 0], [0, 0, -1], 60.0, 4, 3, response)
depth = np.arange(1.0, 9.0)
profile = fitting.Profile(depth, [490.0], np.exp(-0.1 * depth)[:, None])
for call in sys.stdin.read().splitlines():
    try:
        print(eval(call))
    except Exception as error:
        print(f"{type(error).__name__}: {error}".replace(chr(10), " "))
"""


@pytest.fixture(scope="module")
def answers():
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT],
        input="\n".join(CALLS),
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
    return dict(zip(CALLS, done.stdout.splitlines(), strict=True))


@pytest.mark.parametrize("call", CALLS)
def test_message(answers, call):
    assert answers[call].startswith(CALLS[call])
