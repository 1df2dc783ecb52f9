"""Fits within a tolerance of 3 % beside those through the full model.

    python -m tests.acceptance.fit_tolerance [profile photo] [STREAMS,ORDERS]

Synthetic data made by `PlaneParallel()` with noise, and the two real samples.  Each is fitted
through the full model (`PlaneParallel()`, unless other dials are given, by which the cheap fit is
then corrected, too) and with tolerance 0.03, twice, so that the second time is without
compilation.  The full model's posterior may have
two modes of nearly the same height: it is searched a second time from where the cheap fit ended,
untimed, and the higher mode counts.  Prints the table and writes
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
    from fitting.files.cast_file import read_cast

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
    from fitting.images.photo_csv import read_photo
    from fitting.photo.forward_model import predict
    from fitting.photo.problem import prepare
    from tests.fitting.photo.test_fit_photo import photo

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


def highest(full, lean):
    """Coordinates of the full model's higher mode, their standard deviations, and by how much |r|^2
    of the mode found from the cheap fit's end lies below that found from the priors' centres."""
    import equinox as eqx

    from fitting.core.least_squares import covariance, least_squares

    @eqx.filter_jit
    def again(problem, start):
        return least_squares(lambda x, p: p.residual(x), start, problem, problem.prior.scale)

    other = again(full.problem, jax.numpy.asarray(lean.x))
    first = float(np.sum(np.asarray(eqx.filter_jit(full.problem.residual)(full.x)) ** 2))
    gain = first - float(np.sum(np.asarray(other.residual) ** 2))
    if gain <= 0.0:
        return np.asarray(full.x), np.sqrt(np.diag(full.covariance)), gain
    return np.asarray(other.x), np.sqrt(np.diag(covariance(other.jacobian))), gain


def row(name: str, fit, data, exact) -> str:
    """One line of the table."""
    lean, cheap = timed(lambda: fit(data, tolerance=TOLERANCE))
    full, dear = timed(lambda: fit(data, transport=exact))
    best, sd, gain = highest(full, lean)

    def shifts(x, sd):
        asked = [i for i, p in enumerate(full.parameters) if not p.nuisance]
        return " / ".join(f"{abs(lean.x[i] - x[i]) / sd[i]:.2f}" for i in asked)

    first = shifts(full.x, np.sqrt(np.diag(full.covariance)))
    plan = lean.plan
    return (
        f"| {name} | {', '.join(plan.tried)} | {100 * plan.predicted_error:.2g} % | "
        f"{shifts(best, sd)} | {first} | {gain:.2g} | {cheap:.2g} | {dear:.2g} | "
        f"{dear / cheap:.1f} | {plan.corrections} | {100 * plan.remaining_error:.1g} % |"
    )


def main():
    jax.config.update("jax_enable_x64", True)
    import fitting.photo.fit_photo
    import fitting.profile.fit_profile
    import oceaninv as oi
    from fitting import fit_photo, fit_profile
    from fitting.core.multifidelity import EXACT
    from oceaninv.fidelity.planning import model_label

    kinds = {"profile": (fit_profile, profiles), "photo": (fit_photo, photographs)}
    dials = [word for word in sys.argv[1:] if word not in kinds]
    exact = oi.PlaneParallel(*(int(n) for n in dials[0].split(","))) if dials else EXACT
    fitting.photo.fit_photo.EXACT = fitting.profile.fit_profile.EXACT = exact
    for kind in [word for word in sys.argv[1:] if word in kinds] or kinds:
        fit, cases = kinds[kind]
        lines = [
            f"# Fits within {100 * TOLERANCE:g} % beside the full model: {kind}\n",
            f"`python -m tests.acceptance.fit_tolerance {' '.join([kind, *dials])}`.  Shifts of "
            "chlorophyll, CDOM and detritus from the higher mode of the full model "
            f"(`{model_label(exact)}`, which corrects the cheap fit, too), and from the mode "
            "that it finds from the priors' centres, in its standard deviations; by how much "
            "|residual|^2 is lower at the mode it finds from the cheap fit's end; processor "
            "seconds of a fit, compilation apart; searches with corrections, and the "
            "error left.\n",
            "| data | tried | predicted error | shift | from the first mode | gain | seconds | "
            "full model | saved, times | searches | error left |",
            "|---|---|---|---|---|---|---|---|---|---|---|",
        ]
        for name, data in cases():
            lines.append(row(name, fit, data, exact))
            print(lines[-1], flush=True)
            report = "\n".join(lines) + "\n"
            Path(__file__).with_name(f"fit_tolerance_{kind}.md").write_text(report)


if __name__ == "__main__":
    from fitting.commands.main import quick_compilation

    quick_compilation()
    main()
