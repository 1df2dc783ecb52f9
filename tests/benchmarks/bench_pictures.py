"""Time of a 1920 x 1080 x 8 picture on the CPU.

    python -m tests.benchmarks.bench_pictures

The multiple-scattering term of the printed size (Monzon et al. 2024, eq 9) by XLA and by a numba
kernel of the same formula that runs on every core; the whole picture by the two-stream model; cost
in the number of bands (in steps of eight, the width of a processor's vectors); and the price of a
forward-mode gradient.  Best of several runs; pictures.md is what it printed.
"""

import os
from importlib.metadata import version

if version("jaxlib").startswith("0.10."):
    # The newer of this version's two code generators draws eight times slower on a CPU.
    os.environ["XLA_FLAGS"] = (
        os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"
    )

import math
import time

import jax
import jax.numpy as jnp
import numba
import numpy as np

import oceaninv as oi
from oceaninv.transport.closed_form.kd import monzon2024

WIDTH, HEIGHT = 1920, 1080


def cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def best(call, repeats=5):
    """(wall, processor) seconds of the quickest of several runs, after one that compiles.

    On a machine that others use, processor seconds over cores is what an idle one would take."""
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        start, work = time.perf_counter(), time.process_time()
        jax.block_until_ready(call())
        times.append((time.perf_counter() - start, time.process_time() - work))
    return np.min(times, axis=0)


@numba.njit(parallel=True, fastmath=True)
def kernel(b, c, kd, e0, depth, down, length, out):
    """Eq 9 without a floor, one pixel per iteration."""
    for i in numba.prange(depth.size):
        for j in range(b.size):
            x = (kd[j] * down[i] - c[j]) * length[i]
            small = abs(x) < np.float32(1e-3)
            mean = np.float32(1) + x / np.float32(2) if small else (math.exp(x) - 1) / x
            source = math.exp(-kd[j] * depth[i])
            out[i, j] = b[j] * e0[j] * np.float32(0.0795775) * length[i] * mean * source


def printed_size(bands=8):
    """Seconds by XLA and by numba, and the largest relative difference."""
    rng = np.random.default_rng(0)
    n = WIDTH * HEIGHT
    spectra = [np.linspace(*ends, bands, dtype=np.float32) for ends in
               ((0.1, 0.2), (0.2, 0.6), (0.06, 0.4), (1.0, 0.8))]  # fmt: skip
    pixels = [rng.uniform(*ends, n).astype(np.float32) for ends in
              ((5.0, 5.1), (-0.5, 0.5), (1.0, 20.0))]  # fmt: skip
    arrays = [jnp.asarray(v) for v in (*spectra, *pixels)]
    call = jax.jit(monzon2024)
    out = np.empty((n, bands), np.float32)
    by_xla = best(lambda: call(*arrays))
    by_numba = best(lambda: kernel(*spectra, *pixels, out))
    ratio = np.asarray(call(*arrays)) / out
    return by_xla, by_numba, float(np.max(np.abs(ratio - 1)))


def scene(bands, a=(0.05, 0.4)):
    """Water under sun and sky with a surface, and a camera."""
    f = jnp.float32
    water = oi.IOPs(
        oi.spectrum.bands(bands),
        jnp.linspace(*a, bands, dtype=f),
        jnp.linspace(0.4, 0.3, bands, dtype=f),
        oi.phase.HenyeyGreenstein(jnp.asarray(0.924, f)),
    )
    light = oi.Light(30.0, jnp.ones(bands, f))
    return oi.Scene(water, light, oi.FlatSurface(jnp.asarray(1.34, f)))


def camera(width, height, depth=6.0):
    """A camera that looks ahead."""
    values = jnp.ones((3, 31), jnp.float32)
    response = oi.spectrum.Response(values, np.linspace(400, 700, 31), ("R", "G", "B"))
    return oi.Camera((0.0, 0, depth), (0.0, 1, 0), (0.0, 0, -1), 70.0, width, height, response)


def gradient_cost(size=256, bands=8):
    """Seconds of a photograph, and of it with four forward-mode derivatives."""
    model = oi.BioOpticalModel()
    base = scene(bands)

    def value(unknowns):
        c, y, d, depth = unknowns
        water = model.iops(oi.Constituents(c, y, d), base.wavelength)
        shot = oi.Scene(water, base.light, base.surface)
        return oi.photograph(shot, camera(size, size, depth)).value

    at = jnp.asarray([1.0, 0.1, 0.05, 6.0], jnp.float32)
    plain, slopes = jax.jit(value), jax.jit(jax.jacfwd(value))
    return best(lambda: plain(at), 3), best(lambda: slopes(at), 3)


def operations(bands=8) -> tuple[float, float]:
    """Arithmetic operations and exponentials (and their like) per pixel and band, by the compiler's
    count, of a picture that fits one piece."""
    small, shot = camera(192, 108), scene(bands)
    program = jax.jit(lambda s: oi.photograph(s, small).value).lower(shot).compile()
    found = program.cost_analysis()
    each = 192 * 108 * bands
    return found["flops"] / each, found["transcendentals"] / each


def shown(times) -> str:
    """Wall and processor seconds as text."""
    return f"{times[0]:.3f} s ({times[1]:.3f} processor s)"


if __name__ == "__main__":
    print(f"{cores()} cores, load {os.getloadavg()[0]:.1f}")
    xla, by_hand, difference = printed_size()
    print(f"printed-size term, 8 bands: XLA {shown(xla)}, numba {shown(by_hand)}, apart by"
          f" {difference:.0e}")  # fmt: skip
    sums, exponentials = operations()
    print(f"two-stream picture: {sums:.0f} operations, {exponentials:.0f} of them exponentials"
          " or the like, per pixel and band")  # fmt: skip
    full = camera(WIDTH, HEIGHT)
    costs = []
    for bands in (8, 16, 24, 32):
        shot = scene(bands)
        costs.append((bands, *best(lambda s=shot: oi.photograph(s, full).value, 3)))
        print(f"two-stream picture, {bands} bands: {shown(costs[-1][1:])}", flush=True)
    counts, _, work = np.array(costs).T
    slope, start = np.polyfit(counts, work, 1)
    worst = np.max(np.abs(start + slope * counts - work) / work)
    print(f"processor seconds: {start:.2f} + {slope:.3f} n, within {100 * worst:.0f} %")
    plain, slopes = gradient_cost()
    print(f"256 x 256 photograph: {shown(plain)}, with four derivatives {shown(slopes)}:"
          f" {slopes[1] / plain[1]:.1f} times")  # fmt: skip
