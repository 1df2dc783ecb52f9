"""Random scenes for `plan`, and what every candidate transport says of them.

Waters of the default bio-optical model, log-uniform over chlorophyll 0.01-30 mg/m3, CDOM 0.001-5 /m
and detritus 0.001-5 /m; sun 0-75 degrees in air, half the time with a sky that sends up to half of
the light; flat surface; depth log-uniform over 0.5-40 m, half the time with a floor there (its
reflectance 0.02-0.5; elsewhere a black one at 1 km, which nothing sees: one program serves both).
Eight bands of 400-700 nm; radiance, which costs
most, of every second one, the odd or the even ones by turns.
Irradiance: ten depths down to 1 % of the light or the floor, bands apart.
Radiance and photograph: an eye at a random share of the depth, but where some band still has 1 %
of its light; radiance in 20 directions, a lattice turned at random, of the bands that have 1 %
there; a photograph of 12 pixels about a horizontal axis.
"""

import functools
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from oceaninv.fidelity import planning

WAVELENGTH = np.linspace(400.0, 700.0, 8)
REFERENCES = {"irradiance": oi.PlaneParallel(64, 1), "radiance": oi.PlaneParallel(64, 40)}
DIRECTIONS, CHUNK = 20, 10
# What plan() may choose for water alone; photographs are made of radiance.
RUNS = {quantity: planning.CANDIDATES[quantity] for quantity in ("irradiance", "radiance")}


class Draw(eqx.Module):
    """Parameters of random scenes, each with a leading axis."""

    chlorophyll: jax.Array
    cdom: jax.Array
    detritus: jax.Array
    zenith: jax.Array
    sky: jax.Array  # share of Ed(0-)
    depth: jax.Array
    bottom: jax.Array
    reflectance: jax.Array
    share: jax.Array  # of the depth, where the eye is
    views: jax.Array  # (direction + pixel, 3)
    first: jax.Array  # of the bands of radiance: 0 or 1


def draws_of(sets) -> Draw:
    """Scenes of several seeds, one after the other: (count, seed) of each."""
    parts = [draw(count, seed) for count, seed in sets]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def draw(count: int, seed: int) -> Draw:
    """`count` scenes."""
    rng = np.random.default_rng(seed)

    def between(low, high):
        return np.exp(rng.uniform(np.log(low), np.log(high), count))

    water = between(0.01, 30.0), between(0.001, 5.0), between(0.001, 5.0)
    zenith = rng.uniform(0.0, 75.0, count)
    sky = np.where(rng.random(count) < 0.5, 0.0, rng.uniform(0.0, 0.5, count))
    depth, reflectance = between(0.5, 40.0), rng.uniform(0.02, 0.5, count)
    floor = rng.random(count) < 0.5
    bottom = np.where(floor, depth, 1e3)
    reflectance = np.where(floor, reflectance, 0.0)
    share = rng.uniform(0.05, 0.95, count)
    views = np.stack([_views(rng, z) for z in zenith])
    rows = (*water, zenith, sky, depth, bottom, reflectance, share, views, np.arange(count) % 2)
    return Draw(*(jnp.asarray(v) for v in rows))


def _views(rng, zenith: float) -> np.ndarray:
    """Directions beyond 20 degrees of the refracted sun and off the horizon, then a camera's."""
    sine = np.sin(np.radians(zenith)) / 1.34
    sun = np.array([sine, 0.0, -np.sqrt(1 - sine**2)])
    # Spread evenly over one side of the sun's plane: the percentile does not depend on the draw.
    count, found = DIRECTIONS + 2, np.zeros((0, 3))
    while len(found) != DIRECTIONS:
        index, (shift, turn) = np.arange(count), rng.random(2)
        down = 1.0 - 2.0 * (index + shift) / count
        azimuth = np.pi * np.mod(0.618034 * index + turn, 1.0)
        across = np.sqrt(1.0 - down**2)
        found = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), down], axis=1)
        found = found[(found @ sun < np.cos(np.radians(20.0))) & (np.abs(down) > 0.05)]
        count += np.sign(DIRECTIONS - len(found))
    heading = rng.uniform(0, 2 * np.pi)
    across, up = np.meshgrid(np.linspace(-0.36, 0.36, 4), np.linspace(-0.24, 0.24, 3))
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    right = np.array([-np.sin(heading), np.cos(heading), 0.0])
    pixels = forward + across.reshape(-1, 1) * right + up.reshape(-1, 1) * np.array([0, 0, -1.0])
    return np.concatenate([found, pixels / np.linalg.norm(pixels, axis=1, keepdims=True)])


def scene(p: Draw, quantity: str, wavelength: np.ndarray = WAVELENGTH) -> oi.Scene:
    """One scene; `sky` of the light below the surface is diffuse.

    Bands of radiance are called by the same wavelengths in every scene: one program serves all.
    """
    water = oi.BioOpticalModel().iops(
        oi.Constituents(p.chlorophyll, cdom=p.cdom, detritus=p.detritus), wavelength
    )
    if quantity != "irradiance":
        pick = p.first + 2 * jnp.arange(len(wavelength) // 2)
        rows = (water.a_components[:, pick], water.b_components[:, pick])
        water = oi.IOPs(wavelength[::2], *rows, water.phases)
    one = jnp.ones(len(water.wavelength))
    bare = oi.Scene(water, oi.Light(p.zenith, one), oi.FlatSurface())
    cosine, beam = bare.beam()
    diffuse = p.sky / (1.0 - p.sky) * cosine * beam / (np.pi * (1 - 0.0675))
    ground = oi.Floor(p.bottom, p.reflectance * one)
    return oi.Scene(water, oi.Light(p.zenith, one, diffuse), oi.FlatSurface(), ground)


def levels(this: oi.Scene, p: Draw):
    """Depths (10, wl) to the 1 % level or the floor, depth of the eye, and which bands are lit."""
    water = this.water
    assert isinstance(water, oi.IOPs)
    cosine, _ = this.beam()
    sky = jnp.broadcast_to(p.sky, water.a.shape)
    deep = jnp.minimum(4.6 / water.a, 1e4)
    for _ in range(6):  # the depth whose mean Kd takes 99 %
        kd = jnp.diagonal(oi.attenuation.kd_mean(water.a, water.b, water.bb, cosine, deep, sky))
        deep = 4.6 / kd
    end = jnp.minimum(deep, p.bottom)
    eye = p.share * jnp.minimum(p.depth, jnp.max(deep))
    return jnp.linspace(0.1, 1.0, 10)[:, None] * end[None, :], eye, eye <= deep


@functools.partial(eqx.filter_jit)
def _answers(chunk: Draw, transport, quantity: str, together: bool = False):
    """`together`: irradiance of all bands at the depths of one, as people ask for it."""

    def one(p):
        this = scene(p, quantity)
        depths, eye, lit = levels(this, p)
        if together:
            return oi.irradiance(this, depths.max(axis=1), transport).Ed.value
        if quantity == "irradiance":
            # Every band at its own depths: the solution is shared.
            every = jax.vmap(
                lambda z: oi.irradiance(this, z, transport).Ed.value, in_axes=1, out_axes=2
            )
            field = every(depths)
            return jnp.stack([field[:, i, i] for i in range(field.shape[1])], axis=1), lit
        origin = jnp.zeros_like(p.views).at[:, 2].set(eye)
        return oi.radiance(this, oi.Rays(origin, p.views), transport).value, lit

    return jax.lax.map(one, chunk)


def answers(draws: Draw, transport, quantity: str):
    """(scene, row, wl) values, (scene, wl) lit and processor seconds per scene of a transport."""
    count, flux = draws.depth.shape[0], quantity == "irradiance"
    out, seconds = [], []
    for first in range(0, count, CHUNK):
        index = jnp.arange(first, first + CHUNK) % count
        chunk = jax.tree.map(lambda v, i=index: v[i], draws)
        if flux:
            out.append(jax.tree.map(np.asarray, _answers(chunk, transport, quantity)))
        start = time.process_time()
        found = jax.tree.map(np.asarray, _answers(chunk, transport, quantity, flux))
        seconds.append((time.process_time() - start) / CHUNK)
        if not flux:
            out.append(found)
    values, lit = (np.concatenate(part)[:count] for part in zip(*out, strict=True))
    return values, lit, float(np.min(seconds[1:] or seconds))  # others may share the machine


@functools.cache
def channels(first: int) -> np.ndarray:
    """(channel, wl) weights of the photograph."""
    return np.asarray(oi.spectrum.generic_camera().weights(WAVELENGTH[first::2]))


def errors(value, truth, lit, quantity: str) -> np.ndarray:
    """(scene,) error of a transport in the sense of the quantity."""
    relative = np.abs(value / truth - 1.0)
    if quantity == "irradiance":
        return relative.max(axis=(1, 2))
    if quantity == "radiance":
        part = np.where(lit[:, None, :], relative, np.nan)[:, :DIRECTIONS]
        return np.nanquantile(part.reshape(len(part), -1), 0.95, axis=1)
    weights = np.stack([channels(i % 2).T for i in range(len(value))])
    seen, true = (v[:, DIRECTIONS:] @ weights for v in (value, truth))
    return (np.sqrt(np.mean((seen - true) ** 2, axis=1)) / true.mean(axis=1)).max(axis=1)
