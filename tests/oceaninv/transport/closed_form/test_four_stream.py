"""The four-stream model: unit values, the exact model, limits, singular points, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi

FLOOR_DEPTH, REFLECTANCE = 5.0, 0.3
MU0, INDEX, SKY = 0.8, 1.34, 0.1
SIN0 = np.sqrt(1 - MU0**2)
ZENITH = float(np.degrees(np.arcsin(INDEX * SIN0)))
MU = np.array([0.9, 0.4, -0.4, -1.0])
SINE = np.sqrt(1 - MU**2)
# Light that travels at cosines MU, 60 degrees in azimuth from the sun's.
VIEWS = np.stack([0.5 * SINE, np.sqrt(0.75) * SINE, -MU], axis=1)


def beam() -> float:
    """Sun's normal irradiance in air for unit normal irradiance under water."""
    air = np.cos(np.radians(ZENITH))
    rs = (air - INDEX * MU0) / (air + INDEX * MU0)
    rp = (INDEX * air - MU0) / (INDEX * air + MU0)
    return float(MU0 / air / (1 - 0.5 * (rs**2 + rp**2)))


def scene(a, b, g, floored):
    dtype = a.dtype
    water = oi.IOPs(np.arange(1.0, a.size + 1), a, b, oi.phase.HenyeyGreenstein(g))
    light = oi.Light(ZENITH, beam() * jnp.ones_like(a), SKY * jnp.ones_like(a))
    floor = oi.Floor(jnp.asarray(FLOOR_DEPTH, dtype), REFLECTANCE * jnp.ones_like(a))
    surface = oi.FlatSurface(jnp.asarray(INDEX, dtype))
    return oi.Scene(water, light, surface, floor if floored else None)


def seen(a, b, g, floored=True):
    """Radiance of VIEWS and A over 1 m, then Ed, Eu, E0, all at 2 m: (value, wl)."""
    this = scene(a, b, g, floored)
    origin = jnp.zeros((4, 3), a.dtype).at[:, 2].set(2.0)
    views = jnp.asarray(VIEWS, a.dtype)
    far = oi.radiance(this, oi.Rays(origin, views), oi.FourStream()).value
    near = oi.radiance(
        this, oi.Rays(origin[2:3], views[2:3], jnp.ones(1, a.dtype)), oi.FourStream()
    ).value
    field = oi.irradiance(this, jnp.full(1, 2.0, a.dtype), oi.FourStream())
    return jnp.concatenate([far, near, field.Ed.value, field.Eu.value, field.E0.value])


SEEN = jax.jit(seen, static_argnames="floored")
FORWARD = jax.jit(
    jax.jacfwd(lambda p, floored: seen(p[0, None], p[1, None], p[2], floored)[:, 0]),
    static_argnames="floored",
)


def test_published_values():
    found = SEEN(jnp.asarray([0.2]), jnp.asarray([0.8]), jnp.asarray(0.8))[:, 0]
    radiances = [0.18946594, 0.090143895, 0.02821359, 0.015063125, 0.019270865]
    # The page rounds the reflectances of the surface to six digits.
    np.testing.assert_allclose(found[:5], radiances, rtol=1e-6)
    np.testing.assert_allclose(found[5:], [0.54142009, 0.064746229, 0.98307036], rtol=1e-6)


def test_no_scattering_is_beers_law():
    a = jnp.asarray([0.3])
    found = SEEN(a, 0.0 * a, jnp.asarray(0.8), floored=False)[:, 0]
    sun = MU0 * np.exp(-0.6 / MU0)
    # Looking down into water that does not scatter: nothing.
    np.testing.assert_array_equal(found[2:5], 0.0)
    assert found[5] > sun  # the sky adds to it
    np.testing.assert_allclose(found[6], 0.0, atol=1e-15)


@pytest.mark.parametrize("floored", [pytest.param(True, marks=pytest.mark.slow), False])
def test_derivatives_are_differences(floored):
    point, step = jnp.asarray([0.3, 0.9, 0.85]), 1e-5
    found = FORWARD(point, floored)
    for i in range(3):
        move = step * jnp.asarray(np.eye(3)[i])
        up, down = (
            SEEN(p[0, None], p[1, None], p[2], floored=floored)[:, 0]
            for p in (point + move, point - move)
        )
        difference = (up - down) / (2 * step)
        scale = np.abs(difference).max()
        np.testing.assert_allclose(found[:, i], difference, rtol=1e-6, atol=1e-8 * scale)


@pytest.mark.slow
def test_reverse_is_forward():
    point = jnp.asarray([0.3, 0.9, 0.85])
    weights = jnp.linspace(1.0, 2.0, 8)
    backward = jax.jit(jax.grad(lambda p: weights @ seen(p[0, None], p[1, None], p[2])[:, 0]))(
        point
    )
    np.testing.assert_allclose(backward, weights @ FORWARD(point, True), rtol=1e-9)


EXTREMES = [
    (a, b, g)
    for a, b in ((0.0, 1.0), (1e-12, 1.0), (1.0, 0.0), (1.0, 1e-12), (1e-6, 1e-6), (100.0, 100.0))
    for g in (-0.5, 0.0, 0.8, 0.99)
]


@pytest.mark.parametrize("floored", [pytest.param(True, marks=pytest.mark.slow), False])
def test_extremes_are_finite(floored):
    for a, b, g in EXTREMES:
        if a < 1e-10 and not floored:
            continue  # a conservative half-space has no decaying mode to be fed by the sun
        point = jnp.asarray([a, b, g])
        low = point.astype(jnp.float32)
        value = SEEN(point[0, None], point[1, None], point[2], floored=floored)
        single = SEEN(low[0, None], low[1, None], low[2], floored=floored)
        assert single.dtype == jnp.float32
        assert np.isfinite(value).all(), point
        assert np.all(value >= -1e-12), point
        assert np.isfinite(FORWARD(point, floored)).all(), point
        assert np.isfinite(single).all(), point
        np.testing.assert_allclose(single, value, rtol=5e-3, atol=1e-5)


def test_continuous_where_a_mode_meets_the_beam():
    """k = k0 along a line of waters: second differences stay small."""
    albedo = jnp.asarray(np.linspace(0.02, 0.95, 400))
    rows = SEEN(1.0 - albedo, albedo, jnp.asarray(0.3))
    bend = np.abs(np.diff(np.asarray(rows), n=2, axis=1)).max(axis=1)
    assert np.all(bend < 2e-3 * np.asarray(rows).max(axis=1))


def test_error_against_the_exact_rung():
    """Worst measured: see tests/acceptance/four_stream_accuracy.md; here a subset."""
    from tests.acceptance import four_stream_accuracy as study

    parameters, directions = study.waters(12), study.views(count=12)
    away = study.from_sun(parameters[2], directions) > 10.0
    arrays = tuple(jnp.asarray(p) for p in parameters)
    both = [
        [np.asarray(x) for x in study.solved(model, arrays, jnp.asarray(directions), True)]
        for model in (oi.FourStream(), oi.PlaneParallel(streams=12))
    ]
    errors = [np.abs(f / e - 1) for f, e in zip(*both, strict=True)]
    assert np.median(errors[0][away]) < 0.045
    assert np.quantile(errors[0][away], 0.9) < 0.15
    assert np.median(errors[1]) < 0.01
