"""Objects, their shadows and lamps, added to a horizontally uniform light field."""

import dataclasses
import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from oceaninv.foundation.interface_optics import Rays, fresnel_from_water, scattering_half_sine
from oceaninv.foundation.numerics import exp_mean, safe_sqrt
from oceaninv.scene.objects import Box, HeightField, Sphere, blocked, nearest
from oceaninv.scene.scene import Scene
from oceaninv.scene.waves import caustics, looked_up
from oceaninv.transport.base import AbstractTransport, Estimate, Irradiance, homogeneous
from oceaninv.transport.closed_form._ray_integral import ENDLESS
from oceaninv.transport.closed_form._two_moment_field import DeltaScaledWater
from oceaninv.transport.objects import _surface_irradiance
from oceaninv.transport.objects._lamplight import lamplight

_STEEP = 1e-3


class Hits(NamedTuple):
    """The object that each ray meets: `oceaninv.objects.Hit` with a leading axis for rays."""

    distance: Float[Array, " ray"]
    normal: Float[Array, "ray 3"]
    reflectance: Float[Array, "ray wl"]


class WithObjects(AbstractTransport):
    """Objects, lamps and caustics, added to the light field of a transport without them.

    `photograph` and `radiance` put it around `TwoStream`, `FourStream`, `KdTransport` and
    `PlaneParallel` when a scene has objects or lamps; make one yourself to set `steps`.

    **Arguments:** `base`: the transport; `steps`: number of points along a line of sight at which
    sunlight (and lamplight) is tested for obstruction, within the stretch where that is possible.

    - **Solves**: objects as Lambertian surfaces under the sun, where it reaches them, and under
      the diffuse light of their depth, from where they look; the water in front of them; their
      shadows on the floor, on each other and in sunlight scattered once; their images in the
      surface; lamps with single scattering; the caustics of waves on the floor, of the sun's
      unscattered light, where objects leave it free.
    - **Neglects**: the diffuse light that objects block from each other, from the floor and from
      the water; blur by scattering through small angles at the edges of shadows; lamplight
      scattered more than once; caustics on objects, in the water and mirrored in the surface;
      layers (ValueError).
    - **Cost**: that of `base` at two rays per ray (four with a surface), one intersection per
      object, ray and step, and 2000 rays of `FourStream` (or `PlaneParallel`) for the light on
      objects.
    - **Measured error** of the light on objects: `tests/acceptance/facet_irradiance.md`.
    - **Differentiable in** everything that `base` is; shadows have hard edges, whose motion the
      derivative does not see.
    """

    base: AbstractTransport
    steps: int = 48

    draws_objects = True

    def radiance(self, scene: Scene, rays: Rays, key: Key[Array, ""] | None = None) -> Estimate:
        """See `oceaninv.radiance`."""
        return _radiance_with_objects(self, scene, rays, key)

    def _whole(self, scene: Scene, rays: Rays, key) -> Estimate:
        """Radiance along rays, with caustics and reflections in the surface."""
        line = _line(scene, rays)
        whole = self._with_images(scene, line, key)
        if scene.floor is None or scene.surface is None or scene.surface.waves is None:
            return whole
        return Estimate(whole.value + _caustics(scene, line), whole.stderr, whole.bias)

    def _with_images(self, scene: Scene, line, key) -> Estimate:
        rays, bare = line.rays, _without_objects(scene)
        light = self._light(scene, bare, key)
        if scene.surface is None or not scene.objects or rays.length is not None:
            return self._seen(scene, line, self._water(bare, line, key), light)
        mirrored, share = _images(scene, rays)
        free = (rays.direction[:, 2] < 0) & ~line.met
        second = _line(scene, mirrored)
        endless = second._replace(length=jnp.full_like(second.length, ENDLESS))

        if self.base.in_pieces:
            # One program for all three, skipped for pieces of a picture without such rays.
            sets = jax.tree.map(lambda *parts: jnp.stack(parts), line, second, endless)
            wanted = jnp.stack([jnp.asarray(True), jnp.any(free), jnp.any(free)])
            solid = jnp.asarray([True, True, False])

            def one(item):
                lines, wanted, solid = item
                nothing = jnp.zeros_like(lines.hit.reflectance)
                nothing = Estimate(nothing, nothing, nothing)

                def seen():
                    path = self._water(bare, lines, key)
                    return self._seen(scene, lines, path, light, solid)

                return jax.lax.cond(wanted, seen, lambda: nothing)

            found = jax.lax.map(one, (sets, wanted, solid))
            whole, image, alone = (
                jax.tree.map(lambda v, i=i: v[i], found) for i in range(len(solid))
            )
            extra = image.value - alone.value
        else:
            water, image, alone = self._together(bare, (line, second, endless), key)
            whole = self._seen(scene, line, water, light)

            def change():
                return self._seen(scene, second, image, light).value - alone.value

            extra = _if_any(free, change, whole.value)
        extra = jnp.where(free[:, None], share * extra, 0.0)
        return Estimate(whole.value + extra, whole.stderr, whole.bias)

    def _water(self, bare: Scene, line, key) -> Estimate:
        """Light of the water along lines of sight, with the floor and the sky at their ends."""
        rays = line.rays
        return self.base.radiance(bare, Rays(rays.origin, rays.direction, line.length), key)

    def _together(self, bare: Scene, lines, key) -> list[Estimate]:
        """`_water` of several sets of lines by one program."""
        origin, direction, length = (
            jnp.concatenate(parts)
            for parts in zip(
                *((x.rays.origin, x.rays.direction, x.length) for x in lines), strict=True
            )
        )
        found = self.base.radiance(bare, Rays(origin, direction, length), key)
        cut = [jnp.split(v, len(lines)) for v in (found.value, found.stderr, found.bias)]
        return [Estimate(*parts) for parts in zip(*cut, strict=True)]

    def irradiance(
        self, scene: Scene, depths: Float[Array, " depth"], key: Key[Array, ""] | None = None
    ) -> Irradiance:
        """ValueError with objects or lamps: irradiance is not a function of depth alone."""
        if not scene.objects and not scene.lamps:
            return self.base.irradiance(scene, depths, key)  # of waves, the mean over a tile
        raise ValueError(
            "WithObjects computes radiance and photographs only; irradiance is not a function of"
            " depth alone where a scene holds objects or lamps: leave them out of the scene."
        )

    def _seen(self, scene: Scene, line, path: Estimate, light, solid=None) -> Estimate:
        """Radiance along lines of sight, without reflections in the surface, given the light of the
        water along them and the light on objects.  `solid`: whether objects and lamps exist."""
        zero = jnp.zeros_like(path.value)
        if solid is None:
            added = self._added(scene, line, light, zero)
        else:
            added = jax.lax.cond(solid, lambda: self._added(scene, line, light, zero), lambda: zero)
        return Estimate(path.value + added, path.stderr, path.bias)

    def _added(self, scene: Scene, line, light, value) -> Float[Array, "ray wl"]:
        """What objects and lamps add to the light of the water along lines of sight."""
        rays, hit, met, length = line
        water = homogeneous(scene)
        floor = _to_floor(scene, rays)
        if floor is not None:
            on_floor = ~met & (rays.direction[:, 2] > 0) & (floor <= length)
            end = jnp.where(on_floor, floor, length)
        else:
            on_floor, end = jnp.zeros_like(met), length
        near = jnp.where(met | on_floor, end, 0.0)
        at = rays.origin + near[:, None] * rays.direction
        through = jnp.exp(-water.c[None, :] * near[:, None])
        if scene.objects:
            sent = _if_any(met, lambda: _on_objects(scene, light, hit, at), value)
            shown = jnp.where(met[:, None], sent, 0.0)
            if scene.floor is not None:
                shown = shown - _floor_shadow(scene, at, on_floor)
            value = value + shown * through
            stretch = _possible(scene, rays, end)
            shaded = stretch.last > stretch.first
            value = value - _if_any(shaded, lambda: self._shaded_path(scene, rays, stretch), value)
        if scene.lamps:
            value = value + lamplight(
                scene, rays, end, hit.normal, hit.reflectance, met, on_floor, through, self.steps
            )
        return value

    def _light(
        self, scene: Scene, bare: Scene, key
    ) -> _surface_irradiance.LightBetweenDepths | None:
        """The light on objects."""
        if not scene.objects:
            return None
        extents = [thing.extent() for thing in scene.objects]
        top = jnp.min(jnp.stack([extent[0] for extent in extents]))
        bottom = jnp.max(jnp.stack([extent[1] for extent in extents]))
        return _surface_irradiance.light(self.base, bare, top, bottom, key)

    def _shaded_path(self, scene: Scene, rays: Rays, stretch) -> Float[Array, "ray wl"]:
        """Sunlight that would be scattered once into rays, had objects not blocked it.

        Exact where the shadow begins and ends with a step.  The light is a geometric series in
        the steps, from the end of the stretch that gets more of it: one product per step.
        """
        mu0, beam = scene.beam()
        first, last = stretch.first, stretch.last
        width = (last - first) / self.steps
        attenuation = DeltaScaledWater(homogeneous(scene)).attenuation
        half_sine = scattering_half_sine(rays.direction, mu0)
        small = -jnp.expm1(-2.0 * half_sine / attenuation.aureole)
        c = attenuation.c[None, :] - attenuation.forward[None, :] * small[:, None]
        growth = 1.0 + rays.direction[:, 2] / mu0  # of the way from the surface to the eye
        onward = growth >= 0
        bright = jnp.where(onward, first, last)
        step = jnp.where(onward, width, -width)
        fade = c * (jnp.abs(growth) * width)[:, None]
        ratio = jnp.exp(-fade)

        def add(i, total):
            t = bright + (self.steps - 1 - i + 0.5) * step
            dark = stretch.dark(scene, rays, t)
            return total * ratio + dark.astype(total.dtype)[:, None]

        total = jax.lax.fori_loop(0, self.steps, add, jnp.zeros_like(ratio))
        # Keeps the exponent of unused elements finite, so that gradients stay finite.
        way = rays.origin[:, 2] / mu0 + growth * bright
        begin = jnp.exp(-c * jnp.maximum(way, 0.0)[:, None])
        turned = homogeneous(scene).volume_scattering(1.0 - 2.0 * half_sine**2)
        mean = exp_mean(jnp.zeros_like(fade), fade)
        return turned * beam[None, :] * begin * width[:, None] * mean * total


def Shadows(base: AbstractTransport, steps: int = 48) -> WithObjects:
    """The former name of `WithObjects`."""
    warnings.warn("Shadows is now WithObjects.", DeprecationWarning, stacklevel=2)
    return WithObjects(base, steps)


@eqx.filter_jit
def _radiance_with_objects(transport: WithObjects, scene: Scene, rays: Rays, key) -> Estimate:
    return transport._whole(scene, rays, key)


class _Line(NamedTuple):
    """Lines of sight and where they end: at an object if `met`, or at `length` metres."""

    rays: Rays
    hit: Hits
    met: Bool[Array, " ray"]
    length: Float[Array, " ray"]


def _line(scene: Scene, rays: Rays) -> _Line:
    hit, met = _meet(scene, rays)
    distance = jnp.where(met, hit.distance, ENDLESS)
    length = distance if rays.length is None else jnp.minimum(distance, rays.length)
    # An object that touches the eye ends the ray at once.
    return _Line(rays, hit, met & (distance <= length), jnp.maximum(length, 1e-6))


def _images(scene: Scene, rays: Rays) -> tuple[Rays, Float[Array, "ray wl"]]:
    """Upward lines of sight, mirrored in the surface, and the share of their light that arrives."""
    assert scene.surface is not None
    z, steep = rays.origin[:, 2], jnp.maximum(jnp.abs(rays.direction[:, 2]), _STEEP)
    rise = z / steep
    turned = jnp.concatenate([rays.direction[:, :2], steep[:, None]], axis=1)
    turned = turned / jnp.linalg.norm(turned, axis=1, keepdims=True)
    across = rays.origin[:, :2] + rise[:, None] * rays.direction[:, :2]
    mirrored = Rays(jnp.concatenate([across, jnp.zeros_like(rise)[:, None]], axis=1), turned)
    share = fresnel_from_water(steep, scene.surface.index.astype(z.dtype))
    thinned = jnp.exp(
        -DeltaScaledWater(homogeneous(scene)).attenuation.c_star[None, :] * rise[:, None]
    )
    return mirrored, share[:, None] * thinned


def _on_objects(
    scene: Scene, light: _surface_irradiance.LightBetweenDepths, hit: Hits, at
) -> Float[Array, "ray wl"]:
    """Radiance that objects send to the eye: sun where it reaches them, and diffuse light."""
    free = ~_blocked(scene, at, _surface_irradiance.to_sun(scene))
    return (
        hit.reflectance
        / jnp.pi
        * _surface_irradiance.irradiance(scene, light, at, hit.normal, free)
    )


def _without_objects(scene: Scene) -> Scene:
    return dataclasses.replace(scene, objects=(), lamps=())


def _blocked(scene: Scene, at, towards) -> Bool[Array, " ray"]:
    far = jnp.asarray(jnp.inf, at.dtype)
    return jax.vmap(lambda x: blocked(scene.objects, x, towards, far))(at)


def _meet(scene: Scene, rays: Rays) -> tuple[Hits, Bool[Array, " ray"]]:
    """The nearest object of each ray, and whether it is met above the floor."""
    if not scene.objects:
        shape = rays.origin.shape[0]
        distance = jnp.full((shape,), jnp.inf, rays.origin.dtype)
        none = jnp.zeros((shape, len(scene.wavelength)), rays.origin.dtype)
        return Hits(distance, jnp.zeros_like(rays.origin), none), jnp.zeros((shape,), bool)
    hit = jax.vmap(lambda o, d: nearest(scene.objects, o, d))(rays.origin, rays.direction)
    met = jnp.isfinite(hit.distance)
    floor = _to_floor(scene, rays)
    if floor is not None:
        met = met & ((rays.direction[:, 2] <= 0) | (hit.distance < floor))
    # Rays that meet nothing get a finite distance: an infinite one would make gradients NaN.
    distance = jnp.where(met, hit.distance, 0.0)
    return Hits(distance, hit.normal, hit.reflectance), met


def _to_floor(scene: Scene, rays: Rays) -> Float[Array, " ray"] | None:
    if scene.floor is None:
        return None
    fall = jnp.maximum(rays.direction[:, 2], _STEEP)
    return (scene.floor.depth - rays.origin[:, 2]) / fall


def _floor_shadow(scene: Scene, at, on_floor) -> Float[Array, "ray wl"]:
    """Radiance that is missing from the floor where an object blocks the sun."""
    assert scene.floor is not None
    mu0, beam = scene.beam()
    dark = on_floor & _blocked(scene, at, _surface_irradiance.to_sun(scene))
    c_star = DeltaScaledWater(homogeneous(scene)).attenuation.c_star
    sun = mu0 * beam * jnp.exp(-c_star * scene.floor.depth / mu0)
    return jnp.where(dark[:, None], (scene.floor.reflectance * sun / jnp.pi)[None, :], 0.0)


def _caustics(scene: Scene, line: _Line) -> Float[Array, "ray wl"]:
    """Change of the floor's radiance by caustics of waves, 0 on average over a tile."""
    surface, floor, rays = scene.surface, scene.floor, line.rays
    far = _to_floor(scene, rays)
    assert floor is not None
    assert surface is not None
    assert surface.waves is not None
    assert far is not None
    lit = ~line.met & (rays.direction[:, 2] > _STEEP) & (far <= line.length)
    far = jnp.where(lit, far, 0.0)
    at = rays.origin + far[:, None] * rays.direction
    if scene.objects:
        lit = lit & ~_blocked(scene, at, _surface_irradiance.to_sun(scene))
    pattern = caustics(surface.waves, scene.light.cosine, surface.index, floor.depth)
    change = looked_up(pattern.astype(at.dtype), surface.waves.tile, at[:, 0], at[:, 1]) - 1.0
    mu0, beam = scene.beam()
    c = homogeneous(scene).c
    sun = mu0 * beam * jnp.exp(-c * floor.depth / mu0)
    arriving = (floor.reflectance / jnp.pi * sun)[None, :] * jnp.exp(-c[None, :] * far[:, None])
    return jnp.where(lit, change, 0.0)[:, None] * arriving


def _bounds(thing) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Centre and radius of a sphere around an object."""
    if isinstance(thing, Sphere):
        return thing.centre, thing.radius
    if isinstance(thing, Box):
        low, high = thing.lower, thing.upper
    else:
        assert isinstance(thing, HeightField)
        top, bottom = thing.extent()
        low = jnp.stack([thing.x0, thing.y0, top])
        size = [n * thing.spacing for n in (thing.depth.shape[1] - 1, thing.depth.shape[0] - 1)]
        high = jnp.stack([thing.x0 + size[0], thing.y0 + size[1], bottom])
    return 0.5 * (low + high), 0.5 * jnp.linalg.norm(high - low)


class _Stretch(NamedTuple):
    """Where on its way a ray may be in the shadow of objects, metres: from `first` to `last`.

    `spheres`: (enter, leave) of each sphere's shadow; other objects are tested point by point.
    """

    first: Float[Array, " ray"]
    last: Float[Array, " ray"]
    spheres: tuple[tuple[Array, Array], ...]

    def dark(self, scene: Scene, rays: Rays, t: Float[Array, " ray"]) -> Bool[Array, " ray"]:
        """Whether the sun is blocked t metres along each ray."""
        dark = jnp.zeros(t.shape, bool)
        for enter, leave in self.spheres:
            dark = dark | ((t > enter) & (t < leave))
        others = tuple(thing for thing in scene.objects if not isinstance(thing, Sphere))
        if others:
            x, towards = (
                rays.origin + t[:, None] * rays.direction,
                _surface_irradiance.to_sun(scene),
            )
            far = jnp.asarray(jnp.inf, t.dtype)
            dark = dark | jax.vmap(lambda y: blocked(others, y, towards, far))(x)
        return dark


def _if_any(rays, compute, like):
    """compute() if any ray needs it, else zeros, which saves work for whole pieces of a picture."""
    return jax.lax.cond(jnp.any(rays), compute, lambda: jnp.zeros_like(like))


def _possible(scene: Scene, rays: Rays, end) -> _Stretch:
    """Where rays cross the cylinders behind the objects' bounding spheres; for a sphere, that is
    its shadow, which begins at its middle: what lies before is the sphere itself."""
    towards = _surface_irradiance.to_sun(scene)
    first, last = jnp.full_like(end, ENDLESS), jnp.zeros_like(end)
    along = rays.direction @ towards
    across = rays.direction - along[:, None] * towards[None, :]
    square = jnp.sum(across**2, axis=1)
    parallel, level = square < 1e-12, jnp.abs(along) < 1e-6
    safe, slope = jnp.where(parallel, 1.0, square), jnp.where(level, 1.0, along)
    spheres = []
    for thing in scene.objects:
        centre, radius = _bounds(thing)
        top = jnp.zeros_like(radius) if isinstance(thing, Sphere) else radius
        apart = rays.origin - centre[None, :]
        height = apart @ towards
        aside = apart - height[:, None] * towards[None, :]
        linear = jnp.sum(aside * across, axis=1)
        constant = jnp.sum(aside**2, axis=1) - radius**2
        root = safe_sqrt(linear**2 - square * constant)
        enter = jnp.where(parallel, 0.0, (-linear - root) / safe)
        leave = jnp.where(parallel, ENDLESS, (-linear + root) / safe)
        within = jnp.where(parallel, constant < 0, root > 0)
        # Behind the object as seen from the sun: height + along t <= top.
        cut = (top - height) / slope
        leave = jnp.where(~level & (along > 0), jnp.minimum(leave, cut), leave)
        enter = jnp.where(~level & (along < 0), jnp.maximum(enter, cut), enter)
        within = within & (~level | (height <= top))
        enter, leave = jnp.maximum(enter, 0.0), jnp.minimum(leave, end)
        within = within & (leave > enter)
        first = jnp.where(within, jnp.minimum(first, enter), first)
        last = jnp.where(within, jnp.maximum(last, leave), last)
        if isinstance(thing, Sphere):
            spheres.append((jnp.where(within, enter, ENDLESS), leave))
    none = last <= first
    return _Stretch(jnp.where(none, 0.0, first), jnp.where(none, 0.0, last), tuple(spheres))
