"""The two-stream model: a closed form from a and b, the default of the toolkit."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from oceaninv.foundation.interface_optics import Rays, diffuse_reflectance
from oceaninv.foundation.numerics import exp_mean, safe_ratio, safe_sqrt
from oceaninv.scene.scene import Floor, Scene
from oceaninv.transport.base import (
    AbstractTransport,
    Estimate,
    Irradiance,
    deterministic,
    homogeneous,
)
from oceaninv.transport.closed_form._ray_integral import radiance
from oceaninv.transport.closed_form._two_moment_field import (
    DeltaScaledWater,
    MomentTerms,
    TwoMomentField,
)
from oceaninv.water.attenuation import irradiance_reflectance

_ROOT3 = 3.0**0.5
_LAG = (0.146, -0.389, 0.124)


class TwoStream(AbstractTransport):
    """Delta-Eddington two-stream field as the source of a closed-form ray integral.

    - **Solves**: homogeneous water, deep or over a Lambertian floor, with or without a flat
      surface, sun and uniform sky; single scattering with the true phase function, multiple
      scattering from the two-stream field, both legs of the path delta-scaled by chi_2.
    - **Neglects**: azimuth dependence and angular detail of multiply scattered light; the sun's
      own disc; layers (ValueError).
    - **Cost**: O(1) per ray and wavelength, about 10 exponentials.
    - **Measured error** (`tests/acceptance/two_stream_accuracy.md`, `two_stream_irradiance.md`):
      radiance median 6 %, 90th percentile 22 % beyond 20 degrees of the refracted sun; Ed to the
      1 % light level median 1 %, 90th percentile 4 %, with or without sky light; E0 2 %; Eu 7 %;
      Ed and Eu within 20 % up to albedo 0.9999.  Single precision costs 1e-4; up to 0.3 % of the
      radiance right at a floor some 1e4 transport lengths down.
    - **Differentiable in** everything, forward and reverse.  In endlessly deep water the true
      derivative in a is infinite at a = 0; it is finite here.

    Upward irradiance does not come from the two-stream field (it would be a third too bright)
    but from a fit of R = Eu/Ed plus the light that the floor sends up.  Ed is the field's net flux
    plus that, with a correction of three constants for the shape that a single diffuse exponential
    cannot represent; for irradiance the sky is a second beam.
    """

    in_pieces = True

    def radiance(self, scene: Scene, rays: Rays, key: Key[Array, ""] | None = None) -> Estimate:
        """See `oceaninv.radiance`."""
        field = solve(scene)
        floor_radiance = None
        if scene.floor is not None:
            at_floor = _own(field, scene.floor.depth[None], scene.floor)[0][0]
            floor_radiance = scene.floor.reflectance * at_floor / jnp.pi
        return deterministic(radiance(field, scene, rays, floor_radiance))

    def irradiance(
        self, scene: Scene, depths: Float[Array, " depth"], key: Key[Array, ""] | None = None
    ) -> Irradiance:
        """See `oceaninv.irradiance`."""
        legs = [_plane(solve(scene, beam), scene, depths) for beam in _beams(scene)]
        down, up, scalar = (functools.reduce(jnp.add, parts) for parts in zip(*legs, strict=True))
        return Irradiance(deterministic(down), deterministic(up), deterministic(scalar))


def _beams(scene: Scene):
    """The sun and the sky as beams under water: (cosine of the zenith, irradiance normal to it).

    Light of a uniform sky comes down within Snell's cone, far steeper than the two-stream's own
    diffuse light: a beam at its flux-weighted mean cosine errs by 2-4 % where that errs by 20-40.
    """
    beams = [scene.beam()]
    if scene.light.diffuse is not None:
        edge, outer = jnp.zeros((), scene.light.diffuse.dtype), 0.0
        if scene.surface is not None:
            index = scene.surface.index.astype(edge.dtype)
            edge = jnp.sqrt((index - 1.0) * (index + 1.0)) / index
            outer = diffuse_reflectance(index)[0]
        cosine = (2.0 / 3.0) * (1.0 + edge + edge**2) / (1.0 + edge)
        beams.append((cosine, jnp.pi * (1.0 - outer) * scene.light.diffuse / cosine))
    return beams


def _own(field: TwoMomentField, depths: Float[Array, " depth"], floor: Floor | None) -> tuple:
    """The two-stream's own Ed, its net downward and scalar irradiance and the sun's part of Ed."""
    e, f = field.moments(depths)
    if floor is not None and e.dtype == jnp.float32:
        e = _from_floor(field, floor, depths, e)
    beam = field.direct(depths)
    sun = field.mu0 * beam
    return 0.5 * (e / _ROOT3 + f) + sun, f + sun, e + beam, sun


def _from_floor(field: TwoMomentField, floor: Floor, depths, e):
    """The diffuse E near a dark floor, without the sum of large terms that cancel there.

    Single precision loses E at a floor many transport lengths down, but not F, whose terms have one
    sign: the floor's own balance gives E there, and the two-stream's equations lead up from it.
    Where sunlight still arrives, above one diffuse length from the floor, and over a floor that is
    brighter than endless water, the sum itself is well conditioned.
    """
    spread = field.attenuation.c_star - field.bg_star
    rho, root = floor.reflectance, _ROOT3 * (1.0 + floor.reflectance)
    flux = field.moments(floor.depth[None])[1]
    sun = field.mu0 * field.direct(floor.depth[None])
    dark = (1.0 - rho) * 3.0 * spread > root * field.K
    at_floor = root[None, :] * flux + (2.0 * _ROOT3 * rho)[None, :] * sun
    at_floor = at_floor / jnp.where(dark, 1.0 - rho, 1.0)[None, :]
    up, k, k0 = (floor.depth - depths)[:, None], field.K[None, :], field.k0[None, :]
    near = dark[None, :] & (k * up < 1.0) & (k0 * depths[:, None] > 20.0)
    x = jnp.where(near, k * up, 0.0)
    rise = (3.0 * spread)[None, :] * flux * up * exp_mean(-x, x)  # up exp_mean: sinh(K up)/K
    return jnp.where(near, at_floor * jnp.cosh(x) + rise, e)


def _plane(field: TwoMomentField, scene: Scene, depths):
    """Ed, Eu and E0 of one beam, each (depth, wl)."""
    water = homogeneous(scene)
    a, bb = water.a, water.bb
    own, net, scalar, sun = _own(field, depths, scene.floor)
    # R depends on the mean cosine of the downward light, from the sun's to 0.7 of a diffuse field.
    share = 1.0 - safe_ratio(sun, own)
    cosine = jnp.maximum(field.mu0 + share * (0.7 - field.mu0), 0.4)
    reflectance = irradiance_reflectance(a, bb, 1.0)[None, :] / cosine**1.314
    floor_light = back = jnp.zeros_like(net)
    if scene.floor is not None:
        # The water between here and the floor shows less than endless water would; the floor
        # shows through.
        floor = scene.floor
        at_floor = _own(field, floor.depth[None], floor)[0]
        back = jnp.exp(-(a + bb)[None, :] / 0.5 * (floor.depth - depths)[:, None])
        floor_light = (floor.reflectance[None, :] - reflectance) * at_floor * back
    # The net flux is the two-stream's best number and its Eu the worst: Ed = net + Eu of the fit.
    down = (net + floor_light) / (1.0 - reflectance)
    surface = _own(field, jnp.zeros_like(depths[:1]), None)[0]
    level = jnp.maximum(safe_ratio(own, surface), float(np.finfo(a.dtype).tiny) ** 0.5)
    down = down * jnp.exp(_lag(field, a, -jnp.log(level)))
    # Where next to nothing is absorbed (milk, foam) the fit of R ends and diffusion is right; near
    # the floor Eu stays the floor's, as a difference it would be lost in single precision.
    x = jnp.clip((safe_ratio(bb, a + bb) - 0.5) / 0.25, 0.0, 1.0)
    diffusive = (x**2 * (3.0 - 2.0 * x))[None, :]
    down = down + diffusive * (own - down)
    up = reflectance * down + floor_light
    up = up + diffusive * (1.0 - back) * (own - net - up)
    return down, up, scalar


def _lag(field: TwoMomentField, a, q):
    """ln of exact over two-stream Ed at the depth where light has decayed to e^(-q).  Under a
    slanting sun, the single diffuse exponential first gives too much light, then too little.

    Three constants fitted to the exact model in 1248 random waters (Henyey-Greenstein 0.75-0.95,
    Petzold, Fournier-Forand of 0.6-3 % backscatter; albedo 0.2-0.97, sun to 60 degrees under
    water), to the 1 % level; it still helps at the 0.01 % level and is bounded beyond.
    """
    q = q / (1.0 + (q / 10.0) ** 4) ** 0.25
    albedo = safe_ratio(field.b_star, a + field.b_star)
    slant = albedo * (_LAG[0] + 1.0 - field.mu0)
    return slant[None, :] * q * (_LAG[1] + _LAG[2] * q)


def solve(scene: Scene, beam=None) -> TwoMomentField:
    """The two-stream field of a scene with one homogeneous water.

    `beam`: the only light, (cosine of its zenith, irradiance normal to it); by default the sun,
    and the sky as diffuse light.
    """
    medium = homogeneous(scene)
    water, a = DeltaScaledWater(medium), medium.a
    c_star = water.attenuation.c_star
    diffuse = scene.light.diffuse if beam is None else None
    mu0, beam = scene.beam() if beam is None else beam
    # Transport coefficient a + b (1 - chi_1): positive unless the water is a vacuum.
    spread = jnp.maximum(c_star - water.bg_star, float(np.finfo(a.dtype).tiny) ** 0.5)
    squared = 3.0 * a * spread
    if scene.floor is not None:
        # Over a floor the light field is regular in K^2, but the slope of the root at 0 is
        # infinite.  A negligible least value without derivative keeps derivatives right at a = 0.
        least = (2e-14 if a.dtype == jnp.float64 else 1e-9) * jnp.minimum(spread**2, 1.0)
        squared = squared + jax.lax.stop_gradient(jnp.maximum(least - squared, 0.0))
    K = safe_sqrt(squared)
    k0 = c_star / mu0
    ratio = K / (3.0 * spread)
    drive = -3.0 * beam * (water.b_star * c_star + water.bg_star * a)
    mixed = drive / jnp.maximum(k0 + K, float(np.finfo(a.dtype).tiny) ** 0.5)
    # ws F0/k0 and N/k0 with the common factor c* cancelled: c* may be 0.
    flux_beam = -mu0 * (ratio * safe_ratio(mixed, c_star) + beam * safe_ratio(water.b_star, c_star))

    dtype = a.dtype
    inner = outer = jnp.zeros((), dtype)
    if scene.surface is not None:
        outer, inner = diffuse_reflectance(scene.surface.index.astype(dtype))
    top_e, top_f = 1.0 - inner, _ROOT3 * (1.0 + inner)
    entering = -top_f * flux_beam
    if diffuse is not None:
        entering = entering + 2.0 * jnp.pi * _ROOT3 * (1.0 - outer) * diffuse

    bottom = None
    growing = None
    if scene.floor is None:
        decaying = entering / (top_e + top_f * ratio)
    else:
        bottom = scene.floor.depth
        decaying, growing = _over_floor(
            scene.floor, K, k0, mu0, ratio, spread, beam, mixed, flux_beam, top_e, top_f, entering
        )
    return TwoMomentField(
        water,
        K=K,
        mu0=mu0,
        beam=beam,
        e=MomentTerms(decaying, None, mixed, None if growing is None else 3.0 * spread * growing),
        f=MomentTerms(
            ratio * decaying,
            flux_beam,
            ratio * mixed,
            None if growing is None else -growing,
        ),
        bottom=bottom,
    )


def _over_floor(floor, K, k0, mu0, ratio, spread, beam, mixed, flux_beam, top_e, top_f, entering):
    """Amplitudes of the function that decays from the surface and of the one that grows towards the
    floor.  The second is regular where K = 0, unlike the exponential e^(-K (T - z)) alone."""
    depth, rho = floor.depth, floor.reflectance
    across = jnp.exp(-K * depth)
    sun = jnp.exp(-k0 * depth)
    pair = -depth * exp_mean(K * depth, k0 * depth)
    floor_e, floor_f = 1.0 - rho, _ROOT3 * (1.0 + rho)
    returned = (
        2.0 * _ROOT3 * rho * mu0 * beam * sun
        - floor_e * mixed * pair
        + floor_f * (ratio * mixed * pair + flux_beam * sun)
    )
    grown = 3.0 * spread * depth * exp_mean(jnp.zeros_like(K), 2.0 * K * depth)
    a11, a12 = top_e + top_f * ratio, -top_f * across
    a21 = (floor_e - floor_f * ratio) * across
    a22 = floor_e * grown + 0.5 * floor_f * (1.0 + across**2)
    determinant = a11 * a22 - a12 * a21
    return (
        (entering * a22 - a12 * returned) / determinant,
        (a11 * returned - a21 * entering) / determinant,
    )
