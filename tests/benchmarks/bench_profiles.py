"""1,000 casts of 7 bands and 100 depths: one call against a loop of scipy's curve_fit.

    python -m tests.benchmarks.bench_profiles [kd | waters | memory COUNT | cluster]

Processor time of both, in the same run, errors given; the first call, which compiles, apart.

- `kd`: two unknowns a band.
- `waters`: constituents and nuisances, 13 unknowns and 7 free Ed(0-), 128 casts, the loop over 4 of
  them.  curve_fit gets the same unknowns, priors (as further data) and model, compiled by JAX for
  all depths and bands, and differences it itself, as users have it.
- `cluster`: an archive of 256 files of a cast each, Kd alone, in this process and through a dask
  cluster of one worker process on this machine, both after a run that compiles; what scheduler,
  client and worker spend together.
- `memory`: peak resident memory of so many casts, Kd alone, that come one by one.
A run is written down in profiles.md.
"""

import resource
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import curve_fit

import oceaninv as oi
from fitting import Profile, fit_profiles, stream_profiles
from fitting.core.parameters import Parameters
from fitting.profile.archive import Task, fit_archive
from fitting.profile.constituents.batched_search import curve
from fitting.water_model.unknowns import water_unknowns

CASTS, BANDS, DEPTHS = 1000, 7, 100
LOOP = 100


def casts(seed: int = 0) -> list[Profile]:
    """Casts down to 12 % light in the clearest band, 5 % noise."""
    rng = np.random.default_rng(seed)
    made = []
    for kd in np.exp(rng.uniform(np.log(0.04), np.log(0.4), (CASTS, BANDS))):
        depth = np.linspace(0.2, 1.0, DEPTHS) * 2.1 / kd.min()
        clean = np.exp(-kd * depth[:, None])
        seen = clean * (1 + 0.05 * rng.standard_normal(clean.shape))
        made.append(Profile(depth, 400.0 + 10.0 * np.arange(BANDS), seen, sigma=0.05 * clean))
    return made


def _model(depth, surface, kd):
    return surface * np.exp(-kd * depth)


def water_casts(count: int) -> list[Profile]:
    """Casts of random waters by the default model down to some 10 % of the clearest band."""
    rng, made = np.random.default_rng(1), []
    grid = tuple(np.linspace(412.0, 665.0, BANDS).tolist())
    layout = Parameters(water_unknowns(40.0))
    model = jax.jit(lambda x, z: curve(layout.values(x), grid, oi.TwoStream(), z)[0])
    for _ in range(count):
        x = np.array([p.transform.coordinate(p.centre) for p in layout])
        x[:3] += rng.normal(0.0, 0.7, 3)
        depth = np.linspace(0.0, 15.0, DEPTHS)
        clean = np.exp(np.asarray(model(jnp.asarray(x), jnp.asarray(depth))))
        seen = clean * (1 + 0.05 * rng.standard_normal(clean.shape))
        made.append(Profile(depth, grid, seen, sigma=0.05 * clean, solar_zenith=40.0))
    return made


def waters(count: int = 128, loop: int = 4):
    """Print the comparison of the full model."""
    many, transport = water_casts(count), oi.TwoStream()
    grid = tuple(many[0].wavelength.tolist())
    times, fits = [], fit_profiles(many[:1])
    for _ in range(3):
        start = time.process_time()
        fits = fit_profiles(many, transport=transport, depth_range=(0.0, 1e4))
        times.append(time.process_time() - start)
    layout = Parameters(water_unknowns(40.0))
    prior = layout.prior()
    centre, weight = np.asarray(prior.centre), np.asarray(prior.weight)

    @jax.jit
    def model(x, surface, depth, sd):
        light = surface[None, :] + curve(layout.values(x), grid, transport, depth)[0]
        return jnp.concatenate([(jnp.exp(light) / sd).reshape(-1), prior.residual(x)])

    spent, apart = 0.0, []
    for i, cast in enumerate(many[:loop]):
        depth, sd = jnp.asarray(cast.depth), jnp.asarray(cast.sigma)

        def function(_, *unknown, depth=depth, sd=sd):
            x = jnp.asarray(unknown)
            return np.asarray(model(x[: len(centre)], x[len(centre) :], depth, sd))

        data = np.concatenate([(cast.Ed / cast.sigma).reshape(-1), np.zeros(len(centre))])
        first = np.concatenate([centre, np.log(cast.Ed[0])])
        function(None, *first)
        start = time.process_time()
        found, _ = curve_fit(function, None, data, p0=first, maxfev=100_000)
        spent += time.process_time() - start
        ours = fits.water(i)
        free = weight > 0
        away = (found[: len(centre)] - ours.x) / np.sqrt(np.diag(ours.covariance))
        apart.append(np.abs(away[free]).max())
    mine, theirs = min(times[1:]) / count, spent / loop
    print(f"constituents: {1e3 * mine:.1f} ms a cast (first call {times[0]:.1f} s); curve_fit: ")
    print(f"{1e3 * theirs:.0f} ms; ratio {theirs / mine:.0f}; {max(apart):.1e} sd apart at most")


def cluster(count: int = 256):
    """Print what a cluster costs a cast."""
    from dask.distributed import Client, LocalCluster

    depth, rng = np.linspace(0.2, 20.0, DEPTHS), np.random.default_rng(0)
    head = "Ed in W m-2 nm-1\ndepth_m," + ",".join(f"Ed_{400 + 10 * b}" for b in range(BANDS))
    with tempfile.TemporaryDirectory() as folder:
        root, paths = Path(folder), []
        for i, kd in enumerate(np.exp(rng.uniform(np.log(0.04), np.log(0.4), (count, BANDS)))):
            seen = np.exp(-kd * depth[:, None]) * (1 + 0.05 * rng.standard_normal((DEPTHS, BANDS)))
            paths.append(root / f"cast_{i}.csv")
            with paths[-1].open("w") as file:
                file.write(f"# {head}\n")
                np.savetxt(file, np.column_stack([depth, seen]), delimiter=",")
        machine: Any = LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0")
        with machine:
            scheduler = machine.scheduler_address
            client: Any = Client(scheduler)

            def spent() -> float:
                return time.process_time() + sum(client.run(time.process_time).values())

            times = {}
            for name, address in (("here", None), ("cluster", scheduler)):
                for run in ("first", "again"):
                    start = spent()
                    outcomes = fit_archive(paths, Task(root / f"{name}_{run}"), address)
                    done = sum(one.casts for one in outcomes)
                    times[name] = 1e3 * (spent() - start) / done
            client.close()
    print(", ".join(f"{name} {ms:.1f} ms a cast" for name, ms in times.items()), end="; ")
    print(f"overhead {times['cluster'] - times['here']:+.1f} ms")


def memory(count: int):
    """Print the peak of `count` casts."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rng, depth = np.random.default_rng(0), np.linspace(0.2, 20.0, DEPTHS)

    def stream():
        for kd in np.exp(rng.uniform(np.log(0.04), np.log(0.4), (count, BANDS))):
            seen = np.exp(-kd * depth[:, None])
            seen *= 1 + 0.05 * rng.standard_normal(seen.shape)
            yield Profile(depth, 400.0 + 10.0 * np.arange(BANDS), seen)

    start, done = time.process_time(), 0
    for table in stream_profiles(stream()):
        done += int(table.sizes["cast"])
        if done % 16384 == 0 or done == count:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            each = 1e3 * (time.process_time() - start) / done
            print(f"{done} casts: peak {peak / 2**20:.2f} GiB ", end="")
            print(f"(before {before / 2**20:.2f}), {each:.2f} ms a cast", flush=True)


def main():
    """Print what was asked for."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)  # first calls compile
    asked = sys.argv[1:] or ["kd"]
    if asked[0] == "waters":
        waters()
    elif asked[0] == "cluster":
        cluster()
    elif asked[0] == "memory":
        memory(int(asked[1]))
    else:
        plain()


def plain():
    """Print the comparison of Kd."""
    many = casts()
    times, fits = [], fit_profiles(many[:1])
    for _ in range(4):
        start = time.process_time()
        fits = fit_profiles(many, depth_range=(0.0, 1e4))
        times.append(time.process_time() - start)
    start, worst = time.process_time(), 0.0
    for i, cast in enumerate(many[:LOOP]):
        ours = fits[i].quantities["Kd"].value
        for band in range(BANDS):
            (_, kd), _ = curve_fit(
                _model,
                cast.depth,
                cast.Ed[:, band],
                p0=(cast.Ed[0, band], 0.1),
                sigma=np.asarray(cast.sigma)[:, band],
                absolute_sigma=True,
            )
            worst = max(worst, abs(kd / ours[band] - 1))
    loop = (time.process_time() - start) * CASTS / LOOP
    best = min(times[1:])
    print(f"fit_profiles: {best:.2f} s (first call {times[0]:.2f} s); curve_fit: {loop:.2f} s")
    print(f"ratio {loop / best:.1f}; Kd differs by {worst:.1e} at most")


if __name__ == "__main__":
    main()
