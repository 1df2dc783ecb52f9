"""The front ends: any transport answers for any scene, after its input has been checked."""

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from oceaninv.camera import Camera
from oceaninv.optics import Rays
from oceaninv.scene import Scene
from oceaninv.transport.base import AbstractTransport, Estimate, Irradiance
from oceaninv.transport.shadows import Shadows
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
    _check_rays(scene, rays)
    return _able(scene, transport).radiance(scene, rays, key)


def _check_rays(scene: Scene, rays: Rays) -> None:
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
    camera's response (unit: radiance x response x nm).  Objects and lamps are drawn by
    `Shadows` around a transport that does not know them.
    """
    transport = _able(scene, transport)
    rays = camera.rays()
    _check_rays(scene, rays)
    return _photograph(scene, camera, rays, transport, key)


_PIECE = 2**15  # rays


@eqx.filter_jit
def _photograph(scene: Scene, camera: Camera, rays: Rays, transport, key) -> Estimate:
    dtype = scene.light.direct.dtype
    weights = jnp.asarray(camera.response.weights(scene.wavelength), dtype=dtype).T
    origin, direction = rays.origin.astype(dtype), rays.direction.astype(dtype)

    def channels(origin, direction):
        seen = transport.radiance(scene, Rays(origin, direction), key)
        # Bands of one ray share their paths: their errors add, at worst.
        worst = jnp.abs(weights)
        return seen.value @ weights, seen.stderr @ worst, seen.bias @ worst

    count = origin.shape[0]
    field = transport.base if isinstance(transport, Shadows) else transport
    if not field.in_pieces or count <= _PIECE:
        found = channels(origin, direction)
    else:
        pieces = -(-count // _PIECE)
        # Equal pieces of the picture; the last is filled up with copies of the last ray.
        padding = ((0, pieces * _PIECE - count), (0, 0))
        cut = [
            jnp.pad(v, padding, mode="edge").reshape(pieces, _PIECE, 3) for v in (origin, direction)
        ]
        found = jax.lax.map(lambda piece: channels(*piece), tuple(cut))
        found = tuple(v.reshape(pieces * _PIECE, -1)[:count] for v in found)
    shape = (camera.height, camera.width, weights.shape[1])
    return Estimate(*(v.reshape(shape) for v in found))


def _able(scene: Scene, transport: AbstractTransport | None) -> AbstractTransport:
    """The transport, `TwoStream()` unless given, made to see the things that are there."""
    transport = TwoStream() if transport is None else transport
    field = transport.base if isinstance(transport, Shadows) else transport
    if scene.inelastic is not None and not field.inelastic:
        raise ValueError(
            f"{type(field).__name__} knows no inelastic processes: take PlaneParallel or "
            "MonteCarlo, or a Scene without inelastic."
        )
    if scene.light.sky is not None and not field.any_sky:
        raise ValueError(
            f"{type(field).__name__} knows uniform skies only: take PlaneParallel, or a Light "
            "without sky, which spreads diffuse evenly."
        )
    if (scene.objects or scene.lamps) and not transport.sees_things:
        return Shadows(transport)
    return transport
