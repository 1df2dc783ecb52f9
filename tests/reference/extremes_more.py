"""Extremes of what is not water under a sun: spheres and media, cameras, things, inelastic light,
random walks and the exact transport.  See extremes.py for what a case is."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from oceaninv.foundation import interface_optics
from oceaninv.mie import media, sphere
from oceaninv.scene import objects
from oceaninv.water import phase
from tests.reference.extremes import (
    ASYMMETRY,
    COEFFICIENT,
    COSINE,
    INDEX,
    LENGTH,
    LOOK,
    SHARE,
    ZENITH,
    Case,
    _deep,
    _irradiance_deep,
    _over_floor,
    _radiance_deep,
    _radiance_floor,
    _water,
)

# Two precisions may see a line on either side of an edge: only finite numbers are asked for.
EITHER = np.inf
SIZE = (0.0, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 10.0, 60.0)
REAL = (1.0, 1.0 + 1e-9, 1.05, 1.33, 1.6, 2.5)
IMAGINARY = (0.0, 1e-12, 1e-6, 1e-2, 1.0)
PLACE = (-10.0, -1.0, -1e-6, 0.0, 1e-6, 1.0, 10.0)
PERCENT = (0.0, 1e-6, 0.05, 0.7, 1.5, 10.0)
FRACTION = (0.0, 1e-12, 1e-6, 1e-3, 0.1)
BANDS = np.array([420.0, 490.0, 690.0])


def _turned(across, down):
    """A unit vector."""
    level = jnp.sqrt(jnp.maximum(1.0 - down**2, 0.0))
    return jax.lax.stop_gradient(
        jnp.stack([level * jnp.cos(across), level * jnp.sin(across), down])
    )


def _efficiencies(p):
    return jnp.stack(sphere.efficiencies(p[0], jax.lax.complex(p[1], p[2]), max_size=61.0))


def _sections(p):
    found = sphere.cross_sections(
        p[0], 550.0 + 0.0 * p[0], jax.lax.complex(p[1], p[2]), p[3], max_size=80.0
    )
    return jnp.stack(found)


def _mie_phase(p):
    index = jax.lax.complex(p[2], p[3])
    return sphere.phase_function(p[0], p[1], 550.0 + 0.0 * p[1], index, 1.34 + 0.0 * p[1], 80.0)


def _bulk(medium, *wavelength):
    found = medium.bulk(np.array(wavelength))
    return jnp.concatenate([found.a, found.b, found.g, found.index_shift])


def _milk(p):
    return _bulk(media.milk(p[0], p[1], radii=12), 550.0)


def _camera(p):
    direction = jnp.stack([jnp.cos(p[0]), jnp.sin(p[0]), p[1]])
    camera = oi.Camera(
        jnp.zeros(3), direction, jnp.array([0.0, 0.0, -1.0]), p[2], 3, 2, _response(), p[3]
    )
    return camera.rays().direction


@functools.cache
def _response():
    with jax.ensure_compile_time_eval():
        return oi.spectrum.generic_camera()


def _sensor(p):
    values = jnp.stack([p[0], p[1], 0.5 * p[0]]).reshape(1, 1, 3)
    return oi.Sensor(exposure=p[2]).expose(values)


def _noisy_sensor(p):
    values = jnp.stack([p[0], p[1], 0.5 * p[0]]).reshape(1, 1, 3)
    return oi.Sensor(exposure=p[2], full_well=p[3]).expose(values, jax.random.key(0))


def _metered(p):
    return oi.Sensor().expose(jnp.stack([p[0], p[1], 0.5 * p[0]]).reshape(1, 1, 3))


def _met(thing, origin, direction):
    hit = objects.nearest((thing,), origin, direction)
    # A miss is infinitely far.
    distance = jnp.where(jnp.isfinite(hit.distance), hit.distance, -1.0)
    return jnp.concatenate([distance[None], hit.normal, hit.reflectance])


def _sphere(p):
    thing = oi.Sphere(jnp.stack([0 * p[0], 0 * p[0], 5 + 0 * p[0]]), p[0], p[6:7])
    return _met(thing, p[1:4], _turned(p[4], p[5]))


def _box(p):
    lower = jnp.stack([0 * p[0], -p[0], 4 + 0 * p[0]])
    return _met(oi.Box(lower, lower + p[0], p[6:7]), p[1:4], _turned(p[4], p[5]))


def _relief(p):
    depth = 5.0 + jnp.stack([jnp.stack([p[0], 0 * p[0], -p[0]]), jnp.stack([p[1], p[0], 0 * p[0]])])
    thing = oi.HeightField(depth, -2.0, -1.0, 2.0, p[6:7])
    return _met(thing, p[2:5] * jnp.array([0.3, 0.2, 0.0], p.dtype), _turned(p[5], p[6] - 0.5))


def _lamp(p):
    return oi.PointLamp(jnp.zeros(3, p.dtype), p[:1]).along(_turned(p[1], p[2]))


def _overcast(p):
    sky = oi.TabulatedSky(np.array([0.0, 40.0, 90.0]), p[:3] + 1e-12)
    cosine = jnp.abs(p[3:4])
    return jnp.concatenate([sky.shape(cosine), oi.CardioidalSky().shape(cosine)])


def _emitted(p):
    water = oi.BioOpticalModel().iops(
        oi.Constituents(p[0], cdom=p[1], detritus=0.0 * p[0]), np.array([420.0, 450.0, 685.0])
    )
    processes = oi.Inelastic(
        oi.Raman(p[2]), oi.ChlorophyllFluorescence(p[3]), oi.CDOMFluorescence(p[4])
    )
    return jnp.stack([matrix for matrix, _ in oi.inelastic.sources(processes, water)])


def _mixture(p):
    shapes = (phase.HenyeyGreenstein(0.9), phase.Isotropic())
    mixed = phase.Mixture(jnp.stack([p[0], 1.0 - p[0]]), tuple(jax.tree.map(_as(p), shapes)))
    return jnp.concatenate([mixed(p[1:2]), mixed.moments(6), mixed.backscatter_ratio[None]])


def _as(p):
    return lambda leaf: leaf.astype(p.dtype)


def _petzold(p):
    return jax.tree.map(_as(p), phase.petzold())(p[:1])


def _walked(p):
    """Geometry is not differentiable by random walks: an eye at 1 m, looking aslant."""
    a, b, g, rho = p
    one = jnp.ones_like(a)[None]
    scene = oi.Scene(
        _water(a, b, g), oi.Light(30.0, one), oi.FlatSurface(), oi.Floor(3.0, rho[None])
    )
    rays = oi.Rays(jnp.array([[0.0, 0.0, 1.0]], p.dtype), jnp.array([[0.6, 0.0, 0.8]], p.dtype))
    found = oi.radiance(scene, rays, oi.MonteCarlo(paths=128, bounces=4), key=jax.random.key(0))
    return jnp.concatenate([found.value[0], found.stderr[0]])


def _walked_irradiance(p):
    a, b, g = p
    scene = oi.Scene(_water(a, b, g), oi.Light(30.0, jnp.ones_like(a)[None]), oi.FlatSurface())
    found = oi.irradiance(
        scene, jnp.array([1.0], p.dtype), oi.MonteCarlo(paths=128, bounces=4), key=jax.random.key(0)
    )
    return jnp.concatenate([found.Ed.value[0], found.Eu.value[0], found.E0.value[0]])


EXACT = oi.PlaneParallel(4, 2)


def _exact_floor(p):
    depths = (p[7] * p[4])[None]
    found = oi.irradiance(_over_floor(p), depths, EXACT)
    return jnp.concatenate([found.Ed.value[0], found.Eu.value[0], found.E0.value[0]])


def _apparent(p):
    found = oi.apparent.apparent(_deep(p), p[4:5], EXACT)
    return jnp.stack([found.Kd, found.K0, found.R, found.mean_cosine])


def more() -> tuple[Case, ...]:
    """Every case but those of the exact transport."""
    positive = COEFFICIENT[3:]
    angle = (0.0, 1e-6, 0.7, 1.5707963, 3.1)
    rows = (
        Case("Mie, efficiencies", _efficiencies, (SIZE, REAL[2:], IMAGINARY), 3e-3, 1e-3, True),
        # Of next to nothing that is scattered, no precision knows the direction.
        Case("Mie, index-matched", _efficiencies, (SIZE, REAL[:3], IMAGINARY[:3]), EITHER, 1e-3,
             True),
        Case("Mie, cross sections", _sections, ((*SIZE[:-2], 3.0), REAL[2:], IMAGINARY[:-1],
                                                (1.0, 1.34)), 3e-3, 1e-3, True),
        Case("Mie, phase function", _mie_phase, (COSINE, (*SIZE[3:-2], 3.0), REAL[2:],
                                                 IMAGINARY[:-1]), 5e-3, 1e-2, True),
        Case("milk", _milk, (PERCENT, PERCENT), 1e-3, 1e-3, True),
        Case("milk, fitted", lambda p: jnp.stack(media.milk_fit(p[0], p[1])), (PERCENT, PERCENT)),
        Case("sea of algae and minerals", lambda p: _bulk(media.natural_water(
            algae=p[0], minerals=p[1], radii=12), 550.0), (FRACTION, FRACTION), 1e-4, 1e-6, True),
        Case("ice with algae and minerals", lambda p: _bulk(media.ice(
            minerals=p[0], algae=p[1], radii=12), 550.0), (FRACTION, FRACTION), 1e-4, 1e-6, True),
        Case("brine, aspect", lambda p: media.brine_aspect(p[0]),
             ((1.0, 30.0, 31.0, 500.0, 1e4),)),
        Case("camera", _camera, (angle, (-5.0, 0.0, 1.0), (1e-3, 60.0, 179.0), INDEX), 2e-3),
        Case("sensor", _sensor, (COEFFICIENT, COEFFICIENT, positive)),
        Case("sensor, noisy", _noisy_sensor, (COEFFICIENT, COEFFICIENT, positive, (1.0, 1e5)),
             EITHER),
        Case("sensor, metering", _metered, (COEFFICIENT, COEFFICIENT)),
        Case("sphere", _sphere, ((1e-3, 1.0, 5.0, 1e3), PLACE, PLACE, PLACE, angle, LOOK, SHARE),
             EITHER),
        Case("box", _box, ((1e-3, 1.0, 5.0, 1e3), PLACE, PLACE, PLACE, angle, LOOK, SHARE),
             EITHER),
        Case("height field", _relief, ((0.0, 1e-6, 1.0), (0.0, 2.0), PLACE, PLACE, PLACE, angle,
                                       SHARE), EITHER, 1e-6, True),
        Case("lamp", _lamp, (COEFFICIENT, angle, LOOK)),
        Case("sky, tabulated and overcast", _overcast, (COEFFICIENT,) * 3 + (COSINE,), 1e-4, 1e-2),
        Case("half sine of the scattering angle", lambda p: interface_optics.scattering_half_sine(
            _turned(p[0], p[1])[None], p[2]), (angle, LOOK, (1e-3, 0.6656, 1.0)), 1e-4, 1e-2),
        Case("inelastic sources", _emitted, (COEFFICIENT, COEFFICIENT, SHARE, SHARE, COEFFICIENT)),
        Case("mixture", _mixture, (SHARE, COSINE)),
        Case("Petzold", _petzold, (COSINE,), 1e-3),
        Case("random walks, radiance", _walked, (COEFFICIENT, COEFFICIENT, ASYMMETRY, SHARE),
             EITHER, 1e-6, True),
        Case("random walks, irradiance", _walked_irradiance, (COEFFICIENT, COEFFICIENT, ASYMMETRY),
             EITHER, 1e-6, True),
    )  # fmt: skip
    return rows


def exact() -> tuple[Case, ...]:
    """Plane-parallel: the eigenproblem of every point."""
    deep = (COEFFICIENT, COEFFICIENT, ASYMMETRY, ZENITH)
    over = (*deep, LENGTH[2:], SHARE, SHARE, SHARE)
    return (
        Case("exact, irradiance, deep", functools.partial(_irradiance_deep, EXACT),
             (*deep, LENGTH), 2e-2, 1e-3, True, 1e-5),
        Case("exact, irradiance, floor", _exact_floor, over, 2e-2, 1e-3, True, 1e-5),
        Case("exact, radiance, deep", functools.partial(_radiance_deep, EXACT),
             (*deep, LENGTH, LOOK), 2e-2, 1e-3, True, 1e-5),
        Case("exact, radiance, floor", functools.partial(_radiance_floor, EXACT),
             (*over, LOOK), 2e-2, 1e-3, True, 1e-5),
        # Where light has died out (e^-87 in single precision) nothing attenuates it.
        Case("exact, apparent", _apparent, ((1e-3, 0.1, 1.0), (0.0, 1e-9, 0.1, 1.0), ASYMMETRY,
                                            ZENITH, LENGTH[:-2]), 5e-2, 1e-2, True, 1e-5),
    )  # fmt: skip
