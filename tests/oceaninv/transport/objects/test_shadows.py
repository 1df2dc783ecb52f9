"""Objects and lamps on top of a closed form: light on them, shadows, images in the surface."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.transport.objects import shadows
from oceaninv.transport.objects._lamplight import _lit

F = jnp.asarray([1.0, 2.0])
RHO = jnp.asarray([0.5, 0.2])
BALL = oi.Sphere((0.0, 0.0, 4.0), 1.0, RHO)
FLOOR = oi.Floor(7.0, 0.5 * RHO)
CLEAR = 1e-7
PHASE = oi.phase.HenyeyGreenstein(jnp.asarray(0.8))


@eqx.filter_jit
def _seen(scene, rays, transport):
    return oi.radiance(scene, rays, transport)


@eqx.filter_jit
def _shaded(scene, rays, transport, end):
    return transport._shaded_path(scene, rays, shadows._possible(scene, rays, end))


def _scene(a=CLEAR, b=CLEAR, zenith=30.0, surface=None, objects=(BALL,), **more):
    water = oi.IOPs(
        [500.0, 600.0],
        a * jnp.ones(2),
        b * jnp.ones(2),
        PHASE,
    )
    return oi.Scene(water, oi.Light(zenith, F), surface, FLOOR, objects, **more)


def _rays(origin, *targets):
    away = np.asarray(targets, float) - np.asarray(origin, float)
    return oi.Rays(origin, away / np.linalg.norm(away, axis=1, keepdims=True))


def test_lambert_in_clear_water():
    """Nothing but geometry: the lit top, the dark side, the floor lit and in shadow."""
    sun = np.array([0.5, 0.0, -np.sqrt(0.75)])
    top, side = np.array([0.0, -0.6, -0.8]), np.array([-0.8, -0.6, 0.0])
    shadow = np.array([0.0, 0.0, 4.0]) + sun / sun[2] * 3.0
    shadow[2] = 7.0
    eye = (-4.0, -4.0, 2.0)
    centre = np.array([0.0, 0.0, 4.0])
    rays = _rays(eye, centre + top, centre + side, shadow, [-6.0, -2.0, 7.0])
    value = _seen(_scene(), rays, oi.TwoStream()).value
    expected = [
        RHO / np.pi * F * (top @ sun),
        0 * F,
        0 * F,
        0.5 * RHO / np.pi * F * np.sqrt(0.75),
    ]
    # The floor lights the ball from below, uniformly: all of its light on a facet that looks down,
    # half of it on an upright one.
    bounced = RHO / np.pi * 0.5 * RHO * F * np.sqrt(0.75)
    expected[0] = expected[0] + bounced * (1 - 0.8) / 2
    expected[1] = expected[1] + bounced / 2
    np.testing.assert_allclose(value, np.stack(expected), rtol=0.01, atol=3e-5)
    np.testing.assert_allclose(value[2:], np.stack(expected)[2:], rtol=1e-5, atol=3e-5)


def test_things_out_of_sight_change_nothing():
    far = oi.Sphere((500.0, 500.0, 4.0), 1.0, RHO)
    rays = _rays((-4.0, -4.0, 2.0), (0.0, 0, 4.5), (0.0, 0, 7), (0.0, 0, 1))
    scene = _scene(0.1, 0.2, objects=(far,))
    bare = dataclasses.replace(scene, objects=())
    np.testing.assert_allclose(
        _seen(scene, rays, oi.TwoStream()).value, _seen(bare, rays, oi.TwoStream()).value, 1e-10
    )


BOX = oi.Box((-0.7, -0.7, 3.3), (0.7, 0.7, 4.7), RHO)


@pytest.mark.parametrize("thing", [BALL, BOX], ids=["sphere", "box"])
def test_shadow_in_the_water_against_quadrature(thing):
    """Sunlight scattered once that is missing, against the sum over 20000 points of each ray."""
    scene = _scene(0.1, 0.3, objects=(thing,))
    eye = np.array([0.2, -5.0, 4.5])
    targets = np.array(
        [[-1.0, 0, 5.5], [-1.3, 1, 6.0], [0.5, 0.2, 6.9], [-1.0, 0, 4.9], [-2, 2, 6]]
    )
    rays = _rays(eye, *targets)
    end = jnp.asarray([5.5, 6.0, 4.0, 9.0, 9.0])
    steps = 600
    value = _shaded(scene, rays, oi.WithObjects(oi.TwoStream(), steps), end)
    attenuation = shadows.DeltaScaledWater(scene.water).attenuation
    sun = np.array([0.5, 0.0, -np.sqrt(0.75)])
    for d, length, got in zip(np.asarray(rays.direction), end, np.asarray(value), strict=True):
        t = (np.arange(20000) + 0.5) / 20000 * float(length)
        x = eye + t[:, None] * d
        dark = jax.vmap(
            lambda y, o=(thing,): oi.objects.blocked(o, y, jnp.asarray(sun), jnp.asarray(jnp.inf))
        )(jnp.asarray(x))
        turn = np.linalg.norm(d - sun) / 2  # sine of half the angle
        small = -np.expm1(-2 * turn / attenuation.aureole)
        c = 0.4 - float(attenuation.forward[0]) * small
        fade = np.exp(-c * (x[:, 2] / np.sqrt(0.75) + t))
        beta = 0.3 * float(PHASE(jnp.asarray(1 - 2 * turn**2)))
        expected = np.sum(fade * np.asarray(dark)) * float(length) / 20000 * beta * np.asarray(F)
        np.testing.assert_allclose(got, expected, rtol=8e-3, atol=1e-7)
    assert np.count_nonzero(value[:, 0]) >= 3


@pytest.mark.slow
def test_image_in_the_surface():
    """Beyond the critical angle the surface is a mirror: the ball's image, one reflection on."""
    surface = oi.FlatSurface(1.34)
    scene = _scene(zenith=0.0, surface=surface)
    eye = np.array([-8.0, 0.0, 2.0])
    image = np.array([0.0, 0.0, -4.0])
    rays = _rays(eye, image + np.array([0.0, 0.0, 0.9]))  # the ball's top, upside down
    value = np.asarray(_seen(scene, rays, oi.TwoStream()).value)[0]
    direction = np.asarray(rays.direction)[0]
    start = eye - direction * eye[2] / direction[2]
    turned = direction * np.array([1, 1, -1])
    hit = oi.objects.nearest((BALL,), jnp.asarray(start), jnp.asarray(turned))
    assert np.isfinite(hit.distance)
    sun = float(scene.beam()[1][0])
    # Lit by the sun from above and by what floor and surface throw to and fro: at least the first.
    direct = np.asarray(RHO) / np.pi * sun * max(-float(hit.normal[2]), 0.0) * np.asarray(F)
    assert np.all(value > direct)
    assert np.all(value < direct + np.asarray(RHO * F) / np.pi * 0.4)


def test_lamp():
    """In clear water the inverse square law on the floor; in water, quadrature along the ray."""
    lamp = oi.SpotLamp((1.0, 0.0, 3.0), (0.0, 0.0, 1.0), 40.0, F)
    scene = _scene(objects=(), lamps=(lamp,))
    dark = dataclasses.replace(scene, light=oi.Light(30.0, 0 * F))
    rays = _rays((-3.0, -2.0, 2.0), (1.0, 0.0, 7.0), (3.0, 0.0, 7.0), (9.0, 0.0, 7.0))
    value = _seen(dark, rays, oi.WithObjects(oi.TwoStream(), 400)).value
    straight = 0.5 * RHO / np.pi * F / 16.0
    slanted = 0.5 * RHO / np.pi * F / 20.0 * (4 / np.sqrt(20.0))
    np.testing.assert_allclose(value, np.stack([straight, slanted, 0 * F]), rtol=1e-5, atol=1e-7)
    murky = dataclasses.replace(dark, water=_scene(0.2, 0.4).water, floor=oi.Floor(7.0, 0 * RHO))
    value = np.asarray(_seen(murky, rays, oi.WithObjects(oi.TwoStream(), 48)).value)
    d = np.asarray(rays.direction)[0]
    length = 5.0 / d[2]
    t = (np.arange(100_000) + 0.5) / 100_000 * length
    x = np.array([-3.0, -2.0, 2.0]) + t[:, None] * d
    apart = x - np.array([1.0, 0.0, 3.0])
    r = np.linalg.norm(apart, axis=1)
    lit = apart[:, 2] / r > np.cos(np.radians(40))
    beta = np.asarray(murky.water.volume_scattering(jnp.asarray(-apart @ d / r)))
    c_star = 0.2 + 0.4 * (1 - 0.8**2)
    light = lit * np.exp(-c_star * (r + t)) / r**2
    expected = np.sum(light[:, None] * beta, axis=0) * length / 100_000 * np.asarray(F)
    np.testing.assert_allclose(value[0], expected, rtol=4e-5)


@pytest.mark.parametrize("half_angle", [5.0, 40.0, 89.0, 90.0])
def test_stretch_within_a_cone(half_angle):
    """Where a spot shines on rays of all directions, against asking point by point."""
    rng = np.random.default_rng(5)
    lamp = oi.SpotLamp((1.0, 0.0, 3.0), (0.3, -0.2, 1.0), half_angle, F)
    direction = rng.normal(size=(300, 3))
    direction[0] = np.asarray(lamp.direction)
    rays = oi.Rays(
        jnp.asarray(rng.uniform(-4, 4, (300, 3)) + np.asarray(lamp.position)),
        jnp.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True)),
    )
    end = jnp.asarray(rng.uniform(1.0, 12.0, 300))
    first, last = map(np.asarray, _lit(lamp, rays, end))
    assert np.all((first >= 0) & (last >= first) & (last <= np.asarray(end)))
    t = (np.arange(200) + 0.5) / 200 * np.asarray(end)[:, None]
    apart = np.asarray(rays.origin)[:, None] + t[..., None] * np.asarray(rays.direction)[:, None]
    apart = apart - np.asarray(lamp.position)
    cosine = apart @ np.asarray(lamp.direction) / np.linalg.norm(apart, axis=2)
    shone = cosine >= np.cos(np.radians(half_angle))
    within = (t > first[:, None]) & (t < last[:, None])
    assert np.mean(shone) > (0.0005 if half_angle < 10 else 0.05)
    np.testing.assert_array_equal(within, shone)


@pytest.mark.slow
def test_derivatives():
    """Of a ball's picture in its place and in the water, against differences."""
    rays = _rays((-4.0, -4.0, 2.0), (-0.3, -0.4, 3.6))

    @jax.jit
    def value(move, a):
        ball = oi.Sphere((0.0, 0.0, 4.0 + move), 1.0, RHO)
        return _seen(_scene(a, 0.2, objects=(ball,)), rays, oi.TwoStream()).value[0, 0]

    at, h = (jnp.asarray(0.0), jnp.asarray(0.1)), 1e-5
    for k in range(2):
        step = [h * (i == k) for i in range(2)]
        rise = value(*(x + s for x, s in zip(at, step, strict=True)))
        rise = (rise - value(*(x - s for x, s in zip(at, step, strict=True)))) / (2 * h)
        slope = jax.jvp(value, at, tuple(jnp.asarray(float(i == k)) for i in range(2)))[1]
        np.testing.assert_allclose(slope, rise, rtol=2e-5)


def test_pictures_do_not_depend_on_their_pieces(monkeypatch):
    from oceaninv.transport import front

    response = oi.spectrum.Response(jnp.ones((1, 2)), [450.0, 650.0], ("all",))
    camera = oi.Camera((-5.0, 0.0, 4.0), (1.0, 0, 0), (0.0, 0, -1), 50.0, 9, 5, response)
    scene = _scene(0.1, 0.2, objects=())
    whole = oi.photograph(scene, camera)
    monkeypatch.setattr(front, "_PIECE", 16)
    jax.clear_caches()
    pieces = oi.photograph(scene, camera)
    np.testing.assert_allclose(pieces.value, whole.value, rtol=1e-12)
    assert whole.value.shape == (5, 9, 1)


@pytest.mark.slow
def test_images_by_one_program_or_three(monkeypatch):
    """Transports that are slow to compile see all lines of sight at once: nothing else changes."""
    scene = _scene(0.1, 0.2, surface=oi.FlatSurface(1.34))
    rays = _rays((-4.0, -4.0, 2.0), (-0.3, -0.4, 3.6), (0.0, 0.0, -4.0), (1.0, 2.0, 0.0))
    apart = oi.radiance(scene, rays).value
    monkeypatch.setattr(oi.TwoStream, "in_pieces", False)
    jax.clear_caches()
    np.testing.assert_allclose(oi.radiance(scene, rays).value, apart, rtol=1e-12)
    bare = dataclasses.replace(scene, objects=())
    assert float(jnp.max(jnp.abs(oi.radiance(bare, rays).value / apart - 1)[1])) > 1e-3


def test_refusals():
    layers = oi.Layers([2.0], (_scene().water, _scene().water))
    scene = oi.Scene(layers, oi.Light(0.0, F), None, FLOOR, (BALL,))
    rays = _rays((-4.0, 0.0, 2.0), (0.0, 0.0, 4.0))
    with pytest.raises(ValueError, match="solves one homogeneous water"):
        oi.radiance(scene, rays)
    with pytest.raises(ValueError, match="leave them out of the scene"):
        oi.irradiance(_scene(), [1.0])
