"""The front ends: shapes, refusals, jit, and programs that hold only the terms of the scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi

WAVELENGTH = np.array([450.0, 550.0, 650.0])
DOWN = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])


def _scene(surface=True, floor=True, sky=True, a=None):
    ones = jnp.ones(3)
    a = jnp.asarray([0.05, 0.08, 0.35]) if a is None else a
    water = oi.IOPs(WAVELENGTH, a, 0.2 * ones, oi.phase.HenyeyGreenstein(0.9))
    return oi.Scene(
        water,
        oi.Light(30.0, ones, 0.1 * ones if sky else None),
        oi.FlatSurface() if surface else None,
        oi.Floor(10.0, 0.3 * ones) if floor else None,
    )


def _camera(width=3, height=2):
    response = oi.spectrum.camera_response("Nikon D850")
    return oi.Camera(
        [0.0, 0.0, 2.0], [1.0, 0.0, 0.1], [0.0, 0.0, -1.0], 50.0, width, height, response
    )


@jax.jit
def _pictured(scene):
    camera = _camera()
    return oi.photograph(scene, camera), oi.radiance(scene, camera.rays())


def test_photograph_is_weighted_radiance():
    """Through jit: linear channel values are radiance times the response's weights."""
    picture, seen = _pictured(_scene())
    assert picture.value.shape == picture.stderr.shape == picture.bias.shape == (2, 3, 3)
    weights = np.asarray(_camera().response.smooth_weights(WAVELENGTH))
    expected = np.asarray(seen.value) @ weights.T
    np.testing.assert_allclose(picture.value.reshape(6, 3), expected, rtol=1e-13)
    np.testing.assert_array_equal(picture.stderr, 0.0)
    assert np.all(np.isnan(picture.bias))


def test_jit_and_vmap():
    def down(a):
        return oi.irradiance(_scene(a=a), [1.0, 4.0]).Ed.value

    some = jnp.full((4, 3), 0.2) * jnp.arange(1.0, 5.0)[:, None]
    batch = jax.jit(jax.vmap(down))(some)
    assert batch.shape == (4, 2, 3)
    np.testing.assert_allclose(batch[2], down(some[2]), rtol=1e-12)


def test_traced_depths_and_rays_pass_the_checks():
    slope = jax.jit(jax.grad(lambda z: oi.irradiance(_scene(), z).Ed.value.sum()))(
        jnp.asarray([1.0, 2.0])
    )
    assert bool(jnp.all(slope < 0))


def test_irradiance_shapes():
    field = oi.irradiance(_scene(), 3.0)
    assert field.Ed.value.shape == field.Eu.value.shape == field.E0.value.shape == (1, 3)
    assert bool(jnp.all(field.E0.value > field.Ed.value))
    assert bool(jnp.all(field.Ed.value > field.Eu.value))


def _equations(scene):
    lines = oi.Rays([0.0, 0.0, 2.0], DOWN)
    inner = jax.make_jaxpr(lambda s: oi.radiance(s, lines).value)(scene)

    def count(jaxpr):
        total = 0
        for equation in jaxpr.eqns:
            total += 1
            for value in jax.tree.leaves(
                list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")
            ):
                total += (
                    count(value.jaxpr if hasattr(value, "jaxpr") else value)
                    if (hasattr(value, "eqns") or hasattr(value, "jaxpr"))
                    else 0
                )
        return total

    return count(inner.jaxpr)


def test_absent_terms_are_absent_from_the_program():
    """A scene without a floor, a surface or a sky compiles to fewer equations."""
    whole = _equations(_scene())
    bare = _equations(_scene(False, False, False))
    for absent in ("surface", "floor", "sky"):
        assert bare < _equations(_scene(**{absent: False})) < whole
    assert bare < 0.75 * whole


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda s: oi.radiance(s, oi.Rays([0.0, 0.0, -1.0], DOWN)),
            "depths must be finite and at least 0",
        ),
        (lambda s: oi.radiance(s, oi.Rays([0.0, 0.0, 11.0], DOWN)), "below the floor at 10 m"),
        (
            lambda s: oi.radiance(s, oi.Rays([0.0, 0.0, 1.0], 2 * DOWN)),
            "unit vectors; one has length 2",
        ),
        (
            lambda s: oi.radiance(s, oi.Rays([0.0, 0.0, 1.0], DOWN, 0.0)),
            "length must be positive; the least is 0 m",
        ),
        (
            lambda s: oi.radiance(s, oi.Rays([0.0, 0.0, 1.0], DOWN, np.array([1.0, np.nan]))),
            "must be positive",
        ),
        (lambda s: oi.irradiance(s, [1.0, 20.0]), "depths reach 20 m"),
        (lambda s: oi.irradiance(s, [np.nan]), "depths must be finite"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message):
        call(_scene())


@pytest.mark.parametrize("things", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_photographs_of_other_numbers_share_a_program(caplog, things):
    """Sun, sky, wavelengths, constituents, surface, floor, camera and object all change."""
    response = oi.spectrum.generic_camera()

    def draw(k):
        bands = oi.spectrum.bands(4, 400.0 + k, 690.0 + 3 * k)
        water = oi.BioOpticalModel().iops(oi.Constituents(1.0 + k, 0.1 + k, 0.02 * k), bands)
        light = oi.Light(20.0 + k, np.ones(4) + k, 0.1 * np.ones(4) * (1 + k))
        sphere = oi.Sphere([0.1 * k, 3.0 + k, 2.0], 0.5 + 0.1 * k, np.full(4, 0.1 + 0.2 * k))
        floor = oi.Floor(5.0 + k, np.full(4, 0.1 + 0.2 * k))
        scene = oi.Scene(water, light, oi.FlatSurface(1.33 + 0.01 * k), floor, [sphere] * things)
        position, direction = [0.1 * k, 0, 1.0 + k], [0.2 * k, 1, 0.1 * k]
        camera = oi.Camera(position, direction, [0.1 * k, 0, -1], 50.0 + k, 5, 4, response)
        return np.asarray(oi.photograph(scene, camera).value)

    compiled = []
    with jax.log_compiles():
        for k in range(3):
            caplog.clear()
            found = draw(k)
            assert np.all(np.isfinite(found))
            compiled.append(sum(r.getMessage().startswith("Compiling") for r in caplog.records))
    assert compiled[0] > 0
    assert compiled[1:] == [0, 0]
