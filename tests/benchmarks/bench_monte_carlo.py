"""Efficiency of MonteCarlo against Mitsuba 3, and what its dials cost.

    python -m tests.benchmarks.bench_monte_carlo [variants of Mitsuba | none]

One scene: a camera that looks straight down into 10 m of water over a Lambertian floor, zenith sun,
20 bands.  Figure of merit: CPU microseconds times relative variance, per band (less is better); CPU
time of all threads, so that a busy machine does not count.  The LLVM variants of Mitsuba need LLVM
16 or later and DRJIT_LIBLLVM_PATH.
A run is written down in monte_carlo.md.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from oceaninv.water.phase import HenyeyGreenstein

WAVELENGTH = np.linspace(400.0, 690.0, 20)
DEPTH, FLOOR, G = 10.0, 0.3, 0.8
ABSORPTION = (
    0.02
    + 0.25 * np.clip((WAVELENGTH - 560) / 130, 0, 1) ** 2
    + 0.045 * np.exp(-0.014 * (WAVELENGTH - 440))
)
SCATTERING = 0.178 * 500.0 / WAVELENGTH


def radiance(scales, key, transport):
    """(20,) estimate in float32; `scales` of a, b and g."""
    one = jnp.ones(20, jnp.float32)
    a, b = (jnp.asarray(v, jnp.float32) for v in (ABSORPTION, SCATTERING))
    phase = HenyeyGreenstein(jnp.asarray(G, jnp.float32) * scales[2])
    water = oi.IOPs(WAVELENGTH, a * scales[0], b * scales[1], phase)
    light = oi.Light(jnp.zeros((), jnp.float32), one)
    scene = oi.Scene(water, light, floor=oi.Floor(DEPTH, FLOOR * one))
    down = oi.Rays(jnp.zeros(3, jnp.float32), jnp.asarray([[0, 0, 1]], jnp.float32))
    found = oi.radiance(scene, down, transport, key=key)
    return jax.tree.map(lambda leaf: leaf[0], found)


def cpu(function, repeats: int = 5) -> float:
    """Least CPU seconds of a call, after one that compiles."""
    jax.block_until_ready(function(0))
    times = []
    for i in range(repeats):
        start = time.process_time()
        jax.block_until_ready(function(i))
        times.append(time.process_time() - start)
    return min(times)


def dials(paths: int = 2**17) -> float:
    """A row per number of bounces, thinned and not; the best merit with a truncation below 0.2
    standard errors."""
    ones, merits = jnp.ones(3, jnp.float32), []
    for bounces, thin in ((16, True), (32, True), (64, True), (32, False)):
        transport = oi.MonteCarlo(paths, bounces, thin)
        value = jax.jit(lambda p, k, t=transport: radiance(p, k, t))
        seconds = cpu(lambda i, v=value: v(ones, jax.random.key(i)))
        found = value(ones, jax.random.key(0))
        variance = np.asarray((found.stderr / found.value) ** 2)
        merit = seconds * 1e6 * variance.mean() / len(WAVELENGTH)
        bias = float(jnp.max(found.bias / found.stderr))
        print(
            f"MonteCarlo {bounces:3d} bounces, {'thinned' if thin else 'all    '}: "
            f"{seconds / paths * 1e6:6.2f} us/path, relvar {variance.mean() * paths:6.2f}, "
            f"merit {merit:7.3f} us, truncation {bias:.1e} stderr",
            flush=True,
        )
        if bias < 0.2:
            merits.append(merit)
    transport = oi.MonteCarlo(paths, 32)
    value = jax.jit(lambda p, k: radiance(p, k, transport).value)
    seconds = cpu(lambda i: value(ones, jax.random.key(i)))
    slopes = jax.jit(lambda p, k: jax.jacfwd(lambda q: radiance(q, k, transport).value)(p))
    print(f"Jacobian in a, b, g: {cpu(lambda i: slopes(ones, jax.random.key(i))) / seconds:.2f} x")
    return min(merits)


def mitsuba(variant: str, paths: int, repeats: int = 16) -> float:
    """Merit of Mitsuba's volumetric path tracer on the same scene; of a `mono` variant, in the
    band at 507 nm alone."""
    import mitsuba as mi

    mi.set_variant(variant)
    transform = mi.ScalarTransform4f

    mono = variant.endswith("mono")

    def spectrum(values):
        if mono:
            return {"type": "spectrum", "value": float(values[7])}
        nodes = ", ".join(f"{w:.3f}" for w in [300.0, *WAVELENGTH, 800.0])
        values = ", ".join(f"{v:.8f}" for v in [values[0], *values, values[-1]])
        return {"type": "irregular", "wavelengths": nodes, "values": values}

    half = 0.5 * (WAVELENGTH[1] - WAVELENGTH[0])
    film = {"type": "specfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    if mono:
        film["type"] = "hdrfilm"
    for i, w in enumerate([] if mono else WAVELENGTH):
        ends = f"{w - half:.3f}, {w + half:.3f}"
        film[f"band{i:02d}"] = {"type": "irregular", "wavelengths": ends, "values": "1, 1"}
    extinction = ABSORPTION + SCATTERING
    water = {
        "type": "homogeneous",
        "sigma_t": spectrum(extinction),
        "albedo": spectrum(SCATTERING / extinction),
        "phase": {"type": "hg", "g": G},
    }
    slab = transform().translate([0, 0, -DEPTH / 2]).scale([1e4, 1e4, DEPTH / 2])
    bottom = transform().translate([0, 0, -DEPTH + 1e-3]).scale([5e3, 5e3, 1])
    white = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": FLOOR}}
    sensor = {"type": "radiancemeter", "origin": [0, 0, 1], "direction": [0, 0, -1]}
    sun = {"type": "directional", "direction": [0, 0, -1]}
    null = {"type": "null"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 64, "rr_depth": 5},
            "sensor": sensor | {"film": film, "sampler": {"type": "independent"}},
            "sun": sun | {"irradiance": {"type": "spectrum", "value": 1.0}},
            "water": {"type": "cube", "to_world": slab, "bsdf": null, "interior": water},
            "floor": {"type": "rectangle", "to_world": bottom, "bsdf": white},
        }
    )
    mi.render(scene, spp=paths, seed=repeats)
    start = time.process_time()
    values = np.array(
        [np.array(mi.render(scene, spp=paths, seed=i)).ravel() for i in range(repeats)]
    )
    seconds = (time.process_time() - start) / repeats
    variance = values.var(0, ddof=1) / values.mean(0) ** 2
    merit = seconds * 1e6 * variance.mean() / variance.size
    print(
        f"Mitsuba {variant}: {seconds / paths * 1e6:.2f} us/path, "
        f"relvar {variance.mean() * paths:.2f}, merit {merit:.3f} us",
        flush=True,
    )
    return merit


if __name__ == "__main__":
    own = dials()
    for name in sys.argv[1:] or ["scalar_spectral"]:
        if name != "none":
            other = mitsuba(name, 2**16 if name.startswith("llvm") else 2**11)
            print(f"{name} over MonteCarlo: {other / own:.1f}")
