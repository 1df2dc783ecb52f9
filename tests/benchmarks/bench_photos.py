"""Photo fits: one with every nuisance, 1e5 pixels of unknown reflectance, 100 photographs at once.

    python -m tests.benchmarks.bench_photos [charts | pixels | batch | vmapped]

Processor seconds of calls after the first (which compiles and is printed apart), best of three
(of one in `batch`).

- `charts`: a ColorChecker at three ranges and open water, camera unknown, 3 x 3 matrix, ranges,
  depth, robust loss.
- `pixels`: 1e5 pixels at 1-6 m with open water, readings checked and summed up included.
- `batch`: `fit_photos` of 100 such charts, each of its own water, against one.
- `vmapped`: residuals and their Jacobian of 32 photographs side by side, against one.

A run is written down in photos.md.
"""

import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from fitting import Background, Chart, Photo, Pixels, fit_photo, fit_photos
from fitting.core.least_squares import value_and_jacobian
from fitting.images.chart_targets import target
from fitting.observations.photo import WAVELENGTH
from fitting.photo.fit_photo import posterior_of
from fitting.photo.forward_model import predict
from fitting.photo.problem import prepare
from tests.fitting.photo.test_fit_photo import scenery

RANGES = (1.0, 2.0, 4.0)


def readings(values=None, sigma: float = 0.02, **rest) -> Photo:
    """A ColorChecker at three ranges and open water; readings of 1 unless given."""
    known = target("ColorChecker24")
    values = np.ones((24 * len(RANGES) + 1, 3)) if values is None else values
    parts = [values[24 * k : 24 * k + 24] for k in range(len(RANGES))]
    charts = [
        Chart(part, known.reflectance, r, sigma * part, distance_sd=0.02, board=known.board)
        for part, r in zip(parts, RANGES, strict=True)
    ]
    water = [Background(values[-1:], sigma=sigma * values[-1:])]
    return Photo(charts, water, depth=5.0, depth_sd=0.2, **rest)


def drawn(count: int, seed: int = 0, **rest) -> list[Photo]:
    """Photographs of random waters, 2 % noise."""
    rng = np.random.default_rng(seed)
    parameters, (arrays,), sun = prepare([readings(**rest)], oi.TwoStream())
    seen = jax.jit(lambda x: predict(parameters.values(x), arrays, oi.TwoStream(), sun))
    made = []
    for _ in range(count):
        x = np.array([p.transform.coordinate(p.centre) for p in parameters])
        x += (
            0.3
            * rng.standard_normal(len(x))
            * np.array([min(p.spread or 1.0, 2.0) if not p.nuisance else 0.3 for p in parameters])
        )
        clean = np.asarray(seen(jnp.asarray(x)))
        made.append(readings(clean * (1 + 0.02 * rng.standard_normal(clean.shape)), **rest))
    return made


def timed(call, repeats: int = 3) -> tuple[float, float]:
    """(processor seconds of the first call, of the best later one)."""
    spent = []
    for _ in range(repeats + 1):
        start = time.process_time()
        call()
        spent.append(time.process_time() - start)
    return spent[0], min(spent[1:])


def charts():
    """Print the time of one fit with every nuisance."""
    (photo,) = drawn(1)
    first, warm = timed(lambda: fit_photo(photo, matrix=True, robust=4.0))
    fit = fit_photo(photo, matrix=True, robust=4.0)
    print(f"charts: {warm:.2f} s (first {first:.1f} s), {len(fit.parameters)} unknowns, ", end="")
    print(f"{fit.metadata['readings']} readings, {fit.result}")


def pixels(count: int = 100_000):
    """Print the time of a fit of pixels of unknown reflectance."""
    values, distance = scenery(count)
    (photo,) = drawn(1, response=oi.spectrum.camera_response("Nikon D850"))

    def fit():
        seen = Pixels(values, distance, 1500.0)
        return fit_photo(Photo((), photo.backgrounds, seen, depth=5.0, response=photo.response))

    first, warm = timed(fit)
    found = fit()
    sd = float(found.quantities["c_550"].sd)
    print(f"pixels: {warm:.2f} s (first {first:.1f} s), {count} of them, {found.result}, ", end="")
    print(f"c(550) known to {100 * sd:.0f} %")


def batch(count: int = 100):
    """Print the time of many photographs in one program over that of one."""
    many = drawn(count, response=oi.spectrum.camera_response("Nikon D850"))
    _, one = timed(lambda: fit_photo(many[0]))
    found = []
    first, all_ = timed(lambda: found.extend(fit_photos(many)), repeats=1)
    done = sum(fit.converged for fit in found[:count])
    print(f"batch: {all_:.2f} s for {count} (first {first:.1f} s), {one:.3f} s for one: ", end="")
    print(f"{all_ / one:.1f} x; {done} converged")


def vmapped(count: int = 32, repeats: int = 30):
    """Print what a photograph's residuals and Jacobian cost alone and beside others."""
    many = drawn(count, response=oi.spectrum.camera_response("Nikon D850"))
    problems = [posterior_of([p], oi.TwoStream(), None, False, None, None, None)[1] for p in many]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)

    def slope(problem):
        return value_and_jacobian(problem.residual, problem.prior.centre)

    def spent(function, problem):
        jax.block_until_ready(function(problem))
        start = time.process_time()
        for _ in range(repeats):
            jax.block_until_ready(function(problem))
        return (time.process_time() - start) / repeats

    alone = spent(eqx.filter_jit(slope), problems[0])
    beside = spent(eqx.filter_jit(lambda p: jax.vmap(slope)(p)), stacked) / count
    print(
        f"vmapped: {1e3 * alone:.2f} ms alone, {1e3 * beside:.2f} ms beside {count - 1} others: ",
        end="",
    )
    print(f"{beside / alone:.2f} x")


def main():
    """Print what was asked for, all unless named."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)  # first calls compile
    for name in sys.argv[1:] or ("charts", "pixels", "batch", "vmapped"):
        {"charts": charts, "pixels": pixels, "batch": batch, "vmapped": vmapped}[name]()


if __name__ == "__main__":
    print(WAVELENGTH.size, "bands,", jax.devices()[0].device_kind)
    main()
