"""Similarity theory as a dial: speed-up and error in milk and in bubbly ice.

    python -m tests.acceptance.similarity [log2 of the number of walks, default 12 | tails]

Frisvad et al. 2007, section 3: after ten mean free paths the medium counts as one that scatters
evenly, with b (1 - g).  The paper: ten to twenty times as fast, no influence on the result.  Here
the diffuse reflectance and the nadir radiance of deep whole milk, skimmed milk and first-year ice
under a sun at 30 degrees, by walks of four times as many events as absorption lets live (20000 at
most), with the switch after 10 events, after 100, and without, against the exact field.

`tails`: whether single runs show that they have missed rare heavy walks: the nadir radiance of ice
by 14 runs of 1024 walks, every walk a group of its own.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from oceaninv.transport.monte_carlo import _backward, _event_loop

BANDS = np.array([550.0])  # one: after thousands of events no band's weights serve another
MEDIA = {
    "whole milk": lambda: oi.media.milk(3.5, 3.2, radii=60),
    "skimmed milk": lambda: oi.media.milk(0.1, 3.2, radii=60),
    "first-year ice": lambda: oi.media.ice(air=0.006, brine=0.02, radii=24),
}


def estimates(water, transport, seed):
    """(2, wl) reflectance and nadir radiance, their errors, and CPU seconds."""
    light = oi.Light(30.0, jnp.ones(len(BANDS)))
    scene = oi.Scene(water, light)
    rays = oi.Rays(jnp.zeros(3), jnp.asarray([[0.0, 0.0, 1.0]]))
    cosine = float(np.cos(np.radians(30.0)))

    def run(seed):
        key = jax.random.key(seed)
        up = oi.irradiance(scene, [0.0], transport, key=key).Eu
        seen = oi.radiance(scene, rays, transport, key=key)
        pairs = [(up.value[0] / cosine, up.stderr[0] / cosine), (seen.value[0], seen.stderr[0])]
        return (np.array([p[i] for p in pairs]) for i in (0, 1))

    run(seed + 1)  # compiles
    start = time.process_time()
    value, stderr = run(seed)
    return value, stderr, time.process_time() - start


def tails() -> None:
    """Per run the value over the exact one, its stated error, the heaviest walk's share in the sum
    of squares, and Hill's tail exponent of the upper 50 walks."""
    _event_loop.GROUP = _backward.GROUP = 1
    estimate, seen = _event_loop.estimate, []

    def watched(sums, scene, plan):
        jax.debug.callback(lambda walks: seen.append(np.sort(walks)[::-1]), sums[0][:, 0, 0])
        return estimate(sums, scene, plan)

    _event_loop.estimate = watched
    water = MEDIA["first-year ice"]().iops(BANDS, shapes=1, fit=oi.media.fit_lobes)
    scene = oi.Scene(water, oi.Light(30.0, jnp.ones(len(BANDS))))
    rays = oi.Rays(jnp.zeros(3), jnp.asarray([[0.0, 0.0, 1.0]]))
    exact = float(oi.radiance(scene, rays, oi.PlaneParallel(48)).value[0, 0])
    for similar in (10, 100):
        transport = oi.MonteCarlo(1024, 193 + similar, roulette=False, similar=similar)
        for seed in range(300, 314):
            oi.radiance(scene, rays, transport, key=jax.random.key(seed)).value.block_until_ready()
            jax.effects_barrier()
            walks = seen.pop() * 32  # sums are divided by a group's usual number
            apart = walks - walks.mean()
            print(
                f"switch after {similar}: {walks.mean() / exact:.3f} +- "
                f"{walks.std() / exact / np.sqrt(walks.size):.3f}, heaviest "
                f"{apart[0] ** 2 / (apart**2).sum():.3f}, tail "
                f"{np.log(walks[:50] / walks[50]).mean():.2f}",
                flush=True,
            )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    if sys.argv[1:] == ["tails"]:
        return tails()
    walks = 2 ** (int(sys.argv[1]) if len(sys.argv) > 1 else 12)
    print("| medium | g | 1 - albedo | events | CPU, s | times as fast | error of R | of L |")
    print("|---|---|---|---|---|---|---|---|")
    for name, make in MEDIA.items():
        water = make().iops(BANDS, shapes=1, fit=oi.media.fit_lobes)
        g = np.asarray(water.scattering_moments(1)[1] / water.b)
        rest = np.asarray(water.a / water.c)
        exact, _, _ = estimates(water, oi.PlaneParallel(24), 0)
        # Walks that reach n events bring about n^-1.5 each; absorption ends them at 1/rest.
        soft = rest / (rest + (1 - rest) * (1 - g))
        plain = 0.0
        for similar, left in ((None, rest), (10, soft), (100, soft)):
            events = int(np.clip(4.0 / left.min(), 64, 20000)) + (similar or 0)
            transport = oi.MonteCarlo(walks, events, roulette=False, similar=similar)
            value, stderr, seconds = estimates(water, transport, 1)
            plain = seconds if similar is None else plain
            error, random = value / exact - 1, stderr / exact
            print(
                f"| {name}{'' if similar is None else f', switch after {similar}'} | "
                f"{g.mean():.3f} | {rest.min():.1e} | {events} | {seconds:.1f} | "
                f"{plain / seconds:.1f} | {error[0, 0]:+.2%} +- {random[0, 0]:.2%} | "
                f"{error[1, 0]:+.2%} +- {random[1, 0]:.2%} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
