"""Irradiance of facets by where they look, against the integral of the radiance they see.

    python -m tests.acceptance.facet_irradiance        (writes facet_irradiance.md beside this file)

Truth: radiance of PlaneParallel(32 streams, 16 orders) times the cosine, summed over 6528
directions graded towards the sun, and the unscattered sun.  Beside each transport stands what went
before: an upright facet got a quarter of the diffuse scalar irradiance wherever it looked.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from oceaninv.transport.base import homogeneous
from oceaninv.transport.closed_form._two_moment_field import DeltaScaledWater
from oceaninv.transport.objects._surface_irradiance import facet_irradiance

jax.config.update("jax_enable_x64", True)

WAVELENGTH = [450.0, 550.0, 650.0]
WATERS = {
    "clear": ((0.2, 0.03, 0.01), (2.0, 5.0, 15.0)),
    "coastal": ((1.5, 0.15, 0.08), (2.0, 5.0, 15.0)),
    "turbid": ((5.0, 0.5, 0.4), (0.5, 2.0, 5.0)),
}
ZENITHS = (20.0, 40.0, 60.0)
_SLANT = np.sqrt(0.5)
FACES = {
    "up": (0, 0, -1),
    "down": (0, 0, 1),
    "towards": (1, 0, 0),
    "across": (0, 1, 0),
    "away": (-1, 0, 0),
    "up, towards": (_SLANT, 0, -_SLANT),
    "up, away": (-_SLANT, 0, -_SLANT),
    "down, towards": (_SLANT, 0, _SLANT),
    "down, away": (-_SLANT, 0, _SLANT),
}
NORMALS = np.array(list(FACES.values()), float)
MODELS = {"two-stream": oi.TwoStream(), "four-stream": oi.FourStream(),
          "16 streams": oi.PlaneParallel()}  # fmt: skip


def scene(water: str, zenith: float) -> oi.Scene:
    iops = oi.BioOpticalModel().iops(oi.Constituents(*WATERS[water][0]), np.array(WAVELENGTH))
    return oi.Scene(iops, oi.Light(zenith, jnp.ones(3)), oi.FlatSurface())


def directions(sun: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions around the sun, and their solid angles."""
    edges = np.radians([0, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 8, 16, 30, 45, 60, 75, 90, 105, 120,
                        150, 180])  # fmt: skip
    x, w = np.polynomial.legendre.leggauss(6)
    half = np.diff(edges)[:, None] / 2
    turn = ((edges[:-1] + edges[1:])[:, None] / 2 + half * x).ravel()
    weight = (half * w).ravel() * np.sin(turn)
    azimuth = (np.arange(64) + 0.5) * 2 * np.pi / 64
    tilted, aside = np.array([-sun[2], 0.0, sun[0]]), np.array([0.0, 1.0, 0.0])
    around = np.cos(azimuth)[:, None] * tilted + np.sin(azimuth)[:, None] * aside
    found = np.cos(turn)[:, None, None] * sun + np.sin(turn)[:, None, None] * around
    return found.reshape(-1, 3), np.repeat(weight * 2 * np.pi / 64, 64)


@eqx.filter_jit
def seen(scene, depth, towards):
    origin = jnp.zeros_like(towards).at[:, 2].set(depth)
    return oi.PlaneParallel(32, 16, knots=64).radiance(scene, oi.Rays(origin, towards)).value


@eqx.filter_jit
def now(scene, transport, depth):
    normals = jnp.asarray(NORMALS)
    return facet_irradiance(scene, transport, jnp.full(len(FACES), depth), normals)


@eqx.filter_jit
def light(scene, transport, depth):
    found = transport.irradiance(scene, depth[None], None)
    return found.Ed.value[0], found.Eu.value[0], found.E0.value[0]


def before(scene, transport, depth) -> np.ndarray:
    """The scaled sunbeam and a parabola in the facet's tilt through Ed, E0/4 and Eu."""
    mu0, beam = scene.beam()
    c_star = DeltaScaledWater(homogeneous(scene)).attenuation.c_star
    sun = np.asarray(beam * jnp.exp(-c_star * depth / mu0))
    down, up, scalar = (np.asarray(v) for v in light(scene, transport, depth))
    down, side = down - float(mu0) * sun, (scalar - sun) / 4
    level = -NORMALS[:, 2:]
    total = side + level * (down - up) / 2 + level**2 * ((down + up) / 2 - side)
    to_sun = np.array([np.sqrt(1 - float(mu0) ** 2), 0, -float(mu0)])
    return total + np.maximum(NORMALS @ to_sun, 0)[:, None] * sun


def run() -> str:
    """The table."""
    errors = {(name, when): [] for name in MODELS for when in ("now", "before")}
    for water, (_, depths) in WATERS.items():
        for zenith in ZENITHS:
            here = scene(water, zenith)
            mu0, beam = (np.asarray(v) for v in here.beam())
            sun = np.array([np.sqrt(1 - mu0**2), 0, -mu0])
            towards, solid = directions(sun)
            cosines = np.maximum(NORMALS @ towards.T, 0) * solid
            for depth in map(jnp.asarray, depths):
                straight = beam * np.exp(-np.asarray(homogeneous(here).c) * float(depth) / mu0)
                truth = cosines @ np.asarray(seen(here, depth, jnp.asarray(towards)))
                truth = truth + np.maximum(NORMALS @ sun, 0)[:, None] * straight
                for name, model in MODELS.items():
                    for when, value in (("now", now), ("before", before)):
                        found = np.asarray(value(here, model, depth))
                        errors[name, when].append(100 * (found / truth - 1))
            print(water, zenith, flush=True)
    lines = [
        "# Irradiance of facets by where they look",
        "",
        "`python -m tests.acceptance.facet_irradiance`: errors in % against the integral of the",
        "radiance of 32 streams over the facet's hemisphere; clear, coastal and turbid water, suns",
        "at 20, 40 and 60 degrees, 450, 550 and 650 nm, depths of 2, 5 and 15 m (turbid: 0.5,",
        "2, 5).  The largest of the two upper depths, in brackets of all three.  Before: upright",
        "facets got a quarter of the diffuse scalar irradiance.  Tilted faces look 45 degrees",
        "up or down.",
        "",
        "| transport | " + " | ".join(FACES) + " | median of all |",
        "|---" * (len(FACES) + 2) + "|",
    ]
    for (name, when), found in errors.items():
        table = np.abs(np.reshape(found, (len(WATERS) * len(ZENITHS), 3, len(FACES), -1)))
        upper, every = table[:, :2].max(axis=(0, 1, 3)), table.max(axis=(0, 1, 3))
        cells = [f"{a:.1f} ({b:.1f})" for a, b in zip(upper, every, strict=True)]
        lines.append(f"| {name}, {when} | " + " | ".join(cells) + f" | {np.median(table):.2f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(run())
