"""Caustics: light is neither made nor lost, and focused as by a lens."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.scene import waves

INDEX = jnp.asarray(1.34)


@pytest.mark.parametrize("zenith", [0.0, 50.0])
def test_energy(zenith):
    """The mean over a tile is that under a flat surface, whatever the depth and the waves."""
    sea = waves.random_waves(3.0, 0.12, 2.0, 0.2, seed=3)
    mu = jnp.cos(jnp.deg2rad(jnp.asarray(zenith)))
    for depth in (0.5, 4.0, 20.0):
        pattern = waves.caustics(sea, mu, INDEX, jnp.asarray(depth), 64)
        np.testing.assert_allclose(jnp.mean(pattern), 1.0, rtol=1e-12)
        assert float(jnp.std(pattern)) > 0.1


def test_flat():
    still = waves.Waves(2.0, [[1, 0]], [0.0], [0.0])
    pattern = waves.caustics(still, jnp.asarray(0.8), INDEX, jnp.asarray(3.0), 32)
    np.testing.assert_allclose(pattern, 1.0, rtol=1e-12)


def test_one_wave_against_its_rays():
    """Above the focus the irradiance is 1/(dX/dx) where the ray from x arrives at X: Snell's law
    for a zenith sun, by differences of the angles."""
    tile, height, depth = 4.0, 0.06, 2.0
    wave = waves.Waves(tile, [[2, 0]], [height], [0.3])
    size = 256
    pattern = np.asarray(waves.caustics(wave, jnp.asarray(1.0), INDEX, jnp.asarray(depth), size))
    assert np.ptp(pattern, axis=0).max() < 1e-10
    x = np.linspace(0, tile, 40001)
    k = 2 * np.pi * 2 / tile
    slope = np.arctan(-height * k * np.sin(k * x + 0.3))
    # The ray turns towards the normal by the difference of the angles of incidence.
    turn = slope - np.arcsin(np.sin(slope) / float(INDEX))
    arrives = x + depth * np.tan(turn)
    dense = 1 / np.gradient(arrives, x)
    assert dense.min() > 0
    order = np.argsort(arrives)
    period = tile / 2
    at = np.arange(size) * tile / size
    inner = (at > period) & (at < 3 * period / 2)
    expected = np.interp(at[inner], arrives[order], dense[order])
    assert expected.max() / expected.min() > 1.5
    np.testing.assert_allclose(pattern[0, inner], expected, rtol=4e-3)


def test_waves_travel():
    """After one period a wave alone looks as before; half a period on it is turned over."""
    k = 2 * np.pi / 2.0
    period = 2 * np.pi / np.sqrt(9.81 * k)
    first, half, whole = (
        waves.Waves(2.0, [[0, 1]], [0.01], [0.0], time=t).slopes(16)
        for t in (0.0, period / 2, period)
    )
    np.testing.assert_allclose(half, -first, atol=1e-12)
    np.testing.assert_allclose(whole, first, atol=1e-12)
    expected = -0.01 * k * np.sin(k * np.arange(16) / 8.0)
    np.testing.assert_allclose(first[1, :, 5], expected, atol=1e-12)
    np.testing.assert_allclose(first[0], 0.0, atol=1e-12)


def test_random_waves_have_their_slope():
    sea = waves.random_waves(4.0, 0.1, 2.0, 0.3, wind=90.0, seed=1)
    slopes = sea.slopes(64)
    np.testing.assert_allclose(jnp.sqrt(jnp.mean(jnp.sum(slopes**2, axis=0))), 0.1, rtol=1e-10)
    assert float(jnp.mean(slopes[1] ** 2)) > 2 * float(jnp.mean(slopes[0] ** 2))


def test_lookup_repeats():
    pattern = jnp.asarray(np.random.default_rng(0).random((8, 8)))
    x, y = jnp.asarray([0.5, 0.5 + 4.0, 0.25]), jnp.asarray([1.5, 1.5 - 8.0, 3.75])
    found = waves.looked_up(pattern, 4.0, x, y)
    np.testing.assert_allclose(found[:2], pattern[3, 1], rtol=1e-12)
    around = (pattern[7, 0] + pattern[7, 1] + pattern[0, 0] + pattern[0, 1]) / 4
    np.testing.assert_allclose(found[2], around, rtol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: waves.random_waves(2.0, 0.1, 3.0, 0.2), "longest <= tile"),
        (lambda: waves.random_waves(2.0, 0.1, 1.0, 0.001), "too fine"),
        (lambda: waves.random_waves(2.0, 0.5, 1.0, 0.1), "slope"),
        (lambda: waves.Waves(2.0, [[0, 0]], [0.1], [0.0]), "a wave has a length"),
        (lambda: waves.Waves(2.0, [[1.5, 0]], [0.1], [0.0]), "whole numbers"),
        (lambda: waves.Waves(2.0, [[9, 0]], [0.1], [0.0]).slopes(16), "too coarse"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@eqx.filter_jit
def _look(scene, rays):
    return oi.radiance(scene, rays).value


def scene(**more):
    water = oi.IOPs([500.0, 600.0], 0.05 * jnp.ones(2), 0.1 * jnp.ones(2), oi.phase.petzold())
    sea = waves.random_waves(3.0, 0.1, 2.0, 0.3, seed=2)
    return oi.Scene(
        water, oi.Light(30.0, jnp.ones(2)), oi.FlatSurface(1.34, sea),
        oi.Floor(4.0, 0.3 * jnp.ones(2)), **more,
    )  # fmt: skip


def test_floor_under_waves():
    """Straight down onto one tile: the mean is that under a flat surface, only the pattern of the
    unscattered sun is added."""
    wavy = scene()
    calm = eqx.tree_at(lambda s: s.surface.waves.amplitude, wavy, replace_fn=lambda a: 0 * a)
    at = (np.arange(60) + 0.5) / 60 * 3.0
    origin = np.stack([*(v.ravel() for v in np.meshgrid(at, at)), np.full(3600, 2.0)], axis=1)
    rays = oi.Rays(origin, np.tile([0.0, 0.0, 1.0], (3600, 1)))
    seen, flat = _look(wavy, rays), _look(calm, rays)
    np.testing.assert_allclose(jnp.mean(seen, 0), jnp.mean(flat, 0), rtol=4e-3)
    mu, beam = calm.beam()
    most = mu * beam[0] * jnp.exp(-0.15 * (4.0 / mu + 2.0)) * 0.3 / jnp.pi
    pattern = waves.caustics(wavy.surface.waves, wavy.light.cosine, INDEX, jnp.asarray(4.0))
    added = waves.looked_up(pattern, 3.0, jnp.asarray(origin[:, 0]), jnp.asarray(origin[:, 1]))
    np.testing.assert_allclose(seen[:, 0] - flat[:, 0], most * (added - 1), atol=1e-10)


def test_not_modelled():
    """Through waves into the air, and by a transport that knows none."""
    up = oi.Rays([0.0, 0.0, 2.0], [[0.0, 0.6, -0.8]])
    with pytest.raises(ValueError, match="not modelled"):
        oi.radiance(scene(), up)
    aside = oi.Rays([0.0, 0.0, 2.0], [[0.0, 0.8, 0.6]])
    with pytest.raises(ValueError, match="MonteCarlo does not solve waves"):
        oi.radiance(scene(), aside, oi.MonteCarlo(paths=4))
