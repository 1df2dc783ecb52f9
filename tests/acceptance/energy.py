"""Energy budgets against exact fluxes, and what a second change of wavelength brings.

    python -m tests.acceptance.energy [log2 of the number of walks, default 15]

Budgets: clear and rich water of Gutierrez et al. 2008, with and without surface, sky and floor, in
two layers; absorption of every constituent, light that leaves and what the floor takes, against
PlaneParallel, and the inelastic events against the depth's integral of its scalar irradiance.

Orders: the share of light that has changed its wavelength twice, exactly, at the surface and at 10
and 30 m, with the bound on all further ones, and by MonteCarlo of one and two generations.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

import oceaninv as oi

BANDS = np.arange(390.0, 701.0, 25.0)
ONE = jnp.ones(len(BANDS))
SEAS = {
    "clear": oi.Constituents(chlorophyll=0.1, cdom=0.01, detritus=0.01),
    "rich": oi.Constituents(chlorophyll=1.0, cdom=0.1, detritus=0.1),
}
PROCESSES = oi.Inelastic(oi.Raman(), oi.ChlorophyllFluorescence(), oi.CDOMFluorescence())
SUN, SKY = oi.Light(40.0, ONE), oi.Light(40.0, ONE, 0.1 * ONE)
SURFACE, FLOOR = oi.FlatSurface(1.34), oi.Floor(6.0, 0.3 * ONE)


def scenes():
    """(name, scene, layers' bounds)."""
    model = oi.gutierrez2008()
    for name, amounts in SEAS.items():
        water = model.iops(amounts, BANDS)
        yield f"{name}, deep", oi.Scene(water, SUN, SURFACE), [0.0]
        yield f"{name}, floor, sky", oi.Scene(water, SKY, SURFACE, FLOOR), [0.0, 6.0]
        yield f"{name}, floor, no surface", oi.Scene(water, SKY, None, FLOOR), [0.0, 6.0]
    two = oi.Layers(jnp.asarray([2.0]), tuple(model.iops(a, BANDS) for a in SEAS.values()))
    yield "two layers", oi.Scene(two, SKY, SURFACE, FLOOR), [0.0, 2.0, 6.0]


def entering(scene):
    """Flux of sun and sky that enters, (wl,)."""
    from oceaninv.optics import fresnel_from_air

    cosine, sun = scene.beam()
    flux = np.asarray(sun * cosine)
    if scene.light.diffuse is not None:
        node, weight = np.polynomial.legendre.leggauss(400)
        mu = 0.5 * (1 + node)
        through = np.ones_like(mu)
        if scene.surface is not None:
            through = 1 - np.asarray(fresnel_from_air(jnp.asarray(mu), scene.surface.index))
        share = np.sum(weight * mu * through)
        flux = flux + np.pi * share * np.asarray(scene.light.diffuse)
    return flux


def z_of_budget(scene, depths, walks):
    """z of every flux that a budget and PlaneParallel both know, and the closure."""
    found = oi.energy_budget(scene, oi.MonteCarlo(walks, 64))
    exact = oi.irradiance(scene, depths, oi.PlaneParallel(24))
    down, up = np.asarray(exact.Ed.value), np.asarray(exact.Eu.value)
    net = down - up
    if scene.floor is None:
        net = np.concatenate([net, 0 * net[:1]])
    incoming = entering(scene)
    expected = {"surface": incoming - net[0]}
    if scene.floor is not None:
        expected["floor"] = net[-1]
    waters = (scene.water,) if isinstance(scene.water, oi.IOPs) else scene.water.iops
    for i, water in enumerate(waters):
        for name, row in zip(water.absorbers, np.asarray(water.a_components), strict=True):
            own = (net[i] - net[i + 1]) * row / np.asarray(water.a)
            expected[name] = expected.get(name, 0.0) + own
    z, errors = [], []
    for name, value in expected.items():
        own = (found.absorption | found.sinks)[name]
        value = value / incoming.sum()
        stderr = np.hypot(np.asarray(own.stderr), 1e-6 * value)
        z.append((np.asarray(own.value) - value) / stderr)
        errors.append(np.asarray(own.stderr) / value)
    return np.array(z), np.array(errors), float(found.closure)


def orders(amounts, walks):
    """Rows of shares of the second generation, exact and by walks."""
    water = oi.gutierrez2008().iops(amounts, BANDS)
    depths = jnp.asarray([0.0, 10.0, 30.0])
    scene = oi.Scene(water, SUN, SURFACE, inelastic=PROCESSES)
    plain = oi.Scene(water, SUN, SURFACE)
    values = {
        0: oi.irradiance(plain, depths, oi.PlaneParallel(8)),
        1: oi.irradiance(scene, depths, oi.PlaneParallel(8)),
        2: oi.irradiance(scene, depths, oi.PlaneParallel(8, generations=2)),
    }
    bound = float(oi.PlaneParallel(8, generations=2).inelastic_left(scene))
    z = []
    for generations in (1, 2):
        transport = oi.MonteCarlo(walks, 32, generations=generations)
        found = oi.irradiance(scene, depths[:2], transport, key=jax.random.key(1))
        for name in ("Ed", "Eu", "E0"):
            own, exact = getattr(found, name), getattr(values[generations], name)
            z.append((own.value - exact.value[:2]) / own.stderr)
    rows = []
    for name in ("Ed", "Eu"):
        none, one, two = (np.asarray(getattr(values[g], name).value) for g in (0, 1, 2))
        rows.append((name, (one - none) / two, (two - one) / two, (two - one) / (one - none)))
    return rows, bound, np.abs(np.array(z)).max(), np.array(z).size


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    walks = 2 ** (int(sys.argv[1]) if len(sys.argv) > 1 else 15)
    start, every = time.process_time(), []
    print(
        "| scene | numbers | greatest abs(z) | median stderr | closure - 1 |\n|---|---|---|---|---|"
    )
    for name, scene, depths in scenes():
        z, errors, closure = z_of_budget(scene, depths, walks)
        every.append(z.ravel())
        print(
            f"| {name} | {z.size} | {np.abs(z).max():.2f} | {np.median(errors):.2%} | "
            f"{closure - 1:.0e} |",
            flush=True,
        )
    z = np.concatenate(every)
    limit = stats.norm.isf((1 - 0.99 ** (1 / z.size)) / 2)
    print(
        f"\nall {z.size}: greatest abs(z) {np.abs(z).max():.2f}, Sidak limit {limit:.2f}, ", end=""
    )
    print(f"standard deviation {z.std():.2f} (bands share their walks)\n")
    print("| sea | flux | depth, m | inelastic, % | second order, % | of the inelastic, % |")
    print("|---|---|---|---|---|---|")
    for name, amounts in SEAS.items():
        rows, bound, worst, count = orders(amounts, walks)
        for flux, first, second, ratio in rows:
            for i, depth in enumerate((0, 10, 30)):
                print(
                    f"| {name} | {flux} | {depth} | {100 * np.median(first[i]):.2f}, "
                    f"{100 * first[i].max():.1f} | {100 * np.median(second[i]):.4f}, "
                    f"{100 * second[i].max():.3f} | {100 * ratio[i].max():.2f} |"
                )
        print(f"| {name} | bound on all further orders, of the second | | | | {100 * bound:.1f} |")
        print(
            f"| {name} | MonteCarlo: greatest abs(z) of {count} | | | | {worst:.2f} |", flush=True
        )
    print(f"\n2^{int(np.log2(walks))} walks, {time.process_time() - start:.0f} s of CPU")


if __name__ == "__main__":
    main()
