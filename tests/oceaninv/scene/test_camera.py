"""The pinhole camera: geometry of its rays, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi


def _camera(direction=(1.0, 0.0, 0.0), up=(0.0, 0.0, -1.0), fov=60.0, width=5, height=3):
    response = oi.spectrum.camera_response("Nikon D850")
    return oi.Camera((1.0, 2.0, 3.0), direction, up, fov, width, height, response)


def test_rays():
    """Unit vectors from the camera; the middle pixel looks ahead, rows go down, columns right."""
    lines = _camera((2.0, 0.0, 0.0)).rays()
    looks = np.asarray(lines.direction).reshape(3, 5, 3)
    np.testing.assert_allclose(np.linalg.norm(looks, axis=-1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(looks[1, 2], [1.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(lines.origin, np.tile([1.0, 2.0, 3.0], (15, 1)))
    assert np.all(looks[0, :, 2] < 0)  # the top row looks up, to smaller depths
    assert np.all(looks[2, :, 2] > 0)
    # z points down, so that with x ahead, y lies to the right.
    assert np.all(np.diff(looks[1, :, 1]) > 0)


def test_axes_of_the_documentation():
    """Seen along +y with the surface up, +x is to the left and +z, the depth, down."""
    looks = np.asarray(_camera((0.0, 1.0, 0.0)).rays().direction).reshape(3, 5, 3)
    assert np.all(looks[:, :2, 0] > 0)
    assert np.all(looks[:, 3:, 0] < 0)
    assert np.all(looks[2, :, 2] > 0)


def test_field_of_view():
    """The outer pixel edges span the horizontal angle; pixels are square."""
    looks = np.asarray(_camera(fov=80.0, width=400, height=2).rays().direction).reshape(2, 400, 3)
    slope = looks[0, :, 1] / looks[0, :, 0]
    pitch = slope[1] - slope[0]
    np.testing.assert_allclose(np.diff(slope), pitch, rtol=1e-10)
    np.testing.assert_allclose(slope[-1] + pitch / 2, np.tan(np.radians(40)), rtol=1e-12)
    vertical = (looks[1, :, 2] - looks[0, :, 2]) / looks[0, :, 0]
    np.testing.assert_allclose(vertical, pitch, rtol=1e-12)


def test_tilted_up_vector():
    """Only the part of `up` across the direction counts."""
    straight, tilted = _camera(), _camera(up=(5.0, 0.0, -0.2))
    np.testing.assert_allclose(straight.rays().direction, tilted.rays().direction, atol=1e-15)


def test_gradient_of_pose():
    def steepest(fov):
        return _camera(fov=fov).rays().direction[0, 2]

    h = 1e-4
    rise = (steepest(jnp.asarray(60 + h)) - steepest(jnp.asarray(60 - h))) / (2 * h)
    np.testing.assert_allclose(jax.grad(steepest)(jnp.asarray(60.0)), rise, rtol=1e-8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fov": 0.0}, "fov must be finite and between"),
        ({"fov": 180.0}, "fov must be finite and between"),
        ({"width": 0}, "width and height must be at least 1, not 0 and 3"),
        ({"height": -2}, "width and height must be at least 1"),
    ],
)
def test_refusals(change, message):
    with pytest.raises(ValueError, match=message):
        _camera(**change)


def test_unknown_camera():
    with pytest.raises(ValueError, match="Near it: Nikon D850"):
        oi.spectrum.camera_response("Nikon D85")
