"""Time and compile time of PlaneParallel against PythonicDISORT, one thread, same run.

    python tests/benchmarks/bench_plane_parallel.py

20 wavelengths x 10 depths over a floor, 16 streams per hemisphere, float64 unless said; the water
is a function of three constituents.  Times are processor seconds, the least of several runs.
Then come radiances by azimuth orders and rays, and what the gradient of four-stream radiances
takes to compile.  A run is written down in plane_parallel.md.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import time

import jax
import jax.numpy as jnp
import numpy as np
from PythonicDISORT.pydisort import pydisort

from oceaninv.foundation.interface_optics import Rays
from oceaninv.scene.light import Light
from oceaninv.scene.scene import FlatSurface, Floor, Scene
from oceaninv.transport.closed_form.four_stream import FourStream
from oceaninv.transport.plane_parallel.plane_parallel import PlaneParallel
from oceaninv.water.iops import IOPs, Layers
from oceaninv.water.phase import HenyeyGreenstein, Seawater

WAVELENGTH = np.linspace(400.0, 700.0, 20)
DEPTHS = np.linspace(1.0, 19.0, 10)


def scene(p, layers=1):
    """A water of chlorophyll-, CDOM- and mineral-like amounts p, in equal layers, floor at 20 m."""

    def spectrum(values):
        return jnp.asarray(values, dtype=p.dtype)

    wl = WAVELENGTH
    water = spectrum(np.linspace(0.02, 0.5, 20))
    algae = spectrum(0.05 * np.exp(-(((wl - 440) / 50) ** 2)))
    yellow = spectrum(np.exp(-0.014 * (wl - 440)))
    particles, molecules = spectrum(0.3 * 550 / wl), spectrum(0.003 * (500 / wl) ** 4.3)
    a = water + p[0] * algae + p[1] * yellow
    phases = (HenyeyGreenstein(jnp.asarray(0.924, p.dtype)), Seawater(jnp.asarray(0.835, p.dtype)))
    iops = IOPs(wl, a, jnp.stack([p[2] * particles, molecules]), phases)
    if layers > 1:
        edges = jnp.linspace(0.0, 20.0, layers + 1, dtype=p.dtype)[1:-1]
        iops = Layers(edges, (iops,) * layers)
    ones = jnp.ones(20, dtype=p.dtype)
    return Scene(iops, Light(jnp.asarray(30.0, p.dtype), ones), floor=Floor(20.0, 0.1 * ones))


def run(streams=16, layers=1, derivatives=False, dtype=jnp.float64):
    """(processor seconds, compile seconds)."""

    def fluxes(p):
        found = PlaneParallel(streams).fluxes(scene(p, layers), jnp.asarray(DEPTHS, dtype=dtype))
        stacked = jnp.stack([found.Ed, found.Eu, found.E0])
        return (stacked, stacked) if derivatives else stacked

    p = jnp.asarray([1.0, 0.1, 1.0], dtype=dtype)
    function = jax.jacfwd(fluxes, has_aux=True) if derivatives else fluxes
    start = time.process_time()
    compiled = jax.jit(function).lower(p).compile()
    compile_seconds = time.process_time() - start
    return least(lambda: jax.block_until_ready(compiled(p))), compile_seconds


def least(function, repeats=20):
    """The least processor time of several calls."""
    function()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def disort():
    """PythonicDISORT, fluxes only, the same waters."""
    water = scene(jnp.asarray([1.0, 0.1, 1.0])).water
    moments = np.asarray(water.scattering_moments(32))
    albedo = np.asarray(water.b / water.c)
    thickness = np.asarray(water.c) * 20

    def all_wavelengths():
        for i in range(20):
            chi = moments[:, i] / moments[0, i]
            solved = pydisort(
                thickness[i], albedo[i], 32, chi, np.cos(np.radians(30)), 1.0, 0.0,
                only_flux=True, f_arr=chi[32], BDRF_Fourier_modes=[0.1],
            )  # fmt: skip
            for flux in solved[1:3]:
                flux(DEPTHS / 20 * thickness[i])

    return least(all_wavelengths, 5)


def memory(count):
    """Megabytes that the compiled program works in, for fluxes at `count` wavelengths."""

    def fluxes(a):
        water = IOPs(np.linspace(400, 700, count), a, 2 * a, HenyeyGreenstein(0.9))
        given = Scene(water, Light(40.0, jnp.ones(count)))
        return PlaneParallel(8).fluxes(given, jnp.asarray(DEPTHS)).Ed

    compiled = jax.jit(fluxes).lower(jnp.full(count, 0.1)).compile()
    return compiled.memory_analysis().temp_size_in_bytes / 1e6


def radiance(modes, rays):
    """(processor seconds, compile seconds) of the light along `rays` lines of sight."""
    angle = np.linspace(0.3, 2.8, rays)
    looks = jnp.asarray(np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1))

    def seen(p):
        given = Rays(jnp.asarray([0.0, 0.0, 5.0]), looks)
        return PlaneParallel(16, modes).radiance(scene(p), given).value

    p = jnp.asarray([1.0, 0.1, 1.0])
    start = time.process_time()
    compiled = jax.jit(seen).lower(p).compile()
    compile_seconds = time.process_time() - start
    return least(lambda: jax.block_until_ready(compiled(p)), 5), compile_seconds


def four_stream():
    """Seconds to compile the derivatives of radiances in a and b, (forward, reverse)."""
    looks = jnp.asarray([[0.6, 0.0, 0.8], [0.0, 0.6, -0.8], [0.0, 0.8, 0.6]])

    def radiance(p):
        one = jnp.ones(4)
        water = IOPs([450.0, 500.0, 550.0, 600.0], p[0] * one, p[1] * one, HenyeyGreenstein(0.9))
        given = Scene(water, Light(40.0, one), FlatSurface(1.34))
        return FourStream().radiance(given, Rays(jnp.asarray([0.0, 0.0, 2.0]), looks)).value

    seconds = []
    for derivative in (jax.jacfwd(radiance), jax.grad(lambda p: radiance(p).sum())):
        start = time.process_time()
        jax.jit(derivative).lower(jnp.asarray([0.1, 0.4])).compile()
        seconds.append(time.process_time() - start)
    return seconds


def main():
    """Print one line per measurement, milliseconds per wavelength."""
    jax.config.update("jax_enable_x64", True)
    value, compiling = run()
    reference = disort()
    print(f"value {value * 50:.3f} ms/wl, compiles in {compiling:.1f} s", flush=True)
    print(f"PythonicDISORT {reference * 50:.3f} ms/wl, {reference / value:.1f} x")
    both, compiling = run(derivatives=True)
    print(
        f"with 3 derivatives {both * 50:.3f} ms/wl ({both / value:.1f} x), {compiling:.1f} s",
        flush=True,
    )
    print(f"float32 {run(dtype=jnp.float32)[0] * 50:.3f} ms/wl")
    for streams in (4, 8, 32, 48):
        print(f"{streams} streams {run(streams)[0] * 50:.3f} ms/wl")
    for layers in (2, 4, 8):
        print(f"{layers} layers {run(layers=layers)[0] * 50:.3f} ms/wl")
    for count in (20, 40, 80):
        print(f"{count} wavelengths: working memory {memory(count):.3f} MB (8 streams)")
    for modes, rays in ((1, 4), (4, 4), (8, 4), (16, 4), (8, 16), (8, 64)):
        seconds, compiling = radiance(modes, rays)
        print(
            f"radiance, {modes} azimuth orders, {rays} rays: {seconds * 50:.2f} ms/wl "
            f"({seconds / value:.0f} x fluxes), compiles in {compiling:.1f} s",
            flush=True,
        )
    forward, reverse = four_stream()
    print(f"four-stream radiance: gradient compiles in {forward:.1f} (forward), {reverse:.1f} s")


if __name__ == "__main__":
    main()
