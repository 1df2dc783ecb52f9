"""Lorenz-Mie: time against miepython's compiled backend, scaling, and error against radii.

    taskset -c 0 python tests/benchmarks/bench_mie.py

Times are processor times of one thread, the best of several rounds that interleave all
contestants, so that other work on the machine disturbs them little.
A run is written down in mie.md.
"""

import os

os.environ["MIEPYTHON_USE_JIT"] = "1"

import json
import sys
import time
from pathlib import Path

import jax
import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
jax.config.update("jax_enable_x64", True)

from oceaninv.mie import _frisvad2007_table, particles, sphere  # noqa: E402

WAVELENGTH = np.linspace(400.0, 700.0, 16)
RADIUS = np.geomspace(0.01, 100.0, 1000)


def sections(particle, host, radius=RADIUS):
    return sphere.cross_sections(radius[None, :], WAVELENGTH[:, None], particle, host)


def five_derivatives():
    """Value and the derivatives in radius and both parts of both indices, absorbing host."""
    wavelength, ones = WAVELENGTH[:, None], np.ones((16, 1000))

    def outputs(radius, n, k, host_n, host_k):
        particle, host = jax.lax.complex(n, k), jax.lax.complex(host_n, host_k)
        return sphere.cross_sections(radius, wavelength, particle, host, max_size=2300.0)

    @jax.jit
    def run(*point):
        value, push = jax.linearize(outputs, *point)
        zeros = [np.zeros((16, 1000))] * 5
        slopes = [push(*zeros[:i], ones, *zeros[i + 1 :]) for i in range(5)]
        return value, slopes

    point = (ones * RADIUS, ones * 1.58, ones * 1e-4, ones * 1.34, ones * 1e-8)
    return lambda: run(*point)


def contestants():
    runs = {
        "real host and particle": lambda: sections(1.58, 1.34),
        "absorbing host and particle": lambda: sections(1.58 + 1e-4j, 1.34 + 1e-8j),
        "value and five derivatives": five_derivatives(),
    }
    try:
        import miepython
    except ImportError:
        print("miepython is not installed: no comparison")
        return runs
    x = (2000 * np.pi * 1.34 * RADIUS[None, :] / WAVELENGTH[:, None]).ravel()
    m = np.full(x.shape, 1.58 / 1.34)
    return {"miepython-jit (Q only)": lambda: miepython.efficiencies_mx(m, x)} | runs


def clock(run):
    start = time.process_time()
    jax.block_until_ready(run())
    return time.process_time() - start


def race(runs, rounds=7):
    first = {name: clock(run) for name, run in runs.items()}
    best = {name: min(clock(run) for _ in range(2)) for name, run in runs.items()}
    for _ in range(rounds):
        for name, run in runs.items():
            best[name] = min(best[name], clock(run))
    return first, best


def speed():
    first, best = race(contestants())
    base = best.get("miepython-jit (Q only)", np.nan)
    print(f"{'16 wavelengths x 1000 radii':36s}{'first s':>9s}{'best s':>9s}{'/ miepython':>12s}")
    for name in best:
        print(f"{name:36s}{first[name]:9.2f}{best[name]:9.4f}{best[name] / base:12.3f}")
    real, absorbing, slopes = (best[k] for k in list(best)[-3:])
    print(
        f"absorbing / real host {absorbing / real:.2f}; "
        f"derivatives / value {slopes / absorbing:.2f}"
    )


def scaling():
    print("\nradii per wavelength, ms per 1000 spheres")
    for count in (256, 1024, 4096):
        radius = np.geomspace(0.01, 100.0, count)
        _, best = race({"": lambda radius=radius: sections(1.58, 1.34, radius)}, 3)
        print(f"{count:8d}{best[''] / (16 * count) * 1e6:10.3f}")
    print("largest x, 4096 spheres with x from x/2 to x: microseconds per sphere and 1000 x")
    for largest in (250.0, 500.0, 1000.0, 2000.0):
        x = np.linspace(largest / 2, largest, 4096)
        _, best = race({"": lambda x=x: sphere.efficiencies(x, 1.2)}, 3)
        print(f"{largest:8g}{best[''] / x.sum() * 1e9:10.2f}")


def accuracy():
    reference = json.loads((ROOT / "tests/reference/natural_waters.json").read_text())
    wavelength = np.array(reference["wavelength_nm"], float)
    host = _frisvad2007_table.index("brine", wavelength)
    kinds = {
        "algae": particles.PowerLaw(3.6, 0.225, 100.0),
        "mineral": particles.PowerLaw(3.4, 0.01, 100.0),
    }
    print("\nlargest relative error over 16 wavelengths; reported error; seconds (compiled)")
    for name, water in reference["waters"].items():
        print(
            f"{name}\n{'radii':>8s}{'a':>9s}{'b':>9s}{'g':>9s}{'a rep.':>9s}{'b rep.':>9s}{'s':>8s}"
        )
        for radii in (25, 50, 100, 200, 400, 800, 1600, 3200):
            populations = [
                particles.Population(
                    _frisvad2007_table.index(kind, wavelength), sizes, water[f"v_{short}"], radii
                )
                for (kind, sizes), short in zip(kinds.items(), ("algal", "mineral"), strict=True)
            ]
            bulk = particles.medium(wavelength, host, populations)
            seconds = clock(lambda p=populations: particles.medium(wavelength, host, p))
            errors = [
                np.abs(np.asarray(value) / np.array(water[key]) - 1).max()
                for value, key in ((bulk.a, "sigma_a"), (bulk.b, "sigma_s"), (bulk.g, "g"))
            ]
            errors += [float((bulk.a_error / bulk.a).max()), float((bulk.b_error / bulk.b).max())]
            print(f"{radii:8d}" + "".join(f"{e:9.1e}" for e in errors) + f"{seconds:8.2f}")


if __name__ == "__main__":
    speed()
    scaling()
    accuracy()
