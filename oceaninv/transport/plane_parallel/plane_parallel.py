"""The exact light field of horizontally uniform water, by discrete ordinates."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from oceaninv.foundation.interface_optics import Rays, fresnel_from_water, scattering_half_sine
from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.foundation.quadrature import Basis, angular_basis, double_gauss, legendre, snell_gauss
from oceaninv.scene.scene import Floor, Scene
from oceaninv.transport.base import (
    AbstractTransport,
    Estimate,
    Irradiance,
    deterministic,
    inelastic_orders_of,
)
from oceaninv.transport.plane_parallel import (
    _column,
    _inelastic_orders,
    _inelastic_source,
    _line_of_sight,
    _source_table,
)
from oceaninv.water.iops import IOPs


class Fluxes(eqx.Module):
    """Irradiances at depths, (depth, wl), in the unit of the light.

    `Ed`, `Eu`: plane irradiance, down and up, the sunbeam included.  `E0d`, `E0u`: scalar
    irradiance of the light that travels down and up.
    """

    Ed: Float[Array, "depth wl"]
    Eu: Float[Array, "depth wl"]
    E0d: Float[Array, "depth wl"]
    E0u: Float[Array, "depth wl"]

    @property
    def E0(self) -> Float[Array, "depth wl"]:
        """Scalar irradiance."""
        return self.E0d + self.E0u

    @property
    def mean_cosine(self) -> Float[Array, "depth wl"]:
        """Mean cosine of the whole field, (Ed - Eu)/E0."""
        return (self.Ed - self.Eu) / self.E0


def quadrature(scene: Scene, streams: int, dtype) -> tuple[Array, Array]:
    """Nodes and weights of a hemisphere, split at the critical cosine if there is a surface."""
    if scene.surface is None:
        mu, weight = (jnp.asarray(v, dtype=dtype) for v in double_gauss(streams))
        return mu, weight
    return snell_gauss(streams, scene.surface.index.astype(dtype))


def _flux_moments(scene: Scene, streams: int) -> int:
    """Legendre moments for fluxes: as many as keep the discrete scattering operator positive for
    any phase function, however peaked: two per stream, and 7/4 on nodes split at a surface."""
    return 2 * streams if scene.surface is None else 2 * (7 * streams // 8)


def _radiance_moments(streams: int) -> int:
    """Legendre moments for radiances: 5/4 per stream.  Nodes of a half range integrate products of
    more moments badly; this hardly affects fluxes, but costs radiances of peaked phase functions a
    digit.  What remains of it `angular_basis` removes: functions made orthonormal on the nodes."""
    return -2 * (-5 * streams // 8)


def _water(scene: Scene, moments: int) -> _column.Water:
    """Layers stacked, with the wavelength first."""
    if isinstance(scene.water, IOPs):
        layers, edges = (scene.water,), jnp.zeros((0,), dtype=scene.light.direct.dtype)
    else:
        layers, edges = scene.water.iops, scene.water.interfaces
    if scene.floor is not None:
        edges = jnp.concatenate([edges, scene.floor.depth[None].astype(edges.dtype)])
    thickness = jnp.diff(edges, prepend=jnp.zeros((1,), dtype=edges.dtype))
    if scene.floor is None and isinstance(scene.water, IOPs):
        thickness = edges
    return _column.Water(
        jnp.stack([w.a for w in layers], axis=1),
        jnp.stack([w.scattering_moments(moments).T for w in layers], axis=1),
        thickness,
    )


def _sources(scene: Scene, mu: Array, moments: int, orders: int) -> _column.Sources:
    """The light that enters, with leading axes (order,) in `angular`, (wl,) in `sun` and `floor`,
    (order, wl) in `sky`: sky and floor send light to order 0 only."""
    cosine, sun = scene.beam()
    angular = legendre(cosine[None], orders, moments)[:, :, 0]
    double = np.where(np.arange(orders) == 0, 1.0, 2.0)
    angular = angular * jnp.asarray(double, dtype=mu.dtype)[:, None]
    surface, through = None, jnp.ones_like(mu)
    if scene.surface is not None:
        index = scene.surface.index.astype(mu.dtype)
        surface = fresnel_from_water(mu, index)
        through = (1 - surface) * index**2
    sky = None
    if scene.light.diffuse is not None:
        sky = (scene.light.sky_radiance(_in_air(scene, mu)) * through[:, None]).T
        sky = jnp.pad(sky[None], [(0, orders - 1), (0, 0), (0, 0)])
    floor = None if scene.floor is None else scene.floor.reflectance
    return _column.Sources(cosine, sun, angular, sky, surface, floor)


def _in_air(scene: Scene, mu: Array) -> Array:
    """Cosine in air of light whose cosine in the water is mu; 0 beyond the critical angle."""
    if scene.surface is None:
        return mu
    index = scene.surface.index.astype(mu.dtype)
    return safe_sqrt(1 - index**2 * (1 - mu) * (1 + mu))


def _solve(
    scene: Scene, streams: int, orders: int, moments: int, orthonormal: bool = False
) -> tuple[_column.Column, Basis, _column.Sources]:
    """The field of every azimuth order (first axis) and wavelength (second axis), the bases of
    the orders, and the light that enters."""
    mu, weight = quadrature(scene, streams, scene.light.direct.dtype)
    bases = angular_basis(mu, weight, orders, moments, orthonormal)
    sources = _sources(scene, mu, moments, orders)
    water_axes = _column.Water._make((0, 0, None))
    by_wavelength = _axes(sources, (None, 0, None, 0, None, 0))
    by_order = _axes(sources, (None, None, 0, 0, None, None))
    solve = jax.vmap(_column.solve, (water_axes, by_wavelength, None))
    solve = jax.vmap(solve, (None, by_order, 0))
    return solve(_water(scene, moments), sources, bases), bases, sources


def _axes(sources: _column.Sources, axes: tuple) -> _column.Sources:
    """Axes to map over, for the terms that exist."""
    pairs = zip(sources, axes, strict=True)
    return _column.Sources._make(None if source is None else axis for source, axis in pairs)


def _first(tree):
    return jax.tree.map(lambda leaf: leaf[0], tree)


@eqx.filter_jit
def _fluxes(
    scene: Scene, depths: Float[Array, " depth"], streams: int, inelastic_orders: int, slopes: bool
) -> tuple[Fluxes, ...]:
    """The fluxes and, with `slopes`, their derivatives with depth."""
    columns, bases, sources = _solve(scene, streams, 1, _flux_moments(scene, streams))
    cosine, sun = scene.beam()
    emitted = None
    if scene.inelastic is not None:
        emitted = _first(
            _inelastic_orders.emission(scene, columns, bases, sources, inelastic_orders)
        )
    columns, basis = _first((columns, bases))

    def weighted(down, up, beam):
        flux = 2 * np.pi * basis.flux
        scalar = flux / basis.mu
        return jnp.stack(
            [down @ flux + cosine * beam, up @ flux, down @ scalar + beam, up @ scalar]
        )

    def at(column, emitted, sun, z):
        here, share, *light = _column.locate(column, z, *([] if emitted is None else [emitted]))
        down, up, depth = _column.within(here, share)
        beam = sun * jnp.exp(-depth / cosine)
        fluxes = weighted(down, up, beam)
        changes = []
        if slopes:
            dbeam = -here.layer.extinction / cosine * beam
            changes.append(weighted(*_column.slope_at(here, share, down, up), dbeam))
        for glow, field in light:
            down, up = _inelastic_source.inside(share, here.layer, here.modes, glow, field)
            fluxes = fluxes + weighted(down, up, jnp.zeros_like(sun))
            if slopes:
                dlight = _inelastic_source.slope_at(here, glow, share, down, up)
                changes.append(weighted(*dlight, jnp.zeros_like(sun)))
        return (fluxes, sum(changes)) if slopes else (fluxes,)

    over_wavelength = jax.vmap(at, (0, 0, 0, None))
    over_depth = jax.vmap(over_wavelength, (None, None, None, 0))
    found = over_depth(columns, emitted, sun, depths)
    return tuple(Fluxes(*jnp.moveaxis(each, -1, 0)) for each in found)


@eqx.filter_jit
def _left(scene: Scene, streams: int, inelastic_orders: int) -> Float[Array, ""]:
    solved = _solve(scene, streams, 1, _flux_moments(scene, streams))
    return _inelastic_orders.left(scene, *solved, inelastic_orders)


_HORIZON = 1e-3  # lines of sight closer to horizontal than this count as if this far from it
_BATCH = 64  # rays computed at a time
_SHARP = 4  # degrees of the sunlight's own scattering, per degree of the diffuse light's


class _SolvedField(NamedTuple):
    """The light field of a scene, prepared for the integration along lines of sight.

    `mean`: azimuth order 0 of `columns`; `cosine`, `sun`: the sunbeam below the surface; `sharp`:
    the Legendre moments of the phase functions that the blur of single scattering takes.  What a
    scene lacks is None: `floor_radiance` (wl,); `emitted`, inelastic light in `emitted_orders`
    azimuth orders; `table`, the tabulated source functions.
    """

    columns: _column.Column
    bases: Basis
    mean: _column.Column
    cosine: Array
    sun: Array
    sharp: Array
    floor_radiance: Array | None
    emitted: _inelastic_source.Column | None
    emitted_orders: int
    table: _source_table.Table | None


def _field_for_radiance(
    scene: Scene, streams: int, orders: int, inelastic_orders: int, knots: int | None
) -> _SolvedField:
    moments = _radiance_moments(streams)
    columns, bases, sources = _solve(scene, streams, orders, moments, orthonormal=True)
    cosine, sun = scene.beam()
    sharp = _water(scene, _SHARP * moments - 1).moments
    mean = _first((columns, bases))
    floor_radiance = None
    if scene.floor is not None:
        floor_radiance = _floor_radiance(scene.floor, cosine, sun, *mean)
    emitted, emitted_orders = None, 0
    if scene.inelastic is not None:
        emitted = _inelastic_orders.emission(scene, columns, bases, sources, inelastic_orders)
        emitted_orders = _inelastic_orders.azimuth_orders(scene, orders)
        if scene.floor is not None and floor_radiance is not None:
            down = emitted.field.bottom_down[0, :, -1] @ mean[1].flux
            floor_radiance = floor_radiance + 2 * scene.floor.reflectance * down
    table = None
    if knots is not None:
        table = _source_table.tabulate(columns, bases, knots, endless=scene.floor is None)
    return _SolvedField(
        columns, bases, mean[0], cosine, sun, sharp, floor_radiance, emitted, emitted_orders, table
    )


def _gathered(
    scene: Scene, field: _SolvedField, orders: int, moments: int, z, direction
) -> tuple[Float[Array, " wl"], Float[Array, " wl"]]:
    """The light of the water along a line of sight up to the surface or floor, and the
    transmittance to there."""
    layers = _inelastic_orders.layers_of(scene)
    columns, bases, mean, cosine = field.columns, field.bases, field.mean, field.cosine
    root = np.sqrt(2 * np.arange(_SHARP * moments) + 1)
    mu = jnp.maximum(jnp.abs(direction[2]), _HORIZON)
    sight = _line_of_sight.Sight(z, mu, direction[2] >= 0)
    level = safe_sqrt(direction[0] ** 2 + direction[1] ** 2)
    vertical = level < 1e-6
    across = jnp.where(vertical, 1.0, direction[0] / jnp.where(vertical, 1.0, level))
    azimuth = _cosines(across, orders)
    angular = legendre(mu[None], orders, moments)[:, :, 0]
    half_sine = scattering_half_sine(direction[None], cosine)
    turned = 1 - 2 * half_sine**2
    vsf = jnp.stack([w.volume_scattering(turned)[0] for w in layers], axis=1)
    polynomials = legendre(turned, 1, _SHARP * moments)[0, :, 0]
    polynomials = polynomials / jnp.asarray(root, dtype=polynomials.dtype)
    single = jax.vmap(_line_of_sight.single_scattering, (0, None, 0, None, 0, 0, None))
    clear = jax.vmap(lambda column: _line_of_sight.stretches(column, sight)[1])(mean)
    total = single(mean, sight, field.sharp, polynomials, vsf, field.sun, cosine)
    if field.table is None:
        over_wavelength = jax.vmap(_line_of_sight.multiple_scattering, (0, None, None, None))
        multiple = jax.vmap(over_wavelength, (0, 0, None, 0))(columns, bases, sight, angular)
        total = total + azimuth @ multiple
    else:
        odd = (np.arange(orders)[:, None] + np.arange(moments)) % 2 == 1
        towards = azimuth[:, None] * jnp.where(sight.up & odd, -angular, angular)
        here = jax.vmap(_line_of_sight.depth_of, (0, None))(mean, z)
        total = total + jax.vmap(_source_table.seen, (0, 0, None, None))(
            field.table, here, sight, towards
        )
    if field.emitted is not None:
        count = field.emitted_orders
        parts = jax.tree.map(lambda leaf: leaf[:count], (columns, field.emitted, bases))
        along = jax.vmap(_inelastic_source.along, (0, 0, None, None, None))
        along = jax.vmap(along, (0, 0, 0, None, 0))
        each = along(parts[0], parts[1], parts[2], sight, angular[:count])
        total = total + azimuth[:count] @ each
    return total, clear


def _ends(scene: Scene, rays: Rays) -> tuple[Array, Array]:
    """The depth at which each ray ends, and whether it ends in the water; else its own depth."""
    z = rays.origin[:, 2]
    if rays.length is None:
        return z, jnp.ones_like(z, dtype=bool)
    end = z + rays.length * rays.direction[:, 2]
    ended = end >= 0
    if scene.floor is not None:
        ended = ended & (end <= scene.floor.depth)
    return jnp.where(ended, end, z), ended


def _background(scene: Scene, field: _SolvedField, direction, steep, mirrored) -> Array:
    """(ray, wl) radiance at the far ends of endless rays: of the floor, or of the sky through the
    surface and the water's image in it.  `mirrored`: what `_gathered` gives for the image."""
    floor = jnp.zeros_like(field.sun) if field.floor_radiance is None else field.floor_radiance
    background = scene.light.sky_radiance(_in_air(scene, steep))
    if scene.surface is not None:
        index = scene.surface.index.astype(steep.dtype)
        reflectance = fresnel_from_water(steep, index)[:, None]
        image, through = mirrored
        background = (1 - reflectance) * index**2 * background
        background = background + reflectance * (image + floor[None, :] * through)
    return jnp.where(direction[:, 2:] >= 0, floor[None, :], background)


@eqx.filter_jit
def _radiance(
    scene: Scene, rays: Rays, streams: int, orders: int, inelastic_orders: int, knots: int | None
) -> Float[Array, "ray wl"]:
    field = _field_for_radiance(scene, streams, orders, inelastic_orders, knots)
    # One program gathers the light of all lines of sight: those of the eye, their images in the
    # surface and the continuations of finite rays.
    z, direction = rays.origin[:, 2], rays.direction
    steep = jnp.maximum(jnp.abs(direction[:, 2]), _HORIZON)
    sights = [(z, direction)]
    if scene.surface is not None:
        mirrored = jnp.concatenate([direction[:, :2], steep[:, None]], axis=1)
        sights.append((jnp.zeros_like(z), mirrored))
    end, ended = _ends(scene, rays)
    if rays.length is not None:
        sights.append((end, direction))
    every = tuple(jnp.concatenate(parts) for parts in zip(*sights, strict=True))
    moments = _radiance_moments(streams)
    lights, clears = jax.lax.map(
        lambda sight_line: _gathered(scene, field, orders, moments, *sight_line),
        every,
        batch_size=_BATCH if knots is None else 4 * _BATCH,
    )
    pairs = list(zip(jnp.split(lights, len(sights)), jnp.split(clears, len(sights)), strict=True))
    background = _background(
        scene, field, direction, steep, None if scene.surface is None else pairs[1]
    )
    whole = pairs[0][0] + pairs[0][1] * background
    if rays.length is None:
        return whole
    # Light scattered forward out of the beam still arrives, so the two ends of a finite ray are
    # joined by the whole attenuation, not by the delta-scaled one.
    path = jax.vmap(_path, (None, 0, 0, 0))(scene, z, end, jnp.where(ended, rays.length, 0.0))
    attenuation = jnp.stack([w.c for w in _inelastic_orders.layers_of(scene)])
    beyond = pairs[-1][0] + pairs[-1][1] * background
    beyond = jnp.exp(-(path @ attenuation)) * beyond
    return jnp.where(ended[:, None], whole - beyond, whole)


def _path(scene: Scene, z, end, length) -> Float[Array, "layer"]:
    """Length of a ray in each layer."""
    if isinstance(scene.water, IOPs):
        return length[None]
    edges = scene.water.interfaces
    top, bottom = jnp.minimum(z, end), jnp.maximum(z, end)
    flat = bottom - top < 1e-6 * length
    above = jnp.concatenate([jnp.clip(edges, top, bottom), bottom[None]])
    share = jnp.diff(above, prepend=top[None]) / jnp.where(flat, 1.0, bottom - top)
    layer = jnp.arange(edges.shape[0] + 1) == jnp.sum(z > edges)
    return length * jnp.where(flat, layer.astype(share.dtype), share)


def _cosines(x: Float[Array, ""], count: int) -> Float[Array, "order"]:
    """cos(m phi) for x = cos(phi), m < count (Chebyshev's recurrence)."""
    values = [jnp.ones_like(x), x]
    for _ in range(2, count):
        values.append(2 * x * values[-1] - values[-2])
    return jnp.stack(values[:count])


def _floor_radiance(floor: Floor, cosine, sun, columns, basis) -> Float[Array, "wl"]:
    """Radiance that a Lambertian floor sends up."""
    diffuse = 2 * np.pi * columns.field.bottom_down[:, -1] @ basis.flux
    depth = columns.start[:, -1] + columns.layer.depth[:, -1]
    return floor.reflectance * (diffuse + cosine * sun * jnp.exp(-depth / cosine)) / np.pi


class PlaneParallel(AbstractTransport):
    """Exact light field of horizontally uniform water, by discrete ordinates.

    - **Solves**: the radiative transfer equation in any number of homogeneous layers, endlessly
      deep or over a Lambertian floor, under a flat Fresnel surface or none, with sun (refracted)
      and any sky.  Delta-M scaling (Wiscombe 1977), single scattering with the exact phase
      function, blurred by the forward peak (`_line_of_sight.single_scattering`), radiance by
      integrating the source function along the line of sight.
    - **Inelastic** light (`Scene(inelastic=...)`): `inelastic_orders` orders of inelastic
      scattering, by default one; `inelastic_left` bounds the rest.  Sources are sums of
      exponentials of depth, right to 1e-6 in float64.
    - **Neglects**: waves, polarisation, the sun's own disc in radiances.
    - **Settings**: `streams` directions per hemisphere, each with two Legendre moments (fluxes
      under a surface: 7/4, radiances: 5/4); `orders` of azimuth kept in radiances (default: as many
      as streams; fluxes need one, and so do radiances under a sun in the zenith);
      `inelastic_orders`; `knots`: depths per layer at which source functions are tabulated for all
      lines of sight (at least 8), or None: every line is integrated exactly.  For pictures: 48
      knots increase the error of a ray by 1e-3 at most (`test_knots`) at a fraction of the cost.
    - **Cost** per wavelength on one core in float64, 16 streams, 10 depths: 0.1 ms; it grows as
      streams^3 and linearly in layers, orders and wavelengths.
    - **Measured error** (`test_plane_parallel.py` and `test_layer_modes.py` in
      `tests/oceaninv/transport/plane_parallel`):
      Ed and Eu 1e-6 (mean cosine of scattering 0.924: 1e-5) of the beam at 16 streams, 1e-8 at
      48.  E0 in a slab of optical thickness 0.1 or right at a boundary, where light along the
      horizon falls off within a node's own depth: 1e-4 (0.924: 5e-4) at 16 streams, 5e-6 (2e-5)
      at 32, 1e-6 (3e-6) at 40 and 1e-6 of itself at 48.  No later correction can remove this error
      and still let the net flux decrease by a E0, which it does to rounding with any streams.
      Radiance 5e-7 for isotropic scattering at 16 streams and orders, 1e-3 up to g = 0.8; for
      HG 0.924 0.1 % in the median and 6 % at worst at 16, 1e-3 everywhere at 48 (at 32 but for
      0.13 % in places).  Natural waters under a surface (Fournier-Forand particles, 64 waters, 13
      bands; `tests/acceptance/nadir_convergence.md`): Rrs within 0.23 % at 12 streams, 0.52 % at
      16, 0.33 % at 24 and 0.21 % at 32 (median below 0.08 %); Lu within 0.83, 0.76, 0.42 and
      0.26 %; four rays of a photograph within 3.5 % at 16 (median 0.07 %) and 1.3 % at 24.
    - **Differentiable in** everything, forward and reverse.

    Discrete ordinates are used rather than doubling: one symmetric eigenproblem per layer, whose
    functions are regular without absorption and at any thickness, serves every depth and direction
    (doubling costs about five times as much).  Nodes are Gaussian on each hemisphere; under a
    surface they are split at the critical cosine, where the reflectance has a square-root
    singularity, and Gaussian in the cosine in air inside Snell's cone.

    Raises ValueError for less than 2 streams, 1 order, 1 inelastic order or 8 knots.
    """

    streams: int = eqx.field(static=True)
    orders: int = eqx.field(static=True)
    inelastic_orders: int = eqx.field(static=True)
    knots: int | None = eqx.field(static=True)
    inelastic: ClassVar[bool] = True
    any_sky: ClassVar[bool] = True

    def __init__(
        self,
        streams: int = 16,
        orders: int | None = None,
        inelastic_orders: int = 1,
        knots: int | None = None,
        *,
        generations: int | None = None,
    ):
        inelastic_orders = inelastic_orders_of(inelastic_orders, generations)
        if streams < 2:
            raise ValueError(f"streams must be at least 2 per hemisphere, not {streams}.")
        orders = streams if orders is None else orders
        if orders < 1:
            raise ValueError(f"orders must be at least 1, not {orders}.")
        if inelastic_orders < 1:
            raise ValueError(f"inelastic_orders must be at least 1, not {inelastic_orders}.")
        self.streams = streams
        self.orders = orders
        if knots is not None and knots < 8:
            raise ValueError(f"knots must be at least 8 per layer, or None, not {knots}.")
        self.inelastic_orders = inelastic_orders
        self.knots = knots

    def fluxes(self, scene: Scene, depths: Float[Array, " depth"]) -> Fluxes:
        """Plane and scalar irradiances of either hemisphere at depths (m), each (depth, wl)."""
        return _fluxes(scene, depths, self.streams, self.inelastic_orders, False)[0]

    def fluxes_and_slopes(
        self, scene: Scene, depths: Float[Array, " depth"]
    ) -> tuple[Fluxes, Fluxes]:
        """`fluxes`, and their derivatives with depth (per m) from the transfer equation itself.
        Unlike an automatic derivative of `fluxes` with depth, these can be differentiated in
        everything else."""
        fluxes, slopes = _fluxes(scene, depths, self.streams, self.inelastic_orders, True)
        return fluxes, slopes

    def irradiance(
        self, scene: Scene, depths: Float[Array, " depth"], key: Key[Array, ""] | None = None
    ) -> Irradiance:
        """See `oceaninv.irradiance`."""
        fluxes = self.fluxes(scene, depths)
        return Irradiance(*(deterministic(e) for e in (fluxes.Ed, fluxes.Eu, fluxes.E0)))

    def inelastic_left(self, scene: Scene) -> Float[Array, ""]:
        """Bound on the light of all inelastic orders beyond `inelastic_orders`, relative to the
        last of them; nan if the orders do not decrease."""
        return _left(scene, self.streams, self.inelastic_orders)

    def radiance(self, scene: Scene, rays: Rays, key: Key[Array, ""] | None = None) -> Estimate:
        """See `oceaninv.radiance`."""
        return deterministic(
            _radiance(scene, rays, self.streams, self.orders, self.inelastic_orders, self.knots)
        )
