"""The front ends: any transport answers for any scene, after its input has been checked."""

import jax.core
import jax.numpy as jnp
import numpy as np

from oceaninv.camera import Camera
from oceaninv.optics import Rays
from oceaninv.scene import Scene
from oceaninv.transport.base import AbstractTransport, Estimate, Irradiance
from oceaninv.transport.two_stream import TwoStream


def radiance(
    scene: Scene, rays: Rays, transport: AbstractTransport | None = None, *, key=None
) -> Estimate:
    """Spectral radiance that reaches the eye along each ray, (ray, wl).

    A ray of infinite length gathers everything up to the floor, the surface (and what is seen
    through and in it) or endless water.  A ray of finite length ends at an object: the value is
    the light that the water scatters into it on the way; add the object's own radiance times
    exp(-c length).  A finite ray that would leave the water counts as infinite.

    The sun's own disc is not part of the radiance.  `transport` is `TwoStream()` unless given;
    `key` (keyword only) seeds a random transport.

    Raises ValueError for origins outside the water, directions that are not unit vectors and
    lengths that are not positive.
    """
    scene.check_depths(rays.origin[:, 2])
    if not isinstance(rays.direction, jax.core.Tracer):
        norms = np.linalg.norm(np.asarray(rays.direction), axis=1)
        if not np.all(np.abs(norms - 1) < 1e-4):
            worst = norms[np.argmax(np.abs(norms - 1))]
            raise ValueError(f"rays.direction must hold unit vectors; one has length {worst:g}.")
    if rays.length is not None and not isinstance(rays.length, jax.core.Tracer):
        lengths = np.asarray(rays.length)
        if not np.all(lengths > 0):
            raise ValueError(f"rays.length must be positive; the least is {lengths.min():g} m.")
    return _able(scene, transport).radiance(scene, rays, key)


def irradiance(
    scene: Scene, depths, transport: AbstractTransport | None = None, *, key=None
) -> Irradiance:
    """Downward, upward and scalar irradiance at depths, each (depth, wl).

    `depths`: (depth,) metres, between the surface (0, just below it) and the floor; others raise
    ValueError.  `transport` is `TwoStream()` unless given.
    """
    depths = jnp.atleast_1d(jnp.asarray(depths, dtype=scene.light.direct.dtype))
    scene.check_depths(depths)
    return _able(scene, transport).irradiance(scene, depths, key)


def photograph(
    scene: Scene, camera: Camera, transport: AbstractTransport | None = None, *, key=None
) -> Estimate:
    """Linear channel values of a photograph, (row, column, channel).

    Radiance is taken as linear between the scene's wavelengths and integrated against the
    camera's response (unit: radiance x response x nm).
    """
    seen = radiance(scene, camera.rays(), transport, key=key)
    weights = jnp.asarray(camera.response.weights(scene.wavelength), dtype=seen.value.dtype)
    shape = (camera.height, camera.width, weights.shape[0])
    return Estimate(
        (seen.value @ weights.T).reshape(shape),
        # Bands of one ray share their paths: their errors add, at worst.
        (seen.stderr @ jnp.abs(weights).T).reshape(shape),
        (seen.bias @ jnp.abs(weights).T).reshape(shape),
    )


def _able(scene: Scene, transport: AbstractTransport | None) -> AbstractTransport:
    """The transport, `TwoStream()` unless given; ValueError if it cannot see what is there."""
    transport = TwoStream() if transport is None else transport
    if (scene.objects or scene.lamps) and not transport.sees_things:
        raise ValueError(
            f"{type(transport).__name__} knows no objects and no lamps: take MonteCarlo, or leave "
            "them out and give rays the length at which an object ends them."
        )
    if scene.inelastic is not None and not transport.inelastic:
        raise ValueError(
            f"{type(transport).__name__} knows no inelastic processes: take PlaneParallel or "
            "MonteCarlo, or a Scene without inelastic."
        )
    return transport
