"""PlaneParallel against the reference fields: the table of its accuracy.

    python -m tests.acceptance.plane_parallel_accuracy [others fluxes mobley radiance]

writes tests/acceptance/plane_parallel_accuracy.md, all of it or the sections that are named; the
first three take some ten minutes on one core, the radiances about as long.
"""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from oceaninv.water.phase import HenyeyGreenstein, Isotropic, Seawater, petzold

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "tests/reference/radiative_transfer.json"
TABLE = ROOT / "tests/acceptance/plane_parallel_accuracy.md"


def scene(case, phase=None):
    """A case without a surface; the wavelength carries no meaning."""
    w, one = float(case["omega"]), jnp.ones(1)
    phase = HenyeyGreenstein(float(case["g"])) if phase is None else phase
    zenith = float(np.degrees(np.arccos(case["mu0"])))
    floor = None
    if case["T"] != "inf":
        floor = oi.Floor(float(case["T"]), one * float(case["rho"]))
    water = oi.IOPs([500.0], one * (1 - w), one * w, phase)
    return oi.Scene(water, oi.Light(jnp.asarray(zenith), one), floor=floor)


def fluxes(cases, streams):
    """Per case, the largest excess: |error| - 1e-6 |value|, over Ed, Eu, E0."""
    rows = []
    for case in cases:
        found = oi.PlaneParallel(streams).fluxes(scene(case), jnp.asarray(case["tau"]))
        excess = [
            np.abs(np.asarray(getattr(found, k))[:, 0] - case[k]) - 1e-6 * np.abs(case[k])
            for k in ("Ed", "Eu", "E0")
        ]
        rows.append([e.max() for e in excess])
    return np.array(rows)


def flux_lines(cases):
    lines = [
        "## Fluxes: largest |error| - 1e-6 |value| for a beam of 1 normal to itself",
        "",
        "| streams | g | cases | Ed | Eu | E0 |",
        "|---|---|---|---|---|---|",
    ]
    for streams in (16, 24, 32, 40, 48):
        found = fluxes(cases, streams)
        for name, chosen in (
            ("<= 0.8", [c["g"] <= 0.8 for c in cases]),
            ("0.924", [c["g"] > 0.8 for c in cases]),
        ):
            worst = found[np.array(chosen)].max(axis=0)
            lines.append(
                f"| {streams} | {name} | {sum(chosen)} | "
                + " | ".join(f"{max(v, 0):.1e}" for v in worst)
                + " |"
            )
            print(lines[-1], flush=True)
    return [*lines, ""]


def sphere_of_views(case):
    """Rays for every (mu, tau, phi) of a reference radiance; the eye looks against the light."""
    mu, tau, phi = (np.asarray(case[k]) for k in ("mu", "tau", "phi_deg"))
    mu, tau, phi = np.meshgrid(mu, tau, np.radians(phi), indexing="ij")
    sine = np.sqrt(1 - mu**2)
    look = np.stack([sine * np.cos(phi), -sine * np.sin(phi), mu], axis=-1)
    origin = np.stack([0 * tau, 0 * tau, tau], axis=-1)
    return oi.Rays(jnp.asarray(origin.reshape(-1, 3)), jnp.asarray(look.reshape(-1, 3)))


def radiance_lines(cases):
    lines = [
        "## Radiance where the reference is flagged reliable: |relative error|",
        "",
        "| g | sun | streams | values | median | 90 % | largest | share within 1e-3 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    kinds = {}
    for case in cases:
        kinds.setdefault((case["g"], case["mu0"] == 1.0), []).append(case)
    for (g, vertical), chosen in sorted(kinds.items()):
        for streams in (16, 32, 48):
            errors = []
            for case in chosen:
                transport = oi.PlaneParallel(streams, 1 if vertical else streams)
                found = transport.radiance(scene(case), sphere_of_views(case)).value
                exact = np.asarray(case["L"])
                reliable = np.asarray(case["reliable"]) > 0
                reliable = reliable.reshape(reliable.shape + (1,) * (3 - reliable.ndim))
                if not vertical:  # the reference varies with azimuth there
                    reliable = reliable & (np.abs(np.asarray(case["mu"])) < 1)[:, None, None]
                good = np.broadcast_to(reliable, exact.shape) & (np.abs(exact) > 1e-10)
                error = np.asarray(found).reshape(exact.shape)[good] / exact[good] - 1
                errors.append(np.abs(error))
            errors = np.concatenate(errors)
            lines.append(
                f"| {g} | {'zenith' if vertical else 'slanted'} | {streams} | {errors.size} | "
                f"{np.median(errors):.1e} | {np.quantile(errors, 0.9):.1e} | {errors.max():.1e} | "
                f"{np.mean(errors <= 1e-3):.3f} |"
            )
            print(lines[-1], flush=True)
    return [*lines, ""]


PUBLISHED = {("1", 0.9): "P1_w0.9", ("2", 0.2): "P2_w0.2"}


def mobley_lines(published):
    """Errors of Ed, E0u and the nadir radiance Lu at few streams, and their places in the
    published spread."""
    lines = [
        "## Mobley et al. 1993, problems 1, 2 and 6: largest error at three depths",
        "",
        "Against the most streams of each problem; the count before it shows how far that has "
        "converged.  Last: distance from the published mean in standard deviations of the seven "
        "models (0.3 % more for its digits).",
        "",
        "| problem | streams | Ed | Eou | Lu | from the published mean: Ed, Eou, Lu |",
        "|---|---|---|---|---|---|",
    ]
    for name, albedos, phase, bottom, counts in (
        ("1", (0.9, 0.2), Seawater(1.0), None, (8, 12, 16, 48, 64)),
        ("2", (0.9, 0.2), petzold(), None, (16, 24, 32, 48, 96, 128)),
        ("6", (0.2,), petzold(), 5.0, (16, 24, 32, 48, 96, 128)),
    ):
        # The albedos are the wavelengths of one scene.
        one, w = jnp.ones(len(albedos)), jnp.asarray(albedos)
        floor = None if bottom is None else oi.Floor(bottom, 0.5 * one)
        water = oi.IOPs(500.0 + np.arange(len(albedos)), 1 - w, w, phase)
        given = oi.Scene(water, oi.Light(60.0, one), oi.FlatSurface(1.34), floor)
        z = np.array([1.0, 5.0, 10.0] if bottom is None else [1.0, 2.5, 5.0])
        down = oi.Rays(jnp.asarray(z[:, None] * np.eye(3)[2]), jnp.asarray(np.eye(3)[[2, 2, 2]]))

        def solve(streams, given=given, z=z, down=down):
            transport = oi.PlaneParallel(streams, 1)  # straight up and down no azimuth is left
            f, look = transport.fluxes(given, jnp.asarray(z)), transport.radiance(given, down)
            return np.array([f.Ed, f.E0u, look.value])

        solved = {streams: solve(streams) for streams in counts}
        for streams in counts[:-1]:
            errors = np.abs(solved[streams] / solved[counts[-1]] - 1).max(axis=1)
            for i, albedo in enumerate(albedos):
                row = [f"{e:.1e}" for e in errors[:, i]]
                known = published.get(PUBLISHED.get((name, albedo), ""))
                place = ""
                if known is not None:
                    off = [
                        np.abs(found / np.asarray(known[key]) - 1)
                        / (np.asarray(known[f"{key}_cv"]) + 3e-3)
                        for key, found in zip(
                            ("Ed", "Eou", "Lu"), solved[streams][:, :, i], strict=True
                        )
                    ]
                    place = ", ".join(f"{o.max():.1f}" for o in off)
                lines.append(f"| {name}, w {albedo} | {streams} | {' | '.join(row)} | {place} |")
                print(lines[-1], flush=True)
    return [*lines, ""]


def other_lines(analytic):
    lines = ["## Others", "", "| what | error |", "|---|---|"]
    worst = []
    for case in analytic["chandrasekhar"]:
        given = scene(case | {"g": 0.0, "T": "inf"}, Isotropic())
        found = oi.PlaneParallel(48).fluxes(given, jnp.zeros(1)).Eu[0, 0] / case["mu0"]
        worst.append(abs(float(found) / case["albedo"] - 1))
    lines.append(f"| Chandrasekhar's albedo of endless water, 48 streams | {max(worst):.1e} |")
    for moments in (128,):
        errors = []
        for case in analytic["asymptotic_K_over_c"]:
            one, w = jnp.ones(1), case["omega"]
            water = oi.IOPs([500.0], (1 - w) * one, w * one, HenyeyGreenstein(float(case["g"])))
            value = float(oi.apparent.kd_asymptotic(water, moments)[0])
            errors.append((abs(value / case["K_over_c"] - 1), w, case["rel_change"]))
        high = max(e for e, w, _ in errors if w > 0.5)
        low = max(e for e, w, _ in errors if w <= 0.5)
        change = max(r for _, w, r in errors if w <= 0.5)
        lines.append(
            f"| K/c, {moments} moments: w > 0.5, w <= 0.5 (the reference moves by {change:.0e} "
            f"there) | {high:.1e}, {low:.1e} |"
        )
    given = scene({"omega": 1.0, "g": 0.8, "mu0": 0.5, "T": 10.0, "rho": 1.0})
    f = oi.PlaneParallel(16).fluxes(given, jnp.linspace(0.0, 10.0, 5))
    lines.append(
        f"| conservative slab over a white floor: net flux | "
        f"{float(jnp.abs(f.Ed - f.Eu).max()):.1e} |"
    )
    print(*lines, sep="\n", flush=True)
    return [*lines, ""]


def main(*names):
    reference = json.loads(REFERENCE.read_text())
    sections = {
        "others": lambda: other_lines(reference["analytic"]),
        "fluxes": lambda: flux_lines(reference["flux"]["cases"]),
        "mobley": lambda: mobley_lines(reference["mobley1993"]["published"]),
        "radiance": lambda: radiance_lines(reference["radiance"]["cases"]),
    }
    for name in names or sections:
        found = sections[name]()
        # Sections that are not named stay as they are.
        text = TABLE.read_text(encoding="utf-8") if TABLE.exists() else ""
        kept = {part.split("\n", 1)[0]: part for part in text.split("\n## ")[1:]}
        own = "\n".join(found).removeprefix("## ").rstrip()
        kept[own.split("\n", 1)[0]] = own
        head = "Written by `python -m tests.acceptance.plane_parallel_accuracy`.\n"
        body = "".join(f"\n## {part.rstrip()}\n" for part in kept.values())
        TABLE.write_text(head + body, encoding="utf-8")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(*sys.argv[1:])
