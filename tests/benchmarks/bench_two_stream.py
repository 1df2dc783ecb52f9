"""Error against time of the closed forms, as ratios within one run; cost of a frame; import time.

    python -m tests.benchmarks.bench_two_stream

Errors are over the exact cases of tests/reference/two_stream_exact.csv that every model can do
(deep water, sun only, beyond 20 degrees of the refracted sun).  Times are the best of several
runs of one compiled program on 4096 rays x 8 wavelengths, relative to the printed closure.
A run is written down in two_stream.md.
"""

import functools
import subprocess
import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import oceaninv as oi  # noqa: E402
from oceaninv.transport.closed_form.kd import monzon2024  # noqa: E402
from tests.acceptance import two_stream_accuracy as accuracy  # noqa: E402
from tests.oceaninv.transport.closed_form import test_two_stream as reference  # noqa: E402

WAVELENGTH = np.linspace(420.0, 680.0, 8)


def _best(call, *arguments, repeats=7):
    jax.block_until_ready(call(*arguments))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call(*arguments))
        times.append(time.perf_counter() - start)
    return min(times)


def _scene(dtype, floor=False):
    ones = jnp.ones(8, dtype)
    water = oi.IOPs(
        WAVELENGTH,
        jnp.linspace(0.05, 0.4, 8).astype(dtype),
        jnp.linspace(0.4, 0.3, 8).astype(dtype),
        oi.phase.HenyeyGreenstein(jnp.asarray(0.924, dtype)),
    )
    bottom = oi.Floor(15.0, 0.3 * ones) if floor else None
    return oi.Scene(water, oi.Light(30.0, ones), oi.FlatSurface(jnp.asarray(1.34, dtype)), bottom)


def _rays(count, dtype):
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.zeros((count, 3))
    origin[:, 2] = rng.uniform(1.0, 9.0, count)
    return jnp.asarray(origin, dtype), jnp.asarray(direction, dtype)


def times():
    """Seconds per (model, dtype)."""
    found = {}
    for dtype in (jnp.float64, jnp.float32):
        scene = _scene(dtype)
        origin, direction = _rays(4096, dtype)

        def model(scene, origin, direction, transport):
            return oi.radiance(scene, oi.Rays(origin, direction), transport).value

        def printed(scene, origin, direction):
            water = scene.water
            path = jnp.full_like(origin[:, 2], 10.0)
            kd = water.a + 2 * water.bb
            return monzon2024(
                water.b, water.c, kd, scene.light.direct, origin[:, 2], direction[:, 2], path
            )

        name = jnp.dtype(dtype).name
        found["printed closure", name] = _best(jax.jit(printed), scene, origin, direction)
        for label, transport in (("KdTransport", oi.KdTransport()), ("TwoStream", oi.TwoStream())):
            call = jax.jit(functools.partial(model, transport=transport))
            found[label, name] = _best(call, scene, origin, direction)
        call = jax.jit(functools.partial(model, transport=oi.TwoStream()))
        found["TwoStream, floor", name] = _best(call, _scene(dtype, True), origin, direction)
    return found


def errors():
    """Median |relative error| per model over the deep exact cases."""
    a, b = accuracy.coefficients()
    gathered = {"printed closure": [], "KdTransport": [], "TwoStream": []}
    for (name, sun, surface, floor, i), exact in reference._exact().items():
        if floor is not None:
            continue
        one = jnp.ones(1)
        water = oi.IOPs(
            [550.0], jnp.asarray(a[i : i + 1]), jnp.asarray(b[i : i + 1]), accuracy.phase(name)
        )
        scene = oi.Scene(
            water, oi.Light(sun, one), None if surface is None else oi.FlatSurface(surface)
        )
        outside = np.tile(accuracy.scattering_angles(sun, surface) >= 20.0, len(accuracy.DEPTHS))
        truth = exact["whole"]
        lines = accuracy.rays()
        for label, transport in (("KdTransport", oi.KdTransport()), ("TwoStream", oi.TwoStream())):
            value = np.asarray(oi.radiance(scene, lines, transport).value)[:, 0]
            gathered[label].append((value / truth - 1)[outside])
        kd = np.log(exact["Ed"][0] / exact["Ed"][5]) / (exact["levels"][5] - exact["levels"][0])
        surface_down = exact["Ed"][0] * np.exp(kd * exact["levels"][0])
        z, down = np.asarray(lines.origin[:, 2]), np.asarray(lines.direction[:, 2])
        path = np.where(down < 0, -z / np.minimum(down, -1e-3), 1e5)
        values = (b[i : i + 1], a[i : i + 1] + b[i : i + 1], [kd], [surface_down], z, down, path)
        value = np.asarray(monzon2024(*(jnp.asarray(v) for v in values)))[:, 0]
        gathered["printed closure"].append((value / truth - 1)[outside])
    return {k: float(np.median(np.abs(np.concatenate(v)))) for k, v in gathered.items()}


def frame(dtype=jnp.float32):
    """Seconds for 1920 x 1080 rays x 8 wavelengths, in rows of the picture."""
    scene = _scene(dtype, True)
    origin, direction = _rays(1920 * 12, dtype)

    @jax.jit
    def rows(scene, origin, direction):
        return oi.radiance(scene, oi.Rays(origin, direction)).value

    return _best(rows, scene, origin, direction, repeats=3) * 1080 / 12


def imports():
    """Import time of the package over that of jax, equinox and numpy (best of five each)."""

    def seconds(code):
        best = np.inf
        for _ in range(5):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], check=True)
            best = min(best, time.perf_counter() - start)
        return best

    return seconds("import oceaninv") / seconds("import jax, equinox, numpy")


def main():
    error, taken = errors(), times()
    unit = taken["printed closure", "float64"]
    print("| model | median error | time / printed closure, float64 | float32 |\n|---|---|---|---|")
    for label in ("printed closure", "KdTransport", "TwoStream", "TwoStream, floor"):
        ratios = [taken[label, name] / unit for name in ("float64", "float32")]
        shown = f"{error[label]:.3f}" if label in error else ""
        print(f"| {label} | {shown} | {ratios[0]:.2f} | {ratios[1]:.2f} |")
    print(f"\n1 = {unit / (4096 * 8) * 1e9:.1f} ns per ray and wavelength")
    print(f"frame 1920 x 1080 x 8, float32, floor and surface: {frame():.1f} s")
    print(f"import oceaninv / import jax, equinox, numpy: {imports():.2f} (wanted <= 1.3)")


if __name__ == "__main__":
    main()
