"""Fits within a tolerance of 3 % beside those through the full model.

    python -m tests.acceptance.fit_tolerance [profile photo]

Synthetic data made by the full model (`PlaneParallel()`, the dearest that the command line offers)
with noise, and the two real samples.  Each is fitted through the full model and with tolerance
0.03, twice, so that the second time is without compilation.  Prints the table and writes
fit_tolerance_<kind>.md beside this file.  Seeded; the photographs take ten minutes of one core.
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np

SCENES = Path(__file__).parents[2] / "scenes"
TOLERANCE = 0.03
WATERS = ((0.3, 0.03, 0.02), (3.0, 0.3, 0.15))


def profiles():
    """(name, profile) of each case."""
    import jax.numpy as jnp

    import oceaninv as oi
    from fitting import Profile
    from fitting.casts import read_cast

    wavelength = oi.spectrum.bands(7)
    rng = np.random.default_rng(5)
    for chlorophyll, cdom, detritus in WATERS:
        water = oi.BioOpticalModel().iops(oi.Constituents(chlorophyll, cdom, detritus), wavelength)
        scene = oi.Scene(water, oi.Light(35.0, jnp.ones(len(wavelength))), oi.FlatSurface())
        depth = np.linspace(0.3, 3.0 / float(jnp.min(water.a)) ** 0.7, 30)
        light = np.asarray(oi.irradiance(scene, depth, oi.PlaneParallel()).Ed.value)
        noisy = light * (1.0 + 0.03 * rng.standard_normal(light.shape))
        made = Profile(depth, wavelength, noisy, sigma=0.03 * light, solar_zenith=35.0)
        yield f"synthetic cast, chlorophyll {chlorophyll:g} mg/m3", made
    yield "Argo float 6903247", read_cast(SCENES / "argo_6903247.csv")


def photographs():
    """(name, photo) of each case."""
    import jax.numpy as jnp

    import oceaninv as oi
    from fitting.photo import predict, prepare
    from fitting.readers import read_photo
    from tests.test_photo import photo

    chlorophyll, cdom, detritus = WATERS[1]
    parameters, (readings,), sunlight = prepare([photo()], oi.TwoStream())
    values = {p.name: jnp.asarray(p.centre) for p in parameters}
    values |= {
        "chlorophyll": jnp.asarray(chlorophyll),
        "cdom": jnp.asarray(cdom),
        "detritus": jnp.asarray(detritus),
    }
    seen = np.asarray(predict(values, readings, oi.PlaneParallel(), sunlight))
    noise = np.random.default_rng(6).standard_normal(seen.shape)
    yield f"synthetic charts, chlorophyll {chlorophyll:g} mg/m3", photo(seen * (1 + 0.01 * noise))
    yield "Red Sea charts", read_photo(SCENES / "red_sea_charts.csv", 5.0, 0.4)[0]


def timed(fit):
    """A fit, and the processor seconds of its second run."""
    fit()
    start = time.process_time()
    found = fit()
    return found, time.process_time() - start


def row(name: str, fit, data) -> str:
    """One line of the table."""
    import oceaninv as oi

    full, dear = timed(lambda: fit(data, transport=oi.PlaneParallel()))
    lean, cheap = timed(lambda: fit(data, tolerance=TOLERANCE))
    shifts = []
    for i, parameter in enumerate(full.parameters):
        if not parameter.nuisance:
            shifts.append(f"{abs(lean.x[i] - full.x[i]) / full.sd[parameter.name]:.2f}")
    plan = lean.metadata["plan"]
    return (
        f"| {name} | {', '.join(plan['tried'])} | {100 * plan['predicted_error']:.2g} % | "
        f"{' / '.join(shifts)} | {cheap:.2g} | {dear:.2g} | {dear / cheap:.1f} |"
    )


def main():
    jax.config.update("jax_enable_x64", True)
    from fitting import fit_photo, fit_profile

    kinds = {"profile": (fit_profile, profiles), "photo": (fit_photo, photographs)}
    for kind in sys.argv[1:] or kinds:
        fit, cases = kinds[kind]
        lines = [
            f"# Fits within {100 * TOLERANCE:g} % beside the full model: {kind}\n",
            f"`python -m tests.acceptance.fit_tolerance {kind}`.  Shifts of chlorophyll, CDOM and "
            "detritus from the full model's (`PlaneParallel()`), in its standard deviations; "
            "processor seconds of a fit, compilation apart.\n",
            "| data | tried | predicted error | shift | seconds | full model | saved, times |",
            "|---|---|---|---|---|---|---|",
        ]
        for name, data in cases():
            lines.append(row(name, fit, data))
            print(lines[-1], flush=True)
        report = "\n".join(lines) + "\n"
        Path(__file__).with_name(f"fit_tolerance_{kind}.md").write_text(report)


if __name__ == "__main__":
    from fitting.cli import quick_compilation

    quick_compilation()
    main()
