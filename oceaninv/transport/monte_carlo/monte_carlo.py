"""Monte Carlo: walks traced once and weighted at every wavelength."""

import dataclasses
import warnings
from typing import ClassVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from oceaninv.foundation.interface_optics import Rays
from oceaninv.scene.objects import Box, Sphere
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import AbstractTransport, Estimate, Irradiance, inelastic_orders_of
from oceaninv.transport.monte_carlo import _backward, _forward
from oceaninv.transport.monte_carlo._event_loop import Progress, WalkSettings
from oceaninv.transport.monte_carlo._random_numbers import key_words
from oceaninv.transport.monte_carlo._random_walk import Proposal
from oceaninv.transport.monte_carlo._weights import propose


class MonteCarlo(AbstractTransport):
    """Random walks, backward from the eye or forward from the light.

    Solves the radiative transfer equation: radiance for anything a `Scene` holds, irradiance for
    scenes without objects and lamps (ValueError).  Every walk is traced once and
    weighted analytically at every wavelength, so that all bands share its cost.
    Neglects: what happens after `bounces` events (bounded in `Estimate.bias`), polarisation.
    Cost: 1e6 walks of 32 events in 20 bands take about 2 s on two cores.
    Differentiable in a, b, phase parameters, reflectances and the light's spectra, in forward and
    reverse mode, without bias; in geometry (depth, range, sun, index, pose) it raises ValueError.

    **Arguments:**

    - `paths`: walks per ray; for irradiance, in all.  Rounded up to whole groups.  For radiance a
      group has 32 walks; for irradiance it has as many, up to 16384, as leave 64 groups of each
      source.  The walks of such a group share a set of low-discrepancy points, so that errors
      fall faster than with the root of `paths`.
    - `bounces`: events (scatterings and reflections) per walk.
    - `roulette`: whether walks are resampled 8:1 by importance after 6 events.  This saves most of
      the time where light is absorbed; switch it off for white media.  Frozen walks are never
      resampled.
    - `proposal`: what the walks are drawn from; `None` makes it from the scene.
    - `inelastic_orders`: how many changes of wavelength are followed (orders of inelastic
      scattering).  `PlaneParallel.inelastic_left` bounds the light of higher orders.  Above 1, a
      few walks of great weight carry the light of the higher orders, and a run without any such
      walk states too small a `stderr`: repeat it with other keys, or use more walks.
    - `similar`: number of events after which the water is replaced by one that scatters
      isotropically with the coefficient b (1 - g) (similarity theory; Frisvad et al. 2007,
      section 3), so that one event replaces 1/(1 - g) events.  For white media, one band at a time
      (`tests/acceptance/similarity.md`); `bias` is then nan.  Elastic light only.  Choose a small
      number: hundreds of events with a peaked phase function (g above 0.95) give rare walks of
      great weight, and a radiance without any such walk has too small a `stderr`.
    - `progress`: a callback `progress(done, total)`, called when a chunk of walks is done.

    With one key and a frozen proposal the estimate is a smooth function of the water, which is
    what a fit needs: `transport.frozen(scene)`.
    """

    paths: int = eqx.field(static=True)
    bounces: int = eqx.field(static=True)
    roulette: bool = eqx.field(static=True)
    proposal: Proposal | None
    inelastic_orders: int = eqx.field(static=True)
    similar: int | None = eqx.field(static=True)
    progress: Progress | None = eqx.field(static=True)

    draws_objects: ClassVar[bool] = True
    inelastic: ClassVar[bool] = True

    def __init__(
        self,
        paths: int = 2**14,
        bounces: int = 32,
        roulette: bool = True,
        proposal: Proposal | None = None,
        inelastic_orders: int = 1,
        similar: int | None = None,
        progress: Progress | None = None,
        *,
        generations: int | None = None,
    ):
        """Raises ValueError if `paths`, `bounces`, `inelastic_orders` or `similar` is below 1."""
        inelastic_orders = inelastic_orders_of(inelastic_orders, generations)
        counts = {"paths": paths, "bounces": bounces, "inelastic_orders": inelastic_orders}
        for name, value in (counts if similar is None else counts | {"similar": similar}).items():
            if int(value) < 1:
                raise ValueError(f"{name} must be at least 1, not {value}.")
        self.paths = int(paths)
        self.bounces = int(bounces)
        self.roulette = bool(roulette)
        self.proposal = proposal
        self.inelastic_orders = int(inelastic_orders)
        self.similar = None if similar is None else int(similar)
        self.progress = progress

    def frozen(self, scene: Scene) -> "MonteCarlo":
        """This transport with the proposal of a scene: the walks stay the same while the water
        changes.  It serves all scenes with the same number of layers.  Its walks are not resampled,
        because the choice of walks would depend on the water and change discontinuously."""
        return dataclasses.replace(self, proposal=propose(scene))

    def reuse(self, scene: Scene, rays: Rays, key: Key[Array, ""]) -> Float[Array, "ray wl"]:
        """Effective share of the frozen walks: the number of walks drawn for this scene itself
        that give the same standard error as one frozen walk.  Warns below 0.3: freeze again, at
        the present water.  Takes the time of two estimates."""
        fresh = self.frozen(scene).radiance(scene, rays, key)
        frozen = self.radiance(scene, rays, key)
        safe = jnp.where(frozen.stderr > 0, frozen.stderr, 1.0)
        share = jnp.where(frozen.stderr > 0, (fresh.stderr / safe) ** 2, 1.0)
        if not isinstance(share, jax.core.Tracer) and float(jnp.min(share)) < 0.3:
            warnings.warn(
                f"a frozen walk is as good as {float(jnp.min(share)):.2f} walks drawn for this "
                "water: freeze the transport again at a water nearer to it.",
                stacklevel=2,
            )
        return share

    def radiance(self, scene: Scene, rays: Rays, key: Key[Array, ""] | None = None) -> Estimate:
        """See `oceaninv.radiance`; ValueError for an eye inside an object."""
        _check_outside(scene, rays)
        return _backward.radiance(
            scene, rays, _words(key), self.plan, self.proposal, self.inelastic_orders
        )

    def irradiance(
        self, scene: Scene, depths: Float[Array, " depth"], key: Key[Array, ""] | None = None
    ) -> Irradiance:
        """See `oceaninv.irradiance`."""
        if scene.objects or scene.lamps:
            raise ValueError(
                "irradiance at a depth is one number only in horizontally uniform light: ask for "
                "radiance, or leave objects and lamps out of the scene."
            )
        found = _forward.irradiance(
            scene, depths, _words(key), self.plan, self.proposal, self.inelastic_orders
        )
        return Irradiance(*(jax.tree.map(lambda leaf, i=i: leaf[:, i], found) for i in range(3)))

    @property
    def plan(self) -> WalkSettings:
        """The settings in the form that the walks use."""
        roulette = self.roulette and self.proposal is None
        return WalkSettings(self.paths, self.bounces, roulette, self.similar, self.progress)


def _words(key):
    if key is None:
        raise ValueError("MonteCarlo draws random numbers: pass key=jax.random.key(seed).")
    return key_words(key)


def _check_outside(scene: Scene, rays: Rays) -> None:
    """ValueError if a concrete eye is inside a sphere or box."""
    arrays = jax.tree.leaves((scene.objects, rays.origin))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in arrays):
        return
    eyes = np.asarray(rays.origin)
    for i, thing in enumerate(scene.objects):
        inside = np.zeros(len(eyes), bool)
        if isinstance(thing, Sphere):
            inside = np.linalg.norm(eyes - np.asarray(thing.centre), axis=1) < float(thing.radius)
        elif isinstance(thing, Box):
            lower, upper = np.asarray(thing.lower), np.asarray(thing.upper)
            inside = np.all((eyes > lower) & (eyes < upper), axis=1)
        if inside.any():
            raise ValueError(
                f"the eye at {eyes[inside][0].tolist()} m is inside objects[{i}]: put it outside."
            )
