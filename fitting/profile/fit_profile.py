"""Depth profiles of irradiance to Kd(wl), and to constituents."""

from typing import Any

import jax
import numpy as np

import oceaninv as oi
from fitting.core.diagnostics import Status
from fitting.core.least_squares import check_solver
from fitting.core.multifidelity import EXACT, AccuracyTarget, corrected_fit, multifidelity_fit
from fitting.core.parameters import Log, Parameter, Parameters
from fitting.core.result import Fit
from fitting.observations.profile import Profile
from fitting.profile.constituents.fit_waters import unmodelled_notes
from fitting.profile.constituents.problem import (
    CastProblem,
    Samples,
    describe_cast,
    lights,
    solve_cast,
)
from fitting.profile.fit_profiles import fit_profiles
from fitting.profile.kd.band_fit import BandFit
from fitting.profile.kd.batching import fit_windows
from fitting.profile.kd.cast import Cast, FitWindow, cast_of, light_of, padded_length
from fitting.profile.kd.result import (
    band_model,
    check_light_falls,
    kd_fit,
    metadata_of,
    noise_sd,
    predictive_of,
    used_samples,
)
from fitting.profile.kd.ways import sample_deviations
from fitting.water_model.layered_water import (
    check_layers,
    interfaces_of,
    layer_units,
    layer_unknowns,
    roundings,
)
from fitting.water_model.quantities import UNITS, quantities_of
from fitting.water_model.scene_of_fit import scene_at
from fitting.water_model.unknowns import modelled_bands, water_unknowns
from oceaninv.fidelity.planning import model_label
from oceaninv.foundation.argument_names import names_checked
from oceaninv.foundation.double_precision import in_double_precision
from oceaninv.transport.base import AbstractTransport, check_transport


@names_checked
@in_double_precision
def fit_profile(
    profile: Profile,
    *,
    transport: AbstractTransport | None = None,
    priors: dict[str, Parameter] | None = None,
    depth_range: tuple[float, float] | None = None,
    layers: int | None = 1,
    tolerance: float | None = None,
    solver: Any = None,
) -> Fit:
    """Fit a depth profile of irradiance.

    **Arguments:**

    - `profile`: the cast.
    - `transport`: `None` fits one Kd and Ed(0-) per band, with no model of the water.  A
      transport (`oceaninv.TwoStream()`) fits chlorophyll, CDOM and detritus to all bands
      together through it; Ed(0-) of each band stays free, so that the sun's spectrum and the
      sensor's calibration do not matter.  Where the profile holds a and c, those and R count too.
    - `priors`: parameters to exchange by name, for instance a known CDOM:
      `{"cdom": Parameter("cdom", 0.12, 0.1)}`.
    - `depth_range`: (low, high) metres; by default each band is used from the surface to the
      depth where its light has fallen to 10 %.
    - `layers`: how many layers of constant Kd; None lets the Bayes information criterion choose
      up to four.  Their interfaces stand in `metadata["interfaces_m"]`, the parameters are
      "Kd_<nm>_1" and so on downwards, and the quantity "Kd" is the mean over the depths that were
      used.  With `oceaninv.PlaneParallel()` as the transport each layer has its own constituents,
      "chlorophyll_1" and so on, and the search goes on to move the interfaces
      ("thickness_1", ...); shapes of optical properties are those of all layers.
    - `tolerance`: instead of a transport, the largest relative error of Ed that it may bring: the
      cheapest that is good enough for the water found is taken, see `oceaninv.plan`, and what it
      gets wrong there is corrected by one to three looks at the exact light; which, its predicted
      error and the correction stand in `Fit.plan`.
    - `solver`: of the search for constituents: an `optimistix.AbstractLeastSquaresSolver` or an
      `optimistix.AbstractMinimiser`, as `optimistix.BFGS(rtol=1e-6, atol=1e-6)`, or
      `fitting.core.jaxopt_solver.BoundedSolver()`; Levenberg-Marquardt unless given.  Compiled
      programs of other solvers are not stored between processes.

    **Returns** a `Fit` with the quantity "Kd" at the profile's wavelengths (which mean it is
    stands in `metadata["kd_definition"]`).  Without a transport also Ed(0-); where the profile
    holds them, of Eu Ku, Eu(0-) and R, of Lu KLu, Lu(0-), Rrs and nLw; with PAR or bands that span
    it the depths Z_10 and Z_eu of 10 and 1 % of it.  With a transport also Kd(490), c(550),
    bb(550) and a_cdm(440) of the water, from the bands of 380-780 nm, in which all absorption is
    tabulated; other bands are left out and named in `metadata["bands_not_modelled_nm"]`.
    """
    _check_arguments(profile, transport, priors, layers, tolerance, solver)
    if tolerance is None and transport is None:
        return _fit_kd(cast_of(profile, depth_range, layers))
    if len(profile.beam_wavelength):
        options = {"depth_range": depth_range, "transport": transport, "priors": priors}
        return fit_profiles([profile], **options).water(0)
    bands = modelled_bands(profile.wavelength)
    notes = unmodelled_notes(profile.wavelength, bands)
    cast = cast_of(profile if bands.all() else profile.of_bands(bands), depth_range, layers)
    if tolerance is not None:
        return _fit_within_tolerance(cast, tolerance, transport, priors, notes, solver)
    assert transport is not None
    return _fit_constituents(cast, transport, priors, notes, solver)


def _check_arguments(profile: Profile, transport, priors, layers, tolerance, solver) -> None:
    """ValueError where arguments of `fit_profile` contradict each other."""
    check_solver(solver)
    if transport is not None:
        check_transport(transport)
    if layers != 1:
        if tolerance is not None:
            raise ValueError("a tolerance chooses among models of one water: leave out layers.")
        if transport is not None:
            check_layers(transport)
    if transport is None and tolerance is None and priors:
        raise ValueError("priors apply to a fit through a transport; Kd alone has none.")
    if transport is None and tolerance is None and solver is not None:
        raise ValueError("a solver applies to a fit through a transport; Kd alone has its own.")
    if len(profile.beam_wavelength):
        if tolerance is not None:
            raise ValueError(
                "a and c are fitted through a transport that is named, not a tolerance."
            )
        if transport is not None and layers != 1:
            raise ValueError("a and c are fitted to one water: leave them or the layers out.")
        if solver is not None:
            raise ValueError("a and c are fitted by a batched search: leave out the solver.")


def _fit_kd(cast: Cast) -> Fit:
    kinds = list(cast.windows)
    fits = dict(zip(kinds, map(_fit_window, cast.windows.values()), strict=True))
    check_light_falls(cast, fits["Ed"])
    return kd_fit(cast, fits)


def _fit_window(window: FitWindow) -> BandFit:
    return fit_windows([window])[0]


def _fit_constituents(cast: Cast, transport: AbstractTransport, priors, notes, solver) -> Fit:
    bands = _fit_window(cast.window)
    check_light_falls(cast, bands)
    metadata = metadata_of(cast, bands) | {"transport": type(transport).__name__} | notes
    return _constituent_fit(cast, bands, transport, priors, metadata, solver=solver)


def _fit_within_tolerance(cast: Cast, tolerance: float, transport, priors, notes, solver) -> Fit:
    """The fit by the cheapest model that meets the tolerance, corrected by the exact one."""
    profile, bands = cast.window.profile, _fit_window(cast.window)
    check_light_falls(cast, bands)

    def solve(model, start, ratio=None):
        metadata = metadata_of(cast, bands) | {"transport": type(model).__name__} | notes
        return _constituent_fit(cast, bands, model, priors, metadata, start, ratio, solver)

    def scene(fit):
        return scene_at(fit.parameters, fit.x, profile.wavelength)

    targets = [AccuracyTarget("irradiance")]
    fit, chosen = multifidelity_fit(tolerance, transport, solve, scene, targets)
    return _corrected(fit, chosen, solve, profile)


def _unknowns(window: FitWindow, bands: BandFit, priors) -> Parameters:
    profile, surface = window.profile, np.exp(bands.x[:, 0])
    zenith, layers = profile.solar_zenith, window.interfaces.tolist()
    parameters = Parameters(
        [
            *(layer_unknowns(layers, zenith) if layers else water_unknowns(zenith)),
            *(
                Parameter(f"Ed0_{wl:g}", float(e), None, Log(), "W m-2 nm-1", True, "Ed0",
                          wavelength=float(wl))
                for wl, e in zip(profile.wavelength, surface, strict=True)
            ),
        ]
    )  # fmt: skip
    return parameters.replace(priors or {})


def _corrected(fit: Fit, transport: AbstractTransport, solve, profile: Profile) -> Fit:
    """`fitting.core.multifidelity.corrected_fit` by the light at the profile's depths."""
    if model_label(transport) == model_label(oi.PlaneParallel(EXACT.streams, 1)):
        return fit
    layout, grid = fit.parameters.layout(), tuple(profile.wavelength.tolist())
    count = len(profile.depth)
    depth = jax.device_put(np.pad(profile.depth, (0, padded_length(count) - count)))

    def evaluate(x):
        cheap, true = lights(layout, grid, (transport, EXACT), jax.device_put(x), depth)
        ratio = np.where(np.asarray(cheap) > 0, np.asarray(true) / np.asarray(cheap), 1.0)
        return ratio, float(np.max(np.abs(ratio[:count] - 1.0)))

    return corrected_fit(fit, EXACT, evaluate, lambda x, ratio: solve(transport, x, ratio))


def _constituent_fit(
    cast: Cast, bands, transport, priors, metadata, start=None, ratio=None, solver=None
) -> Fit:
    profile, interfaces = cast.window.profile, cast.window.interfaces
    mask = used_samples(cast.window, bands)
    parameters = _unknowns(cast.window, bands, priors)
    model = band_model(profile, bands.x, interfaces)
    extra = padded_length(len(profile.depth)) - len(profile.depth)

    def pad(array, fill):
        widths = [(0, extra)] + [(0, 0)] * (array.ndim - 1)
        return jax.device_put(np.pad(array, widths, constant_values=fill))

    # The model knows neither darkness nor changes of the sun: the data are rid of them.
    light = light_of(profile)
    reference = 1.0 if profile.reference is None else profile.reference
    sd = noise_sd(profile, bands, model) / reference
    relative = sd / np.maximum(model / reference, 1e-300)
    sd = sd * sample_deviations(profile.depth, profile.segment, mask, relative, bands)
    samples = Samples(
        pad(profile.depth, 0.0),
        pad(np.where(mask, light, 1.0), 1.0),
        pad(np.where(mask, sd, 1.0), 1.0),
        pad(mask, False),
        pad(np.ones_like(light), 1.0) if ratio is None else jax.device_put(ratio),
    )
    reach, rounding, units = None, None, UNITS
    if len(interfaces):
        rounding = jax.device_put(roundings(interfaces, profile.depth))
        deepest = np.array([profile.depth[m].max() for m in mask.T])
        reach, units = jax.device_put(deepest), layer_units(len(interfaces) + 1)
    prior, grid = parameters.prior(), tuple(profile.wavelength.tolist())
    start = prior.centre if start is None else jax.device_put(start)
    problem = CastProblem(parameters.layout(), grid, transport, prior, samples, reach, rounding)
    describe_cast.prepare(problem, start)
    optimum, cov, fitted = solve_cast(problem, start, solver)
    values, slopes = describe_cast(problem, optimum.x)
    cov = np.asarray(cov)
    quantities, sensitivity = quantities_of(values, slopes, parameters, cov, units=units)
    if len(interfaces):
        moved = interfaces_of(parameters, np.asarray(optimum.x))
        metadata = metadata | {"interfaces_m": moved, "kd_definition": units["Kd"][1]}
    return Fit(
        parameters,
        np.asarray(optimum.x),
        cov,
        quantities,
        profile.wavelength,
        Status(int(optimum.code)),
        predictive_of(profile, mask, bands, np.asarray(fitted)[: len(profile.depth)]),
        metadata,
        sensitivity=sensitivity,
        problem=problem,
    )
