"""The front ends, which check the input and call any transport on any scene."""

import dataclasses

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from oceaninv.foundation.interface_optics import Rays
from oceaninv.scene.camera import Camera
from oceaninv.scene.range_map import RangeMap
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import (
    AbstractTransport,
    Estimate,
    Irradiance,
    check_transport,
    homogeneous,
)
from oceaninv.transport.closed_form.two_stream import TwoStream
from oceaninv.transport.objects.range_map_radiance import ranged_radiance
from oceaninv.transport.objects.shadows import WithObjects
from oceaninv.water.iops import IOPs, Layers


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
    check_rays(scene, rays)
    return _able(scene, transport).radiance(scene, rays, key)


def check_rays(scene: Scene, rays: Rays) -> None:
    """ValueError for concrete rays that `radiance` refuses."""
    scene.check_depths(rays.origin[:, 2])
    if not isinstance(rays.direction, jax.core.Tracer):
        norms = np.linalg.norm(np.asarray(rays.direction), axis=1)
        if not np.all(np.abs(norms - 1) < 1e-4):
            worst = norms[np.argmax(np.abs(norms - 1))]
            raise ValueError(f"rays.direction must hold unit vectors; one has length {worst:g}.")
        _check_view(scene, np.asarray(rays.direction))
    if rays.length is not None and not isinstance(rays.length, jax.core.Tracer):
        lengths = np.asarray(rays.length)
        if not np.all(lengths > 0):
            raise ValueError(f"rays.length must be positive; the least is {lengths.min():g} m.")


def _check_view(scene: Scene, direction: np.ndarray) -> None:
    """ValueError for lines of sight that leave the water through waves."""
    surface = scene.surface
    if surface is None or surface.waves is None or isinstance(surface.index, jax.core.Tracer):
        return
    window = np.sqrt(1 - 1 / float(surface.index) ** 2)
    if direction[:, 2].min() < -window:
        raise ValueError(
            "a view up through waves into the air is not modelled, only what they do to the light"
            f" on the floor: look at most {np.degrees(np.arcsin(window)):.0f} degrees above the"
            " horizon, or take a surface without waves."
        )


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
    scene: Scene,
    camera: Camera,
    transport: AbstractTransport | None = None,
    *,
    ranges: RangeMap | None = None,
    fine_light: tuple[ArrayLike, ArrayLike] | None = None,
    key=None,
) -> Estimate:
    """Linear channel values of a photograph, (row, column, channel).

    Radiance is taken as smooth between the scene's wavelengths and integrated against the
    camera's response by `Response.smooth_weights` (unit: radiance x response x nm).  Objects and
    lamps are drawn by `WithObjects` around a transport that does not solve them.  Keyword only:
    `ranges`: a range map of this camera, whose objects are seen through the water by any
    transport; `fine_light`: (nm, values) of a light whose structure between the bands is known, for
    instance `spectrum.daylight_table()`; by default light is smooth, too.

    Raises ValueError as `radiance` does, and for a range map beside objects, lamps or waves.
    """
    scene.check_depths(camera.position[2:])
    weights = camera.response.smooth_weights(scene.wavelength, fine_light)
    weights = weights.T.astype(scene.light.direct.dtype)
    if ranges is not None:
        check_ranges(scene, ranges)
        seen = ranges.seen_by(camera)
        base = TwoStream() if transport is None else transport
        check_transport(base)
        estimate = ranged_radiance(scene, camera.rays(), seen, ranges.reflectance, base, key)
        return _channels(camera, weights, estimate)
    if scene.surface is not None and scene.surface.waves is not None:
        check_rays(scene, camera.rays())
    return _photograph(_numbered(scene), camera, weights, _able(scene, transport), key)


def check_ranges(scene: Scene, ranges: RangeMap) -> None:
    """ValueError for a range map that does not go with the scene."""
    waves = scene.surface is not None and scene.surface.waves is not None
    if scene.objects or scene.lamps or waves:
        raise ValueError(
            "a range map holds everything that is seen: leave objects, lamps and waves out of the"
            " scene."
        )
    homogeneous(scene)
    if ranges.reflectance.shape[1] != len(scene.wavelength):
        raise ValueError(
            f"the range map's reflectance has {ranges.reflectance.shape[1]} wavelengths, the scene"
            f" {len(scene.wavelength)}."
        )


@eqx.filter_jit
def _channels(camera: Camera, weights: Float[Array, "wl channel"], seen: Estimate) -> Estimate:
    shape = (camera.height, camera.width, weights.shape[1])
    worst = jnp.abs(weights)
    parts = (seen.value @ weights, seen.stderr @ worst, seen.bias @ worst)
    return Estimate(*(v.reshape(shape) for v in parts))


_PIECE = 2**15  # rays


@eqx.filter_jit
def _photograph(scene: Scene, camera: Camera, weights, transport, key) -> Estimate:
    dtype, rays = scene.light.direct.dtype, camera.rays()
    origin, direction = rays.origin.astype(dtype), rays.direction.astype(dtype)

    def channels(origin, direction):
        seen = transport.radiance(scene, Rays(origin, direction), key)
        # Bands of one ray share their paths, so that in the worst case their errors add up.
        worst = jnp.abs(weights)
        return seen.value @ weights, seen.stderr @ worst, seen.bias @ worst

    count = origin.shape[0]
    field = transport.base if isinstance(transport, WithObjects) else transport
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


def _numbered(scene: Scene) -> Scene:
    """The scene with bands that are numbered 1, 2, ...

    Wavelengths are part of the key of a compiled program, but only inelastic processes use them:
    so scenes that differ in them share a program."""
    if scene.inelastic is not None:
        return scene
    number = np.arange(1.0, len(scene.wavelength) + 1)

    def water(old: IOPs) -> IOPs:
        parts = (old.a_components, old.b_components, old.phases, old.absorbers, old.scatterers)
        return IOPs(number, *parts)

    old = scene.water
    if isinstance(old, IOPs):
        return dataclasses.replace(scene, water=water(old))
    return dataclasses.replace(
        scene, water=Layers(old.interfaces, tuple(water(iops) for iops in old.iops))
    )


def _able(scene: Scene, transport: AbstractTransport | None) -> AbstractTransport:
    """The transport, `TwoStream()` by default, with objects and lamps added where needed;
    ValueError for a scene that it does not solve."""
    transport = TwoStream() if transport is None else transport
    check_transport(transport)
    field = transport.base if isinstance(transport, WithObjects) else transport
    if scene.inelastic is not None and not field.inelastic:
        raise ValueError(
            f"{type(field).__name__} does not solve inelastic processes: take PlaneParallel or "
            "MonteCarlo, or a Scene without inelastic."
        )
    if scene.light.sky is not None and not field.any_sky:
        raise ValueError(
            f"{type(field).__name__} solves uniform skies only: take PlaneParallel, or a Light "
            "without sky, whose diffuse light is uniform."
        )
    waves = scene.surface is not None and scene.surface.waves is not None
    if waves and transport.draws_objects and not isinstance(transport, WithObjects):
        raise ValueError(
            f"{type(field).__name__} does not solve waves: take a closed form or PlaneParallel, or"
            " a surface without waves."
        )
    if (scene.objects or scene.lamps or waves) and not transport.draws_objects:
        return WithObjects(transport)
    return transport
