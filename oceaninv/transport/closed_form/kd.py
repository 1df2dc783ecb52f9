"""The cheapest model: radiance when the diffuse attenuation coefficient Kd is given."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from oceaninv.foundation.interface_optics import Rays, diffuse_reflectance
from oceaninv.foundation.numerics import exp_moment
from oceaninv.scene.scene import Scene
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
from oceaninv.water.attenuation import irradiance_reflectance, kd_lee2005
from oceaninv.water.iops import check_concrete


class KdTransport(AbstractTransport):
    """One exponential for the diffuse light: irradiance decays with a given Kd.

    **Arguments:**

    - `kd`: (wl,) mean diffuse attenuation coefficient of Ed over the depths of interest, 1/m, for
      instance from a measured profile; `None` takes Lee et al. 2005 (mean to the 10 % level)
      from the water's a and bb.

    - **Solves**: endlessly deep homogeneous water under a sun; total scalar irradiance from
      Gershun's law, E0 = Kd (Ed - Eu)/a; single scattering with the true phase function.
    - **Neglects**: floor and sky (ValueError when the scene has them), the change of Kd with
      depth.
    - **Cost**: O(1) per ray and wavelength, about 8 exponentials.
    - **Measured error** (`tests/acceptance/two_stream_accuracy.md`): radiance beyond 20 degrees of
      the sun, median 12 % with Lee's Kd and 10 % with the exact one; Ed as good as the Kd that it
      is given (median 13 % with Lee's).
    - **Differentiable in** everything, forward and reverse; a must be positive.
    """

    in_pieces = True

    kd: Float[Array, " wl"] | None

    def __init__(self, kd=None):
        if kd is not None:
            check_concrete("kd", kd)
            kd = jnp.asarray(kd)
        self.kd = kd

    def radiance(self, scene: Scene, rays: Rays, key: Key[Array, ""] | None = None) -> Estimate:
        """See `oceaninv.radiance`."""
        return deterministic(radiance(self._field(scene), scene, rays, None))

    def irradiance(
        self, scene: Scene, depths: Float[Array, " depth"], key: Key[Array, ""] | None = None
    ) -> Irradiance:
        """See `oceaninv.irradiance`."""
        surface_down, reflectance, kd = self._surface(scene)
        down = surface_down[None, :] * jnp.exp(-kd[None, :] * depths[:, None])
        up = reflectance[None, :] * down
        scalar = (kd / homogeneous(scene).a)[None, :] * (down - up)
        return Irradiance(deterministic(down), deterministic(up), deterministic(scalar))

    def _surface(self, scene: Scene):
        """Ed(0-), R = Eu/Ed and Kd, each (wl,)."""
        if scene.floor is not None or scene.light.diffuse is not None:
            raise ValueError(
                "KdTransport solves neither floor nor sky: use TwoStream, or leave them out."
            )
        water = homogeneous(scene)
        mu0, beam = scene.beam()
        kd = kd_lee2005(water.a, water.bb, scene.light.zenith) if self.kd is None else self.kd
        reflectance = irradiance_reflectance(water.a, water.bb, mu0)
        down = mu0 * beam
        if scene.surface is not None:
            inner = diffuse_reflectance(scene.surface.index.astype(down.dtype))[1]
            down = down / (1.0 - inner * reflectance)
        return down, reflectance, kd

    def _field(self, scene: Scene) -> TwoMomentField:
        down, reflectance, kd = self._surface(scene)
        medium = homogeneous(scene)
        mu0, beam = scene.beam()
        net = (1.0 - reflectance) * down
        return TwoMomentField(
            DeltaScaledWater(medium),
            K=kd,
            mu0=mu0,
            beam=beam,
            e=MomentTerms(kd / medium.a * net, -beam),
            f=MomentTerms(net, -mu0 * beam),
        )


def monzon2024(
    b: Float[Array, " wl"],
    c: Float[Array, " wl"],
    kd: Float[Array, " wl"],
    surface_irradiance: Float[Array, " wl"],
    depth: Float[Array, " ray"],
    down: Float[Array, " ray"],
    length: Float[Array, " ray"],
    reflectance=None,
    floor_depth=None,
) -> Float[Array, "ray wl"]:
    """Multiply scattered radiance by the printed closure of Monzon et al. 2024, eq 9.

    Kept for comparison only; its slips (the sign of the depth's exponent, the floor's radiance
    used as an irradiance, plane for scalar irradiance) are left as printed.  `down` is the change
    of depth per metre of ray, `length` the ray's length; coefficients in 1/m.
    """
    k, depth, length = kd[None, :], depth[:, None], length[:, None]
    source = jnp.exp(-k * depth)
    if reflectance is not None and floor_depth is not None:
        source = source + reflectance[None, :] / jnp.pi * jnp.exp(-k * (2 * floor_depth - depth))
    exponent = (k * down[:, None] - c[None, :]) * length
    # (e^x - 1)/x without its removable singularity, for either sign of x.
    integral = length * jnp.exp(jnp.maximum(exponent, 0.0)) * exp_moment(0, jnp.abs(exponent))
    return (b * surface_irradiance)[None, :] / (4 * jnp.pi) * integral * source
