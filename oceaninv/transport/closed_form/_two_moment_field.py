"""A diffuse light field given by its first two angular moments, as the cheap closed forms use it.

At depth z, with the functions g and s of `_ray_integral`,

    scalar irradiance  E(z) = e.decay e^(-K z) + e.beam e^(-k0 z) + e.mixed g(z) + e.grow s(z)
    net downward flux  F(z) = f.decay e^(-K z) + f.beam e^(-k0 z) + f.mixed g(z) + f.grow s'(z).

The multiply scattered source is then (b* E + 3 mu b* g F)/(4 pi).
"""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv.foundation.numerics import exp_mean
from oceaninv.transport.closed_form._ray_integral import (
    AbstractDiffuseField,
    Path,
    ScaledAttenuation,
)
from oceaninv.water.iops import IOPs

# Angular scale (twice the sine of half the angle) below which the forward peak still attenuates.
_AUREOLE = 0.138


class DeltaScaledWater(eqx.Module):
    """Delta-scaled water: the share chi_2 of scattering counts as unscattered light (1/m)."""

    attenuation: ScaledAttenuation
    b_star: Float[Array, " wl"]
    bg_star: Float[Array, " wl"]

    def __init__(self, water: IOPs):
        moments = water.scattering_moments(2)
        b, first, second = moments[0], moments[1], moments[2]
        self.b_star = b - second
        self.bg_star = first - second
        # Capped, so that a phase function that is all forward peak still attenuates.
        forward = jnp.where(second > 0.995 * b, 0.995 * b, second)
        self.attenuation = ScaledAttenuation(water.a + b, water.a + self.b_star, forward, _AUREOLE)


class MomentTerms(eqx.Module):
    """Coefficients of one moment of the diffuse field; a term that is None does not exist."""

    decay: Float[Array, " wl"]
    beam: Float[Array, " wl"] | None = None
    mixed: Float[Array, " wl"] | None = None
    grow: Float[Array, " wl"] | None = None

    def __call__(self, decay, beam, mixed, grow) -> Float[Array, "rows wl"]:
        """The sum of the terms that exist, given the values (rows, wl) of each basis function."""
        total = self.decay[None, :] * decay()
        for coefficient, basis in ((self.beam, beam), (self.mixed, mixed), (self.grow, grow)):
            if coefficient is not None:
                total = total + coefficient[None, :] * basis()
        return total


class TwoMomentField(AbstractDiffuseField):
    """`K`: diffuse attenuation (1/m); `e`, `f`: moments; `b_star`, `bg_star`: scattering (1/m)."""

    attenuation: ScaledAttenuation
    b_star: Float[Array, " wl"]
    bg_star: Float[Array, " wl"]
    K: Float[Array, " wl"]
    mu0: Float[Array, ""]
    beam: Float[Array, " wl"]
    e: MomentTerms
    f: MomentTerms
    bottom: Float[Array, ""] | None

    def __init__(
        self,
        scaled_water: DeltaScaledWater,
        K,
        mu0,
        beam,
        e: MomentTerms,
        f: MomentTerms,
        bottom=None,
    ):
        self.attenuation, self.b_star, self.bg_star = (
            scaled_water.attenuation,
            scaled_water.b_star,
            scaled_water.bg_star,
        )
        self.K, self.mu0, self.beam = K, mu0, beam
        self.e, self.f, self.bottom = e, f, bottom

    def moments(self, z: Float[Array, " depth"]):
        """E and F of the diffuse light at depths z, each (depth, wl)."""
        z = z[:, None]
        k, k0 = self.K[None, :], self.k0[None, :]
        shared = (
            lambda: jnp.exp(-k * z),
            lambda: jnp.exp(-k0 * z),
            lambda: -z * exp_mean(k * z, k0 * z),
        )

        def grow():
            assert self.bottom is not None
            return z * exp_mean(k * (self.bottom - z), k * (self.bottom + z))

        def slope():
            assert self.bottom is not None
            return 0.5 * (jnp.exp(-k * (self.bottom - z)) + jnp.exp(-k * (self.bottom + z)))

        return self.e(*shared, grow), self.f(*shared, slope)

    def multiply_scattered(
        self, path: Path, direction: Float[Array, "ray 3"]
    ) -> Float[Array, "ray wl"]:
        k = self.K[None, :]
        decaying = path.decay(k)
        shared = (
            lambda: decaying,
            functools.cache(lambda: path.decay(path.k0)),
            functools.cache(lambda: path.mixed(k, decaying)),
        )
        isotropic = self.b_star[None, :] * self.e(*shared, lambda: path.grow(k))
        net = self.f(*shared, lambda: path.slope(k))
        forward = -3.0 * path.down * self.bg_star[None, :] * net
        return (isotropic + forward) / (4.0 * jnp.pi)
