"""Cheap bounds on the terms of a scene: which contribute less than a share of the tolerance."""

import dataclasses

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from oceaninv.fidelity import error_model as errors
from oceaninv.foundation.spectrum import Response, hat_overlap
from oceaninv.scene.light import Light
from oceaninv.scene.scene import Floor, Scene
from oceaninv.water.inelastic import Inelastic, sources
from oceaninv.water.iops import IOPs, Layers


@dataclasses.dataclass(frozen=True)
class Term:
    """A term of a scene.

    `kept`: whether it stays in the scene; `bound`: the largest relative contribution; `why`: a
    sentence.
    """

    kept: bool
    bound: float
    why: str


def reduced_scene(
    scene: Scene, share: float, quantity: str, depth: float | None
) -> tuple[Scene, list[errors.ObservedWater], dict[str, Term]]:
    """The scene without the terms that contribute less than `share`, its waters at the depths that
    are asked for, and a `Term` for each part of the scene."""
    terms: dict[str, Term] = {}
    water = scene.water
    if isinstance(water, Layers):
        water, terms["layers"] = _merged(scene, water, share)
        scene = _with(scene, water=water)
    found = errors.observed_waters(scene, quantity, depth)
    if scene.floor is not None:
        bound = max(_floor_bound(bands, at, scene, quantity) for bands, at in found)
        terms["floor"] = _judged("floor", bound, share)
    if scene.light.diffuse is not None:
        bound = max(float(np.max(bands.sky)) for bands, _ in found)
        terms["sky"] = _judged("sky", bound, share)
    if scene.surface is not None:
        terms["surface"] = Term(True, 0.5, "surface: reflects half of the light from below, kept")
    inelastic = None
    if scene.inelastic is not None:
        first = water if isinstance(water, IOPs) else water.iops[0]
        inelastic, processes = _inelastic(scene.inelastic, first, found, share)
        terms |= processes
    dropped = {name for name, term in terms.items() if not term.kept}
    if not dropped - {"layers"}:
        return scene, found, terms
    light = scene.light
    if "sky" in dropped:
        light = _with(light, diffuse=None, sky=None)
    floor = None if "floor" in dropped else scene.floor
    scene = _with(scene, light=light, floor=floor, inelastic=inelastic)
    return scene, errors.observed_waters(scene, quantity, depth, found), terms


def _with(module, **changes):
    """A module with some fields replaced.  The checks of its constructor, which take a quarter of
    the time of a plan, are left out."""
    made = object.__new__(type(module))
    for name, value in {**vars(module), **changes}.items():
        object.__setattr__(made, name, value)
    return made


def _judged(name: str, bound: float, share: float) -> Term:
    kept = bound > share
    verb = "kept" if kept else "dropped"
    return Term(kept, bound, f"at most {100 * bound:.2g} % of the light, {verb}")


def _floor_bound(bands: errors.Bands, depth, scene: Scene, quantity: str) -> float:
    """Light from the floor, and light missing because there is no water below it, over the light
    that is asked for.

    They change Ed by a second scattering and by reflection at the surface from below; a line of
    sight down to the floor sees them in addition to the water's own reflectance.
    """
    reach = errors.floor_reach(bands, scene, depth)
    bottom = float(errors.concrete(scene.floor.depth, "the floor")) if scene.floor else np.inf
    own = 0.3 * bands.bb / np.maximum(bands.a + bands.bb, 1e-300)
    missing = own * np.exp(-2.0 * bands.kd * np.maximum(bottom - depth, 0.0))
    if quantity == "irradiance":
        return float(np.max((reach + missing) * np.minimum(1.0, 0.5 + 3.0 * own)))
    return float(np.max((reach + missing) / np.maximum(own, 1e-300)))


def _merged(scene: Scene, layers: Layers, share: float) -> tuple[IOPs | Layers, Term]:
    """One water in place of layers, if the optical depth of the mixture differs from that of the
    layers by less than `share` at every depth."""
    parts = [errors.bands_of(scene, one) for one in layers.iops]
    edges = errors.concrete(layers.interfaces, "the layers")
    deepest = max(float(np.max(errors.LEVEL / bands.kd)) for bands in parts)
    if scene.floor is not None:
        deepest = min(deepest, float(errors.concrete(scene.floor.depth, "the floor")))
    thick = np.diff(np.concatenate([[0.0], np.minimum(edges, deepest), [deepest]]))
    c = np.stack([bands.a + bands.b for bands in parts])
    mean = thick @ c / thick.sum()
    gap = np.abs(np.cumsum(thick[:, None] * (c - mean[None, :]), axis=0))
    spread = np.max(np.abs(c - mean[None, :]) / mean[None, :])
    bound = float(max(np.max(gap), spread if np.max(gap) > 0 else 0.0))
    same = len({(w.absorbers, w.scatterers, len(w.phases)) for w in layers.iops}) == 1
    if bound > share or not same:
        return layers, Term(True, bound, f"optical depths differ by {bound:.2g}, kept")
    total = jnp.asarray(thick / thick.sum())

    def mixed(*rows):
        return sum(w.astype(r.dtype) * r for w, r in zip(total, rows, strict=True))

    first = layers.iops[0]
    water = IOPs(
        first.wavelength,
        mixed(*(w.a_components for w in layers.iops)),
        mixed(*(w.b_components for w in layers.iops)),
        first.phases,
        first.absorbers,
        first.scatterers,
    )
    return water, Term(False, bound, f"optical depths differ by {bound:.2g}, merged into one")


def _inelastic(inelastic: Inelastic, water: IOPs, found: list[errors.ObservedWater], share: float):
    """The processes that add more than `share` to the downward light of some band."""
    kept, terms = {}, {}
    for name in ("raman", "chlorophyll", "cdom"):
        process = getattr(inelastic, name)
        if process is None:
            continue
        (matrix, _), *_ = sources(Inelastic(**{name: process}), water)
        bound = max(_emitted(np.asarray(matrix, float), bands, at) for bands, at in found)
        terms[name] = _judged(name, bound, share)
        if terms[name].kept:
            kept[name] = process
    return (Inelastic(**kept) if kept else None), terms


def _emitted(matrix: np.ndarray, bands: errors.Bands, depth: np.ndarray) -> float:
    """Largest ratio, over bands at their depths, of emitted to other downward light.

    Scalar irradiance is taken as twice Ed, and all emitted light as travelling down.
    """
    worst = 0.0
    for i in range(len(bands.a)):
        z = np.linspace(0.0, depth[i], 40)
        excited = 2.0 * bands.light[:, None] * np.exp(-bands.kd[:, None] * z[None, :])
        source = matrix[:, i] @ excited * np.exp(-bands.kd[i] * (depth[i] - z))
        own = bands.light[i] * np.exp(-bands.kd[i] * depth[i])
        worst = max(worst, float(np.trapezoid(source, z) / max(own, 1e-300)))
    return worst


def reduced_bands(scene: Scene, share: float, response: Response, water: errors.ObservedWater):
    """The fewest evenly spaced bands that keep every channel within `share`.

    The error is computed for a guess of the spectrum seen.  Returns the scene, the indices of the
    remaining bands, the term and the (channel, wl) weights.
    """
    bands, at = water
    seen = bands.light * np.exp(-np.minimum(bands.kd * np.min(at), 50.0))
    seen = seen * bands.bb / np.maximum(bands.a + bands.bb, 1e-300)
    wavelength, count = scene.wavelength, len(scene.wavelength)
    weights = channel_weights(response, wavelength)
    full = weights @ seen
    # Inelastic light may come from bands that the camera does not see.
    for fewer in range(3, count if scene.inelastic is None else 0):
        pick = np.unique(np.linspace(0, count - 1, fewer).round().astype(int))
        fewer_weights = channel_weights(response, wavelength[pick])
        error = float(np.max(np.abs(fewer_weights @ seen[pick] / full - 1.0)))
        if error <= share:
            why = f"{len(pick)} of {count} change a channel by {100 * error:.2g} %"
            return scene_at_bands(scene, pick), pick, Term(False, error, why), fewer_weights
    return scene, np.arange(count), Term(True, 1.0, f"all {count} are needed"), weights


def channel_weights(response: Response, wavelength: np.ndarray) -> np.ndarray:
    """(channel, wl) as `response.weights`, but without compiling."""
    values = errors.concrete(response.values, "the camera's response")
    return values @ hat_overlap(response.samples, tuple(wavelength.tolist()))


def scene_at_bands(scene: Scene, pick: np.ndarray) -> Scene:
    """The scene with some of its bands; objects and lamps are left out."""

    def thin(spectra):
        if spectra is None:
            return None
        if isinstance(spectra, jax.core.Tracer):
            return spectra[..., pick]
        # numpy and device_put, unlike jnp, compile nothing for each count of bands.
        return jax.device_put(np.asarray(spectra)[..., pick])

    def water(one: IOPs) -> IOPs:
        rows = (thin(one.a_components), thin(one.b_components))
        return IOPs(one.wavelength[pick], *rows, one.phases, one.absorbers, one.scatterers)

    light = scene.light
    floor = scene.floor
    if floor is not None:
        floor = Floor(floor.depth, thin(floor.reflectance))
    waters = scene.water
    if isinstance(waters, IOPs):
        waters = water(waters)
    else:
        waters = Layers(waters.interfaces, tuple(map(water, waters.iops)))
    light = Light(light.zenith, thin(light.direct), thin(light.diffuse), light.sky)
    inelastic = scene.inelastic
    return Scene(waters, light, scene.surface, floor, inelastic=inelastic)
