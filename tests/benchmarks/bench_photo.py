"""How long photo fits take: a chart fit, 100 photographs in one program, 1e5 pixels.

    python -m tests.benchmarks.bench_photo

User processor seconds of a second call of the same shape (the first compiles, apart).
"""

import resource

import jax
import numpy as np

from fitting import Photo, Pixels, fit_photo, fit_photos
from oceaninv.spectrum import camera_response
from tests.test_photo import CAMERA, clean, photo, scenery

PHOTOS, PIXELS = 100, 100_000


def seconds(work) -> float:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    work()
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime - before


def main():
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(0)

    def noisy():
        return photo(clean() * (1 + 0.01 * rng.standard_normal((9, 3))))

    values, distance = scenery(PIXELS)
    reef = Photo((), (), Pixels(values, distance), depth=5.0, response=camera_response(CAMERA))
    many = [noisy() for _ in range(PHOTOS)]
    print("| work | first call, s | second call, s |\n|---|---|---|")
    for name, work in (
        ("chart fit, two charts and open water", lambda: fit_photo(noisy())),
        (f"{PHOTOS} such photographs in one batch", lambda: fit_photos(many)),
        (f"{PIXELS} pixels of unknown reflectance", lambda: fit_photo(reef)),
    ):
        print(f"| {name} | {seconds(work):.1f} | {seconds(work):.2f} |", flush=True)


if __name__ == "__main__":
    main()
