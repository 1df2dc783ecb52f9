"""Where lines meet spheres, boxes and reliefs; lamps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.scene.objects import blocked, nearest

GREY = jnp.asarray([0.2, 0.4])
SPHERE = oi.Sphere((0.0, 0.0, 5.0), 1.0, GREY)
BOX = oi.Box((2.0, -1.0, 4.0), (4.0, 1.0, 6.0), 0.5 * GREY)
RNG = np.random.default_rng(11)
RELIEF = oi.HeightField(6.0 + RNG.uniform(-0.5, 0.5, (7, 9)), -4.0, -3.0, 1.0, GREY)


def _unit(x):
    return jnp.asarray(x) / jnp.linalg.norm(jnp.asarray(x))


@eqx.filter_jit
def _hits(objects, origins, directions):
    return jax.vmap(lambda o, d: nearest(objects, o, d))(origins, directions)


def _hit(objects, origin, direction):
    one = _hits(objects, jnp.asarray(origin)[None], _unit(direction)[None])
    return jax.tree.map(lambda leaf: np.asarray(leaf[0]), one)


@pytest.mark.parametrize(
    ("origin", "direction", "distance", "normal", "reflectance"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0, (0, 0, -1), GREY),  # from above
        ((0.6, 0.0, 0.0), (0.0, 0.0, 1.0), 4.2, (0.6, 0, -0.8), GREY),
        ((-5.0, 0.0, 5.0), (1.0, 0.0, 0.0), 4.0, (-1, 0, 0), GREY),  # the sphere hides the box
        ((0.0, 0.0, 5.0), (0.0, 1.0, 0.0), 1.0, (0, -1, 0), GREY),  # from the inside
        ((9.0, 0.5, 5.5), (-1.0, 0.0, 0.0), 5.0, (1, 0, 0), 0.5 * GREY),
        ((3.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0, (0, 0, -1), 0.5 * GREY),
        ((3.0, 0.5, 5.0), (0.0, 1.0, 0.0), 0.5, (0, -1, 0), 0.5 * GREY),  # inside the box
        ((3.0, 5.0, 5.0), (0.0, -1.0, 0.0), 4.0, (0, 1, 0), 0.5 * GREY),
        ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), np.inf, (0, 0, 0), 0 * GREY),  # behind the eye
        ((0.0, 1.5, 0.0), (0.0, 0.0, 1.0), np.inf, (0, 0, 0), 0 * GREY),
        ((3.0, 1.5, 0.0), (0.0, 0.0, 1.0), np.inf, (0, 0, 0), 0 * GREY),  # parallel to a side
        ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), np.inf, (0, 0, 0), 0 * GREY),  # grazes the sphere
    ],
)
def test_known_hits(origin, direction, distance, normal, reflectance):
    hit = _hit((SPHERE, BOX), origin, direction)
    np.testing.assert_allclose(hit.distance, distance, rtol=1e-14)
    np.testing.assert_allclose(hit.normal, np.asarray(normal, float), atol=1e-14)
    np.testing.assert_allclose(hit.reflectance, reflectance)


def test_surface_does_not_hide_itself():
    """Shadow lines that start where a line of sight ended: free outwards, met inwards."""
    directions = jnp.asarray(RNG.normal(size=(400, 3)))
    directions = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
    for thing, centre in ((SPHERE, (0.0, 0.0, 5.0)), (BOX, (3.0, 0.0, 5.0))):
        origins = jnp.asarray(centre)[None] - 4.0 * directions
        hits = _hits((thing,), origins, directions)
        at = origins + hits.distance[:, None] * directions
        # Away from the surface, down to a thousandth of a right angle from grazing.
        side = jnp.cross(hits.normal, _unit((0.3, 0.5, 0.8))[None])
        side = side / jnp.linalg.norm(side, axis=1, keepdims=True)
        for tilt in (1.0, 1e-3):
            out = tilt * hits.normal + np.sqrt(1 - tilt**2) * side
            free = jax.vmap(lambda o, d, t=thing: blocked((t,), o, d, jnp.asarray(jnp.inf)))
            assert not np.any(free(at, out))
            assert np.all(free(at, -hits.normal))


def test_limit_of_a_shadow_line():
    def shadow(limit):
        return bool(blocked((SPHERE,), jnp.zeros(3), _unit((0.0, 0.0, 1.0)), jnp.asarray(limit)))

    assert shadow(4.1)
    assert not shadow(3.9)


def test_single_precision_from_far_away():
    """A pebble 200 m away, met to a tenth of a millimetre."""
    pebble = oi.Sphere((200.0, 0.0, 5.0), 0.05, GREY.astype(jnp.float32))
    eye, ahead = jnp.asarray([0.0, 0.0, 5.0], jnp.float32), jnp.asarray([1.0, 0, 0], jnp.float32)
    hit = nearest((pebble,), eye, ahead)
    assert hit.distance.dtype == jnp.float32
    np.testing.assert_allclose(hit.distance, 199.95, atol=1e-4)
    beside = eye + jnp.asarray([0.0, 0.0501, 0.0], jnp.float32)
    assert np.isinf(nearest((pebble,), beside, ahead).distance)


def _relief_depth(x, y):
    """Bilinear interpolation, by numpy."""
    depth = np.asarray(RELIEF.depth)
    i = np.clip(np.floor(x + 4).astype(int), 0, 7)
    j = np.clip(np.floor(y + 3).astype(int), 0, 5)
    u, v = x + 4 - i, y + 3 - j
    top = (1 - u) * depth[j, i] + u * depth[j, i + 1]
    bottom = (1 - u) * depth[j + 1, i] + u * depth[j + 1, i + 1]
    return (1 - v) * top + v * bottom


def test_relief_against_small_steps():
    """Random lines, from above and from below, against a walk of 0.2 mm steps."""
    origins = RNG.uniform([-6, -5, 2], [6, 5, 9], (150, 3))
    targets = RNG.uniform([-4, -3, 5.6], [4, 3, 6.4], (150, 3))
    directions = (targets - origins) / np.linalg.norm(targets - origins, axis=1, keepdims=True)
    directions[:3] = [[0, 0, 1], [0, 0, 1], [0, 0, -1]]
    hits = _hits((RELIEF,), jnp.asarray(origins), jnp.asarray(directions))
    t = np.arange(0, 20, 2e-4)
    missed = 0
    for origin, direction, distance, normal in zip(
        origins, directions, np.asarray(hits.distance), np.asarray(hits.normal), strict=True
    ):
        x, y, z = origin[:, None] + direction[:, None] * t
        over = (np.abs(x) <= 4) & (np.abs(y) <= 3)
        above = np.where(over, z - _relief_depth(x, y), np.nan)
        crossed = np.flatnonzero(above[1:] * above[:-1] <= 0)
        if crossed.size == 0:
            assert np.isinf(distance)
            missed += 1
            continue
        np.testing.assert_allclose(distance, t[crossed[0]], atol=2.1e-4)
        assert np.dot(normal, direction) < 0
        at = origin + distance * direction
        step = 1e-6
        slope = [
            (
                _relief_depth(at[0] + step * (k == 0), at[1] + step * (k == 1))
                - _relief_depth(at[0] - step * (k == 0), at[1] - step * (k == 1))
            )
            / (2 * step)
            for k in (0, 1)
        ]
        exact = np.array([*slope, -1.0]) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
        np.testing.assert_allclose(np.abs(normal @ exact), 1.0, atol=1e-5)
    assert 5 < missed < 75


def test_flat_relief_is_a_floor():
    flat = oi.HeightField(np.full((3, 3), 6.0), -10.0, -10.0, 10.0, GREY)
    hit = _hit((flat,), (0.3, 0.2, 1.0), (0.6, 0.0, 0.8))
    np.testing.assert_allclose(hit.distance, 6.25, rtol=1e-14)
    np.testing.assert_allclose(hit.normal, [0, 0, -1], atol=1e-15)
    assert np.isinf(_hit((flat,), (30.0, 0.0, 1.0), (0.0, 0.0, 1.0)).distance)


@pytest.mark.parametrize("thing", [SPHERE, BOX, RELIEF], ids=["sphere", "box", "relief"])
def test_gradients(thing):
    """Distance and normal against differences, forward and reverse; finite where a line misses."""
    origin = jnp.asarray([0.3, 0.2, 1.0])
    target = (3.0, 0.5, 4.0) if thing is BOX else (0.2, 0.1, 5.0)

    @jax.jit
    def measure(origin, move):
        direction = _unit(jnp.asarray(target) - jnp.asarray([0.3, 0.2, 1.0]))
        moved = jax.tree.map(lambda leaf: leaf * (1.0 + move), thing)
        hit = nearest((moved,), origin, direction)
        return hit.distance + hit.normal @ jnp.asarray([0.3, 0.5, 0.7])

    h = 1e-6
    forward = jax.jacfwd(measure)(origin, 0.0)
    reverse, in_size = jax.grad(measure, (0, 1))(origin, 0.0)
    for k in range(3):
        e = jnp.eye(3)[k] * h
        rise = (measure(origin + e, 0.0) - measure(origin - e, 0.0)) / (2 * h)
        for slope in (forward, reverse):
            np.testing.assert_allclose(slope[k], rise, rtol=1e-6, atol=1e-8)
    rise = (measure(origin, h) - measure(origin, -h)) / (2 * h)
    np.testing.assert_allclose(in_size, rise, rtol=1e-6)

    def missing(origin):
        hit = nearest((thing,), origin, jnp.asarray([0.0, 0.0, -1.0]))
        return jnp.where(jnp.isfinite(hit.distance), hit.distance, 0.0) + jnp.sum(hit.normal)

    np.testing.assert_array_equal(jax.grad(missing)(origin), 0.0)


def test_lamps():
    point = oi.PointLamp((1.0, 2.0, 3.0), GREY)
    np.testing.assert_array_equal(point.along(_unit((1.0, 1.0, 1.0))), GREY)
    spot = oi.SpotLamp((1.0, 2.0, 3.0), (0.0, 0.0, 2.0), 30.0, GREY)
    for angle, lit in ((0.0, 1.0), (29.9, 1.0), (30.1, 0.0), (180.0, 0.0)):
        turned = jnp.asarray([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])
        np.testing.assert_array_equal(spot.along(turned), lit * GREY)


def _scene(**more):
    water = oi.IOPs([500.0, 600.0], GREY, GREY, oi.phase.Isotropic())
    return oi.Scene(water, oi.Light(30.0, jnp.ones(2)), None, oi.Floor(8.0, GREY), **more)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: oi.Sphere((0.0, 0.0, 5.0), 0.0, GREY), "radius must be finite"),
        (lambda: oi.Sphere((0.0, 0.0), 1.0, GREY), "centre must be three numbers"),
        (lambda: oi.Sphere((0.0, 0.0, 5.0), 1.0, -GREY), "reflectance must be finite and between"),
        (lambda: oi.Sphere((0.0, 0.0, 5.0), 1.0, 0.3), r"reflectance must have shape \(wl,\)"),
        (lambda: oi.Box((0.0, 0, 2), (1.0, 1, 1), GREY), "upper - lower must be finite"),
        (lambda: oi.HeightField(np.ones(3), 0.0, 0.0, 1.0, GREY), "depth must be a grid"),
        (lambda: oi.HeightField(np.ones((3, 3)), 0.0, 0.0, 0.0, GREY), "spacing must be finite"),
        (lambda: oi.PointLamp((0.0, 0, 5), -GREY), "intensity must be finite"),
        (lambda: oi.SpotLamp((0.0, 0, 5), (0.0, 0, 0), 20.0, GREY), "length of direction"),
        (lambda: oi.SpotLamp((0.0, 0, 5), (0.0, 0, 1), 120.0, GREY), "half_angle must be finite"),
        (
            lambda: _scene(objects=(oi.Sphere((0.0, 0, 5), 1.0, jnp.ones(3)),)),
            r"objects\[0\].reflectance must have one value per wavelength",
        ),
        (
            lambda: _scene(objects=(SPHERE, oi.Sphere((0.0, 0, 0.5), 1.0, GREY))),
            r"objects\[1\] reaches 0.5 m above the surface",
        ),
        (
            lambda: _scene(objects=(oi.Sphere((0.0, 0, 12), 1.0, GREY),)),
            r"objects\[0\] begins at 11 m, below the floor at 8 m",
        ),
        (
            lambda: _scene(lamps=(oi.PointLamp((0.0, 0, 5), jnp.ones(3)),)),
            r"lamps\[0\].intensity must have one value per wavelength",
        ),
        (lambda: _scene(lamps=(oi.PointLamp((0.0, 0, -1), GREY),)), "lamps.0. reaches 1 m above"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ValueError, match=message):
        make()
