"""Monte Carlo: walks traced once, weighed at every wavelength."""

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
from oceaninv.transport.base import AbstractTransport, Estimate, Irradiance
from oceaninv.transport.monte_carlo import _backward, _forward
from oceaninv.transport.monte_carlo._event_loop import Plan, Progress
from oceaninv.transport.monte_carlo._random_numbers import key_words
from oceaninv.transport.monte_carlo._random_walk import Proposal
from oceaninv.transport.monte_carlo._weights import propose


class MonteCarlo(AbstractTransport):
    """Random walks, backward from the eye or forward from the light.

    Solves the radiative transfer equation: radiance for anything a `Scene` holds, irradiance for
    scenes without objects and lamps (ValueError).  Every walk is traced once and
    weighed analytically at every wavelength, so that all bands share its cost.
    Neglects: what happens after `bounces` events (bounded in `Estimate.bias`), polarisation.
    Cost: 1e6 walks of 32 events in 20 bands take about 2 s on two cores.
    Differentiable in a, b, phase parameters, reflectances and the light's spectra, in forward and
    reverse mode, without bias; in geometry (depth, range, sun, index, pose) it raises ValueError.

    **Arguments:**

    - `paths`: walks per ray; for irradiance, in all.  Rounded up to whole groups: of 32, for
      irradiance as many as leave 64 groups of each source, up to 16384 walks a group.  Its walks
      share low-discrepancy points by group, so that errors fall faster than the root of `paths`.
    - `bounces`: events (scatterings and reflections) per walk.
    - `thin`: whether only one walk in eight, drawn by its importance, goes on after 6 events.
      Saves most of the time where light is absorbed; switch it off for white media.  Frozen walks
      are never thinned.
    - `proposal`: what the walks are drawn from; `None` makes it from the scene.
    - `generations`: how often light may change its wavelength, at most.  What further changes
      would add, `PlaneParallel.inelastic_left` bounds.  Above 1 a few walks of great weight carry
      the light of the later ones, and the `stderr` of a run that has met none is too small: repeat
      it with other keys, or draw more walks.
    - `similar`: after so many events the water counts as one that scatters evenly, and b (1 - g) as
      much (similarity theory; Frisvad et al. 2007, section 3), so that one event does the work of
      1/(1 - g).  For white media, one band at a time (`tests/acceptance/similarity.md`); `bias` is
      nan then.  Elastic light only.  Early: hundreds of events through a peak (g above 0.95) bring
      rare walks of great weight, and the `stderr` of a radiance that has met none is too small.
    - `progress`: a function of two whole numbers, called as every chunk of walks is done: its
      number, and how many there are.

    With one key and a frozen proposal the estimate is a smooth function of the water, which is
    what a fit needs: `transport.frozen(scene)`.
    """

    paths: int = eqx.field(static=True)
    bounces: int = eqx.field(static=True)
    thin: bool = eqx.field(static=True)
    proposal: Proposal | None
    generations: int = eqx.field(static=True)
    similar: int | None = eqx.field(static=True)
    progress: Progress | None = eqx.field(static=True)

    sees_things: ClassVar[bool] = True
    inelastic: ClassVar[bool] = True

    def __init__(
        self,
        paths: int = 2**14,
        bounces: int = 32,
        thin: bool = True,
        proposal: Proposal | None = None,
        generations: int = 1,
        similar: int | None = None,
        progress: Progress | None = None,
    ):
        """Raises ValueError for fewer than one path, bounce or generation, or similar below 1."""
        counts = {"paths": paths, "bounces": bounces, "generations": generations}
        for name, value in (counts if similar is None else counts | {"similar": similar}).items():
            if int(value) < 1:
                raise ValueError(f"{name} must be at least 1, not {value}.")
        self.paths = int(paths)
        self.bounces = int(bounces)
        self.thin = bool(thin)
        self.proposal = proposal
        self.generations = int(generations)
        self.similar = None if similar is None else int(similar)
        self.progress = progress

    def frozen(self, scene: Scene) -> "MonteCarlo":
        """This transport with the proposal of a scene: walks that stay where they are while the
        water around them changes.  It serves scenes with as many layers.  Its walks are not
        thinned: which of them live on would depend on the water, and jump with it."""
        return dataclasses.replace(self, proposal=propose(scene))

    def reuse(self, scene: Scene, rays: Rays, key: Key[Array, ""]) -> Float[Array, "ray wl"]:
        """Effective share of the walks: how many walks drawn for this scene itself would be worth
        one of the frozen ones.  A warning below 0.3: freeze again, at the present water.  Takes
        two estimates' time."""
        fresh = self.frozen(scene).radiance(scene, rays, key)
        frozen = self.radiance(scene, rays, key)
        safe = jnp.where(frozen.stderr > 0, frozen.stderr, 1.0)
        share = jnp.where(frozen.stderr > 0, (fresh.stderr / safe) ** 2, 1.0)
        if not isinstance(share, jax.core.Tracer) and float(jnp.min(share)) < 0.3:
            warnings.warn(
                f"a frozen walk is worth {float(jnp.min(share)):.2f} of one drawn for this water: "
                "freeze the transport again nearer to it.",
                stacklevel=2,
            )
        return share

    def radiance(self, scene: Scene, rays: Rays, key: Key[Array, ""] | None = None) -> Estimate:
        """See `oceaninv.radiance`; ValueError for an eye inside an object."""
        _check_outside(scene, rays)
        return _backward.radiance(
            scene, rays, _words(key), self.plan, self.proposal, self.generations
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
            scene, depths, _words(key), self.plan, self.proposal, self.generations
        )
        return Irradiance(*(jax.tree.map(lambda leaf, i=i: leaf[:, i], found) for i in range(3)))

    @property
    def plan(self) -> Plan:
        """The dials, as the walks need them."""
        thin = self.thin and self.proposal is None
        return Plan(self.paths, self.bounces, thin, self.similar, self.progress)


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
