"""The energy budget of the light, by kind of event."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt32

from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.foundation.spectrum import band_edges
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import Estimate
from oceaninv.transport.monte_carlo import _energy_tally, _weights
from oceaninv.transport.monte_carlo._energy_tally import Tracks
from oceaninv.transport.monte_carlo._event_loop import WalkSettings
from oceaninv.transport.monte_carlo._random_numbers import key_words
from oceaninv.transport.monte_carlo._random_walk import Proposal
from oceaninv.transport.monte_carlo.monte_carlo import MonteCarlo
from oceaninv.water.inelastic import AbstractInelastic, ChlorophyllFluorescence, Raman
from oceaninv.water.iops import IOPs


class EnergyBudget(eqx.Module):
    """Energy that takes part in every kind of event, as a share of all that enters the water.

    All are `Estimate`s of shape (wl,), at the wavelength of the light at the time of the event; the
    sum over wavelengths is the share of the whole spectrum.

    - `absorption`: by constituent, the energy that becomes heat (the loss on a change of wavelength
      included).
    - `elastic`: by constituent, the energy scattered; may exceed 1, as light scatters many times.
    - `inelastic`: by constituent, the energy absorbed and emitted at another wavelength.
    - `sinks`: energy absorbed by the `floor`, lost through the `surface`, emitted `beyond the
      grid`, and `untraced`: not yet absorbed after the last event, or emitted by the last order of
      inelastic scattering.
    - `entered`: the energy that enters, (wl,), of sum 1.
    - `remaining`: (interaction+1,) the energy left in the water after 0, 1, 2, ... interactions
      (elastic scatterings and reflections); inelastic light counts as lost.

    Absorption and sinks close to 1, summed over wavelengths.
    """

    absorption: dict[str, Estimate]
    elastic: dict[str, Estimate]
    inelastic: dict[str, Estimate]
    sinks: dict[str, Estimate]
    entered: Float[Array, " wl"]
    remaining: Estimate

    @property
    def events(self) -> dict[str, Float[Array, ""]]:
        """Share of each kind of event, such as "absorption: water", in the energy of all events
        with the water; the shares add up to 1.  Gutierrez et al. 2008, figure 5."""
        found = {
            f"{kind}: {name}": jnp.sum(estimate.value)
            for kind in ("absorption", "elastic", "inelastic")
            for name, estimate in getattr(self, kind).items()
        }
        total = sum(found.values(), jnp.zeros_like(self.entered[0]))
        return {name: value / total for name, value in found.items()}

    @property
    def closure(self) -> Float[Array, ""]:
        """Sum of what is absorbed and what is lost: 1."""
        parts = [*self.absorption.values(), *self.sinks.values()]
        return jnp.sum(jnp.stack([part.value for part in parts]))


def energy_budget(
    scene: Scene, transport: MonteCarlo | None = None, *, key: Key[Array, ""] | None = None
) -> EnergyBudget:
    """The energy budget of the light that enters the water of a scene.

    With the constituents of Gutierrez et al. 2008 (`gutierrez2008`) and `Inelastic` of all three
    processes these are the ten events of its table 3.  Constituents that share a phase function
    share a name, joined by "+".

    `transport`: `MonteCarlo(2**15, 64)` by default; its `inelastic_orders` applies; `key`: by
    default `key(0)`.  As the shares are known to add up to 1, the energy balance of each group of
    walks serves as a control variate, which reduces the standard errors.

    Raises ValueError for a scene with objects or lamps, whose light is not horizontally uniform,
    and for a sky that is not uniform.
    """
    transport = MonteCarlo(2**15, 64) if transport is None else transport
    if scene.objects or scene.lamps or scene.light.sky is not None:
        raise ValueError(
            "an energy budget is one number per constituent only in horizontally uniform water "
            "under a uniform sky: leave objects, lamps and light.sky out of the scene."
        )
    words = key_words(jax.random.key(0) if key is None else key)
    return _budget(scene, words, transport.plan, transport.proposal, transport.inelastic_orders)


def _owner(term: AbstractInelastic, water: IOPs) -> str:
    """The constituent whose absorption a process is part of."""
    names = ("cdom",)
    if isinstance(term, Raman):
        names = ("water", water.absorbers[0])
    elif isinstance(term, ChlorophyllFluorescence):
        names = ("chlorophyll", "phytoplankton")
    return next(name for name in names if name in water.absorbers)


class _Events(eqx.Module):
    """Energy by kind of event of groups of walks: (group, wl) each."""

    absorption: dict[str, Array]
    elastic: dict[str, Array]
    inelastic: dict[str, Array]
    sinks: dict[str, Array]
    emitted: Array


def _events(scene: Scene, tracks: Tracks) -> _Events:
    """The events of tracks; `emitted`: energy that appears in each band."""
    none = jnp.zeros_like(tracks.left)
    absorption, elastic, inelastic, emitted, beyond = {}, {}, {}, none, none

    def add(kinds, name, value):
        kinds[name] = kinds.get(name, none) + value

    terms = () if scene.inelastic is None else scene.inelastic.terms
    for i, water in enumerate(_weights.waters(scene)):
        light = tracks.light[:, i]
        for name, row in zip(water.absorbers, water.a_components, strict=True):
            add(absorption, name, light * row[None])
        for name, row in zip(water.scatterers, water.b_components, strict=True):
            add(elastic, name, light * row[None])
        for term in terms:
            shares = term.shares(water.wavelength)
            inside, outside = (jnp.asarray(v, light.dtype) for v in (shares.inside, shares.outside))
            excited = light * term.coefficient(water)[None]
            converted = excited * (jnp.sum(inside, axis=1) + outside)[None]
            add(inelastic, _owner(term, water), converted)
            add(absorption, _owner(term, water), -converted)
            emitted, beyond = emitted + excited @ inside, beyond + excited * outside[None]
    sinks = {"surface": tracks.escaped, "untraced": tracks.left}
    if scene.floor is not None:
        sinks["floor"] = tracks.floor * (1.0 - scene.floor.reflectance)[None]
    if terms:
        sinks["beyond the grid"] = beyond
    return _Events(absorption, elastic, inelastic, sinks, emitted)


def _spent(scene: Scene, tracks: Tracks) -> Array:
    """All energy that leaves each band, or is left in it at the end, (group, wl)."""
    found = tracks.escaped + tracks.left
    if scene.floor is not None:
        found += tracks.floor * (1.0 - scene.floor.reflectance)[None]
    for i, water in enumerate(_weights.waters(scene)):
        found += tracks.light[:, i] * water.a[None]
    return found


def _balanced(scene: Scene, tracks: Tracks) -> Tracks:
    """Tracks with the same expected values, less their regression on the balance, which is 0."""
    balance = _spent(scene, tracks) - tracks.entered
    centred = balance - jnp.mean(balance, axis=0, keepdims=True)
    spread = jnp.sum(centred**2, axis=0, keepdims=True)
    weight = jnp.where(spread > 0, centred / jnp.where(spread > 0, spread, 1.0), 0.0)

    def less(leaf):
        rest = (slice(None), *(None,) * (leaf.ndim - 2))
        slope = jnp.sum(weight[rest] * leaf, axis=0, keepdims=True)
        return leaf - balance[rest] * slope

    return jax.tree.map(less, tracks)


def _scaled(scene: Scene, tracks: Tracks, emitted: Array) -> Tracks:
    """Tracks scaled so that their energy by band is what the previous order `emitted`, (wl,)."""
    spent = _spent(scene, tracks)
    mean = jnp.mean(spent, axis=0, keepdims=True)
    some = jnp.where(mean > 0, mean, 1.0)
    scale = jnp.where(mean > 0, emitted[None] / some, 1.0)

    def times(leaf):
        rest = (slice(None), *(None,) * (leaf.ndim - 2))
        share = jnp.mean(leaf, axis=0, keepdims=True) / some[rest]
        # A group's deviation in total energy is not part of its error.
        return (leaf - share * (spent - mean)[rest]) * scale[rest]

    return jax.tree.map(times, tracks)


@eqx.filter_jit
def _budget(
    scene: Scene,
    words: UInt32[Array, " 2"],
    plan: WalkSettings,
    proposal: Proposal | None,
    inelastic_orders,
) -> EnergyBudget:
    dtype = scene.light.direct.dtype
    width = jnp.ones(1, dtype)
    if len(scene.wavelength) > 1:
        width = jnp.asarray(np.diff(band_edges(scene.wavelength)), dtype)
    parts, gone = _energy_tally.elastic(scene, words, plan, proposal, width)
    parts = [_balanced(scene, part) for part in parts]
    first = jax.tree.map(lambda *leaves: sum(leaves[1:], leaves[0]), *parts)
    entered = jnp.mean(first.entered, axis=0)
    whole = jnp.sum(entered)
    every = [_events(scene, first)]
    if scene.inelastic is not None:
        for tracks in _energy_tally.inelastic(
            scene, words, plan, proposal, width, inelastic_orders
        ):
            tracks = _scaled(scene, tracks, jnp.mean(every[-1].emitted, axis=0))
            every.append(_events(scene, tracks))
    total = jax.tree.map(lambda *leaves: sum(leaves[1:], leaves[0]), *every)
    total.sinks["untraced"] += every[-1].emitted

    def estimate(samples):
        count = samples.shape[0]
        spread = jnp.var(samples, axis=0) / max(count - 1, 1)
        stderr = safe_sqrt(spread) if count > 1 else jnp.full_like(spread, jnp.nan)
        mean = jnp.mean(samples, axis=0) / whole
        return Estimate(mean, stderr / whole, jnp.zeros_like(mean))

    def named(samples):
        return {name: estimate(value) for name, value in samples.items()}

    lost = jnp.pad(jnp.cumsum(gone, axis=1), ((0, 0), (1, 0)))
    lost = estimate(lost)
    remaining = Estimate(1.0 - lost.value, lost.stderr, lost.bias)
    return EnergyBudget(
        named(total.absorption),
        named(total.elastic),
        named(total.inelastic),
        named(total.sinks),
        entered / whole,
        remaining,
    )
