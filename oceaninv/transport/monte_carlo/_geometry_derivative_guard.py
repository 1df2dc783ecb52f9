"""Errors for derivatives that a Monte Carlo estimate does not have: those in geometry."""

import dataclasses
import functools

import equinox as eqx
import jax
import numpy as np
from jax.custom_derivatives import SymbolicZero

from oceaninv.foundation.interface_optics import Rays
from oceaninv.scene.scene import Scene
from oceaninv.water.iops import Layers


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def fixed(name: str, value):
    """`value`; ValueError when a derivative is asked for."""
    return value


@functools.partial(fixed.defjvp, symbolic_zeros=True)
def _fixed_jvp(name, primals, tangents):
    if not isinstance(tangents[0], SymbolicZero):
        raise ValueError(
            f"MonteCarlo has no derivative with respect to {name}: its walks are drawn once and "
            "their geometry does not move, so the derivative would be a wrong 0. Differentiate in "
            "a, b, phase parameters, reflectances and the light's spectra only (eqx.partition "
            f"leaves {name} out), or use PlaneParallel, which is differentiable in it."
        )
    return primals[0], tangents[0]


def fixed_scene(scene: Scene) -> Scene:
    """The scene, whose geometry raises ValueError when differentiated."""

    def close(name, where):
        nonlocal scene
        scene = eqx.tree_at(where, scene, fixed(name, where(scene)))

    close("light.zenith", lambda s: s.light.zenith)
    if scene.surface is not None:
        close("surface.index", lambda s: s.surface.index)
    if scene.floor is not None:
        close("floor.depth", lambda s: s.floor.depth)
    if isinstance(scene.water, Layers):
        close("water.interfaces", lambda s: s.water.interfaces)
    for group in ("objects", "lamps"):
        for i, thing in enumerate(getattr(scene, group)):
            for field in dataclasses.fields(thing):
                if field.name not in ("reflectance", "intensity"):

                    def where(s, group=group, i=i, name=field.name):
                        return getattr(getattr(s, group)[i], name)

                    close(f"{group}[{i}].{field.name}", where)
    return scene


def fixed_rays(rays: Rays) -> Rays:
    """The rays, which raise ValueError when differentiated."""
    length = np.inf if rays.length is None else fixed("rays.length", rays.length)
    return Rays(fixed("rays.origin", rays.origin), fixed("rays.direction", rays.direction), length)
