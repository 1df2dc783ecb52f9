"""The models that `oceaninv trade` runs on a scene."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from oceaninv.fidelity.scene_terms import scene_at_bands
from oceaninv.foundation.interface_optics import Rays
from oceaninv.scene.scene import Scene
from oceaninv.transport.base import AbstractTransport
from oceaninv.transport.closed_form.four_stream import FourStream
from oceaninv.transport.closed_form.kd import KdTransport, monzon2024
from oceaninv.transport.closed_form.two_stream import TwoStream
from oceaninv.transport.front import irradiance, radiance
from oceaninv.transport.monte_carlo.monte_carlo import MonteCarlo
from oceaninv.transport.plane_parallel.plane_parallel import PlaneParallel
from oceaninv.water.attenuation import kd_lee2005
from oceaninv.water.iops import IOPs

# A function of (scene, origin, direction, depths) that gives (ray or depth, wl).
Answer = Callable[[Scene, jax.Array, jax.Array, jax.Array], jax.Array]


class CandidateModel(NamedTuple):
    """A model to be measured; `pick`: the bands of the scene that it computes, default all."""

    name: str
    answer: Answer
    precision: str = "float64"
    pick: tuple[int, ...] | None = None


def answer_of_transport(transport: AbstractTransport, quantity: str) -> Answer:
    """The function that computes a quantity by a transport."""

    def answer(scene, origin, direction, depths):
        key = jax.random.key(0)
        if quantity == "irradiance":
            return irradiance(scene, depths, transport, key=key).Ed.value
        return radiance(scene, Rays(origin, direction), transport, key=key).value

    return answer


def references(scene: Scene, quantity: str) -> tuple[CandidateModel, CandidateModel]:
    """A converged model, and a coarser one whose difference from it estimates its error."""
    inelastic_orders = 1 if scene.inelastic is None else 3
    orders = 1 if quantity == "irradiance" else None
    made = (PlaneParallel(n, orders, inelastic_orders) for n in (28, 22))
    first, second = (CandidateModel(_name(t), answer_of_transport(t, quantity)) for t in made)
    return first, second


def candidate_models(scene: Scene, quantity: str) -> list[CandidateModel]:
    """All models to be measured, from the Kd closure as printed to random walks."""
    flux = quantity == "irradiance"
    closed = [KdTransport(), TwoStream(), FourStream()]
    settings = ((4, 1), (8, 1), (16, 1)) if flux else ((4, 4), (8, 6), (16, 8), (16, 16))
    exact = [PlaneParallel(streams, orders) for streams, orders in settings]
    if scene.inelastic is not None:
        exact.insert(2, PlaneParallel(8, 1 if flux else 6, inelastic_orders=2))
    models = [CandidateModel(_name(t), answer_of_transport(t, quantity)) for t in (*closed, *exact)]
    if not flux:
        models.insert(0, CandidateModel("printed closure", _printed_kd_closure))
    single = (TwoStream(), FourStream(), exact[1])
    models += [
        CandidateModel(f"{_name(t)}, float32", answer_of_transport(t, quantity), "float32")
        for t in single
    ]
    walks = ((2**12, 32), (2**16, 32)) if flux else ((2**6, 4), (2**6, 32), (2**10, 32))
    models += [
        CandidateModel(_name(t), answer_of_transport(t, quantity))
        for t in (MonteCarlo(paths, bounces) for paths, bounces in walks)
    ]
    if not flux and scene.inelastic is None:
        models += _few_bands(scene, quantity)
    if not isinstance(scene.water, IOPs):
        models += _one_layer(scene, quantity)
    if scene.inelastic is not None:
        models += _elastic(quantity)
    return models


def _few_bands(scene: Scene, quantity: str) -> list[CandidateModel]:
    count = len(scene.wavelength)
    models = []
    for fewer, transport in ((3, TwoStream()), (6, TwoStream()), (6, PlaneParallel(8, 6))):
        if fewer < count:
            pick = np.unique(np.linspace(0, count - 1, fewer).round().astype(int))
            name = f"{_name(transport)}, {len(pick)} bands"
            models.append(
                CandidateModel(
                    name,
                    _at_bands(answer_of_transport(transport, quantity), pick),
                    pick=tuple(pick),
                )
            )
    return models


def _at_bands(answer: Answer, pick: np.ndarray) -> Answer:
    return lambda scene, *points: answer(scene_at_bands(scene, pick), *points)


def _one_layer(scene: Scene, quantity: str) -> list[CandidateModel]:
    """Models that put the uppermost layer in place of all layers."""

    def top(answer):
        def first(scene, *points):
            return answer(dataclasses.replace(scene, water=scene.water.iops[0]), *points)

        return first

    return [
        CandidateModel(f"{_name(t)}, upper layer alone", top(answer_of_transport(t, quantity)))
        for t in _three(quantity)
    ]


def _elastic(quantity: str) -> list[CandidateModel]:
    def bare(answer):
        def without(scene, *points):
            return answer(dataclasses.replace(scene, inelastic=None), *points)

        return without

    return [
        CandidateModel(f"{_name(t)}, elastic", bare(answer_of_transport(t, quantity)))
        for t in _three(quantity)
    ]


def _three(quantity: str) -> tuple[AbstractTransport, ...]:
    """One transport of each kind."""
    exact = PlaneParallel(8, 1 if quantity == "irradiance" else 6)
    return TwoStream(), FourStream(), exact


def _name(transport: AbstractTransport) -> str:
    if isinstance(transport, PlaneParallel):
        inelastic = transport.inelastic_orders
        more = f", inelastic_orders={inelastic}" if inelastic > 1 else ""
        return f"PlaneParallel({transport.streams}, {transport.orders}{more})"
    if isinstance(transport, MonteCarlo):
        return f"MonteCarlo({transport.paths}, {transport.bounces})"
    return type(transport).__name__


def _printed_kd_closure(scene: Scene, origin, direction, depths):
    """Radiance by the Kd closure of Monzon et al. 2024 as printed, without a separate term for
    single scattering."""
    del depths
    water = scene.water
    if not isinstance(water, IOPs):
        raise ValueError("the printed closure solves one homogeneous water, not layers.")
    mu0, beam = scene.beam()
    kd = kd_lee2005(water.a, water.bb, scene.light.zenith)
    surface = mu0 * beam
    if scene.light.diffuse is not None:
        surface = surface + jnp.pi * scene.light.diffuse
    z, down = origin[:, 2], direction[:, 2]
    steep = jnp.where(jnp.abs(down) < 1e-3, 1e-3, down)
    bottom = jnp.asarray(1e3, z.dtype) if scene.floor is None else scene.floor.depth
    rho = jnp.zeros_like(kd) if scene.floor is None else scene.floor.reflectance
    length = jnp.where(steep > 0, (bottom - z) / steep, -z / steep)
    seen = monzon2024(water.b, water.c, kd, surface, z, down, length, rho, bottom)
    lit = (rho / jnp.pi * surface * jnp.exp(-kd * bottom))[None, :]
    through_water = jnp.exp(-water.c[None, :] * length[:, None])
    return seen + jnp.where((steep > 0)[:, None], lit * through_water, 0.0)
