"""Orders of inelastic scattering: the light of each order excites the emission of the next."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv.foundation.quadrature import Basis
from oceaninv.scene.scene import Scene
from oceaninv.transport.plane_parallel import _column, _inelastic_source
from oceaninv.water import inelastic
from oceaninv.water.iops import IOPs
from oceaninv.water.phase import moments_of


def layers_of(scene: Scene) -> tuple[IOPs, ...]:
    """The waters of a scene, top first."""
    return (scene.water,) if isinstance(scene.water, IOPs) else scene.water.iops


def azimuth_orders(scene: Scene, orders: int) -> int:
    """How many azimuth orders the emission has: one if all of it is isotropic."""
    assert scene.inelastic is not None
    return min(orders, 1 if scene.inelastic.raman is None else _inelastic_source.DEGREES)


def emission(
    scene: Scene,
    columns: _column.Column,
    bases: Basis,
    sources: _column.Sources,
    inelastic_orders: int,
) -> _inelastic_source.Column:
    """Emitted light, axes (order, wl) as those of `columns`, which hold the light that excites.

    Light that has not changed its wavelength excites the first order; each order excites the next.
    """
    every = [column for column, _ in _each(scene, columns, bases, sources, inelastic_orders)]
    total = jax.tree.map(lambda *parts: sum(parts[1:], parts[0]), *every)
    # Amplitudes add up; the decay rates of the exponentials are the same for every order.
    down, up = (
        beam._replace(nu=own.nu)
        for beam, own in zip(total.glow[:2], every[0].glow[:2], strict=True)
    )
    return total._replace(glow=total.glow._replace(down=down, up=up))


def left(
    scene: Scene,
    columns: _column.Column,
    bases: Basis,
    sources: _column.Sources,
    inelastic_orders: int,
) -> Float[Array, ""]:
    """Bound on all further inelastic orders, relative to the last one.

    If no source of an order exceeds q times that of the order before, at any depth and wavelength,
    neither does its light: the sum of further orders is less than q/(1 - q) of the last.
    """
    every = list(_each(scene, columns, bases, sources, inelastic_orders + 1))
    last, following = every[-2][1][0, ..., 0], every[-1][1][0, ..., 0]
    exist = following > 0
    q = jnp.max(jnp.where(exist, following / jnp.where(exist, last, 1.0), 0.0))
    return jnp.where(q < 1, q / (1 - q), jnp.nan)


def _each(scene, columns, bases, sources, inelastic_orders):
    """(Column, source) of each inelastic order; source: (azimuth, wl, layer, depth, degree)."""
    assert scene.inelastic is not None
    waters = layers_of(scene)
    dtype = columns.layer.depth.dtype
    matrices = [inelastic.sources(scene.inelastic, water) for water in waters]
    if not matrices[0]:
        raise ValueError("Inelastic() holds no process: give it one, or leave it out of the scene.")
    matrix = jnp.stack([jnp.stack([m for m, _ in terms]) for terms in matrices], axis=1)
    chi = jnp.stack(
        [moments_of(p, _inelastic_source.DEGREES - 1).astype(dtype) for _, p in matrices[0]]
    )
    count = azimuth_orders(scene, bases.mu.shape[0])
    columns, bases = jax.tree.map(lambda leaf: leaf[:count], (columns, bases))
    grids = _grids(scene, waters, columns)
    below = grids.below

    def over_all(function, *axes):
        """Mapped over layers, wavelengths and orders; axes: (order, wl, layer) of each input."""
        for level in (2, 1, 0):
            function = jax.vmap(function, tuple(axis[level] for axis in axes))
        return function

    every, basis, layered = (0, 0, 0), (0, None, None), (None, None, 0)
    excite = over_all(_inelastic_source.excitation, every, basis, (None, 0, None), basis, layered)
    exciting = excite(columns, bases, sources.sun, sources.angular[:count], below)
    solved = None
    for _ in range(inelastic_orders):
        if solved is not None:
            again = over_all(_inelastic_source.emitted, *(every,) * 4, basis, layered)
            parts = (columns.layer, columns.modes, solved.glow, solved.field)
            exciting = again(*parts, bases, below)
        source = jnp.einsum("tl,tyij,miydl->mjydl", chi, matrix.astype(dtype), exciting)
        fit = over_all(_inelastic_source.glow, every, every, basis, layered, every)
        glows = fit(columns.layer, columns.modes, bases, grids, source)
        solve = jax.vmap(_inelastic_source.solve, (0, 0, 0, None, _floor_axes(sources)))
        solve = jax.vmap(solve, (0, 0, 0, 0, None))
        solved = solve(columns.layer, columns.modes, glows, bases, sources)
        yield solved, source


def _floor_axes(sources: _column.Sources) -> _column.Sources:
    """Axes of wavelength of the sources that emitted light meets: only the floor has one."""
    axes = _column.Sources._make((None,) * len(sources))
    return axes if sources.floor is None else axes._replace(floor=0)


def _grids(
    scene: Scene, waters: tuple[IOPs, ...], columns: _column.Column
) -> _inelastic_source.Grid:
    """Depths and rates for each layer.  Light decays at least as fast as absorption demands."""
    a = jnp.stack([water.a for water in waters])
    c = jnp.stack([water.c for water in waters])
    slowest = jnp.maximum(jnp.min(a), 1e-3 * jnp.max(c))
    thickness = 1 / columns.rate[0, 0]
    grids = [
        _inelastic_source.grid(
            slowest, None if scene.floor is None and i == len(waters) - 1 else thickness[i]
        )
        for i in range(len(waters))
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *grids)
