"""Constituents of layers: what the unknowns mean; a fit finds two waters and their edge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import oceaninv as oi
from fitting import NUTS, Fit, Parameter, Profile, fit_profile, sample
from fitting.commands import main as cli
from fitting.core.parameters import Log, Parameters
from fitting.profile.constituents.problem import model_ed
from fitting.profile.kd.noise_statistics import correlation_inflation
from fitting.water_model.layered_water import (
    interfaces_of,
    layer_unknowns,
    layers_of,
    roundings,
    water_of,
)
from fitting.water_model.unknowns import water_iops, water_unknowns

BANDS = np.array([412.0, 443.0, 490.0, 555.0, 620.0, 665.0])
DEPTH = np.linspace(0.2, 15.0, 60)
LAYOUT = Parameters(layer_unknowns([5.0], 40.0))
TRUTH = {"chlorophyll_1": 0.8, "cdom_1": 0.05, "detritus_1": 0.03, "thickness_1": 6.0,
         "chlorophyll_2": 2.4, "cdom_2": 0.16, "detritus_2": 0.08}  # fmt: skip


def coordinates(truth) -> np.ndarray:
    return np.array([p.transform.coordinate(truth.get(p.name, p.centre)) for p in LAYOUT])


def light(truth, transport) -> np.ndarray:
    water = layers_of(LAYOUT.values(jnp.asarray(coordinates(truth))), BANDS)
    scene = oi.Scene(water, oi.Light(40.0, jnp.ones(len(BANDS))), oi.FlatSurface())
    return np.asarray(oi.irradiance(scene, DEPTH, transport).Ed.value)


def test_unknowns_of_layers_make_layers():
    names = LAYOUT.names
    assert names[:7] == (*(f"{n}_{i}" for i in (1, 2) for n in ("chlorophyll", "cdom", "detritus")),
                         "thickness_1")  # fmt: skip
    x = coordinates(TRUTH)
    assert interfaces_of(LAYOUT, x) == pytest.approx([6.0])
    three = Parameters(layer_unknowns([5.0, 9.0], 40.0))
    assert interfaces_of(three, np.asarray(three.prior().centre)) == pytest.approx([5.0, 9.0])
    values = LAYOUT.values(jnp.asarray(x))
    water = water_of(values, BANDS)
    assert isinstance(water, oi.Layers)
    for i, layer in enumerate(water.iops, start=1):
        own = {n: jnp.asarray(TRUTH[f"{n}_{i}"]) for n in ("chlorophyll", "cdom", "detritus")}
        np.testing.assert_allclose(layer.a, water_iops({**values, **own}, BANDS).a, rtol=1e-12)
    stretched = layers_of({**values, "kd_model_error": jnp.asarray(0.1)}, BANDS)
    assert float(stretched.interfaces[0]) == pytest.approx(6.6)
    one = Parameters(water_unknowns(40.0))
    assert isinstance(water_of(one.values(one.prior().centre), BANDS), oi.IOPs)


def test_layers_that_cannot_be_fitted_are_sentences():
    cast = Profile(DEPTH, BANDS, np.exp(-0.1 * DEPTH)[:, None] * np.ones(len(BANDS)))
    with pytest.raises(ValueError, match="TwoStream models one homogeneous water"):
        fit_profile(cast, transport=oi.TwoStream(), layers=2)
    with pytest.raises(ValueError, match="a tolerance chooses among models of one water"):
        fit_profile(cast, tolerance=0.1, layers=None)
    beams = np.ones((len(DEPTH), 2))
    both = Profile(DEPTH, BANDS, cast.Ed, beam_wavelength=[440.0, 550.0], a=beams)
    with pytest.raises(ValueError, match="a and c are fitted to one water"):
        fit_profile(both, transport=oi.PlaneParallel(), layers=2)


def test_an_interface_that_meets_a_sample_leaves_no_crease():
    grid, met, x = tuple(BANDS.tolist()), DEPTH[24], jnp.asarray(coordinates(TRUTH))
    at = LAYOUT.names.index("thickness_1")

    @jax.jit
    def both(thickness, rounding):
        def model(log):
            moved = jnp.concatenate([x.at[at].set(log), jnp.zeros(len(BANDS))])
            return jnp.log(model_ed(full, grid, oi.PlaneParallel(4), moved, DEPTH, rounding))

        return jax.jvp(model, (jnp.log(thickness),), (jnp.ones(()),))

    surface = [Parameter(f"Ed0_{wl:g}", 1.0, None, Log(), "", True) for wl in grid]
    full = Parameters([*LAYOUT, *surface])
    slopes = {}
    for half in (1e-9, 0.1255):
        sides = [both(met + side, jnp.array([half])) for side in (-1e-4, 1e-4)]
        (value, _), (other, _) = sides
        np.testing.assert_allclose(value, other, atol=1e-4)
        slopes[half] = [np.asarray(slope)[24, 0] for _, slope in sides]
        plain, _ = both(met + 0.06, jnp.array([1e-9]))
        rounded, _ = both(met + 0.06, jnp.array([half]))
        # Samples further than the half-width away see nothing of it.
        np.testing.assert_allclose(
            np.delete(rounded, [24, 25], axis=0), np.delete(plain, [24, 25], axis=0), atol=1e-12
        )
    # One side of the crease against the other; rounded, the slope moves by its curvature alone.
    assert abs(slopes[1e-9][1] - slopes[1e-9][0]) > 0.3
    assert abs(slopes[0.1255][1] - slopes[0.1255][0]) < 0.004


def test_interfaces_are_rounded_by_the_steps_about_them():
    depth = np.array([0.1, 0.3, 1.0, 2.0, 2.0, 2.0, 2.0, 2.4, 2.8])
    edges = np.array([0.2, 1.5, 2.0, 2.6])
    np.testing.assert_allclose(roundings(edges, depth), [0.35, 0.5, 0.5, 0.2])


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_correlated_samples_are_worth_fewer(rho):
    depth = np.arange(2000.0)
    length = np.array([-1.0 / np.log(rho) if rho else 0.0])
    factor = correlation_inflation(depth, np.ones((2000, 1), bool), length)[:, 0]
    apart = np.abs(depth[:, None] - depth[None, :])
    noise = rho**apart if rho else np.eye(2000)
    told = np.ones(2000) @ np.linalg.solve(noise, np.ones(2000))
    assert np.sum(factor**-2.0) == pytest.approx(told, rel=0.01)


def test_what_lies_between_used_samples_counts():
    depth, mask = np.arange(10.0), np.ones((10, 1), bool)
    mask[1::2] = False
    factor = correlation_inflation(depth, mask, np.array([1.0]))
    rho = np.exp(-2.0)
    assert factor[4, 0] == pytest.approx(np.sqrt((1 + rho) / (1 - rho)))
    assert factor[0, 0] == 1.0


@pytest.fixture(scope="module")
def fitted() -> Fit:
    clean = light(TRUTH, oi.PlaneParallel(8))
    seen = clean * (1.0 + 0.02 * np.random.default_rng(1).standard_normal(clean.shape))
    cast = Profile(DEPTH, BANDS, seen, sigma=0.02 * clean, solar_zenith=40.0)
    return fit_profile(cast, transport=oi.PlaneParallel(4), layers=2, depth_range=(0.0, 15.0))


@pytest.mark.slow
def test_two_waters_and_their_edge_are_found(fitted):
    assert fitted.converged
    for name, value in TRUTH.items():
        low, high = fitted.interval(name)
        assert low < value < high, name
    assert fitted.metadata["interfaces_m"] == pytest.approx([6.0], abs=0.3)
    assert fitted.sd["thickness_1"] < 0.05
    for i in (1, 2):
        water = oi.BioOpticalModel().iops(
            oi.Constituents(**{n: TRUTH[f"{n}_{i}"] for n in ("chlorophyll", "cdom", "detritus")}),
            np.array([440.0, 550.0]),
        )
        row = dict(zip(water.absorbers, water.a_components, strict=True))
        low, high = fitted.quantities[f"a_cdm_440_{i}"].interval()
        assert low < float((row["cdom"] + row["detritus"])[0]) < high
    # The mean of each layer, from the light itself.
    Ed, at = light(TRUTH, oi.PlaneParallel(8))[:, 2], DEPTH > 6.0
    lower = np.log(Ed[at][0] / Ed[at][-1]) / (DEPTH[at][-1] - DEPTH[at][0])
    assert fitted.quantities["Kd_490_2"].value == pytest.approx(lower, rel=0.02)
    seen = fitted.posterior_predictive
    left = (seen.observed - seen.predicted) / seen.sd
    assert 0.85 < np.sqrt(np.nanmean(left**2)) < 1.1


@pytest.mark.slow
def test_a_casts_posterior_can_be_drawn_from():
    clean = np.asarray(
        oi.irradiance(
            oi.Scene(
                oi.BioOpticalModel().iops(oi.Constituents(1.0, 0.1, 0.05), BANDS),
                oi.Light(40.0, jnp.ones(len(BANDS))),
                oi.FlatSurface(),
            ),
            DEPTH[::4],
        ).Ed.value
    )
    seen = clean * (1.0 + 0.03 * np.random.default_rng(0).standard_normal(clean.shape))
    cast = Profile(DEPTH[::4], BANDS, seen, sigma=0.03 * clean, solar_zenith=40.0)
    # Where little is known the posterior is long, and takes thousands of draws.
    known = {n: Parameter(n, v, 0.1) for n, v in (("cdom", 0.1), ("detritus", 0.05))}
    fit = fit_profile(cast, transport=oi.TwoStream(), depth_range=(0.0, 15.0), priors=known)
    drawn = sample(fit, key=jax.random.key(1), sampler=NUTS(draws=400, warm=100, chains=4))
    assert drawn.sampling.largest_split_rhat < 1.2
    # Kd is well known: the ellipsoid is right about it, and the draws must agree.
    kd, by_draws = fit.quantities["Kd_490"], drawn.quantities["Kd_490"]
    effective = drawn.sampling.effective_draws
    assert effective > 20
    off = float(np.log(by_draws.value / kd.value)) / float(kd.sd)
    assert abs(off) < 4 / np.sqrt(effective)
    assert abs(float(by_draws.sd / kd.sd) - 1) < 4 / np.sqrt(2 * effective)
    assert drawn.interval("chlorophyll")[0] < 1.0 < drawn.interval("chlorophyll")[1]


@pytest.mark.slow
def test_the_command_fits_layers(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Ed = light(TRUTH, oi.PlaneParallel(8))
    rows = ["# Ed in W m-2 nm-1", "depth_m," + ",".join(f"Ed_{wl:g}" for wl in BANDS)]
    rows += [",".join(f"{v:.9g}" for v in (z, *row)) for z, row in zip(DEPTH, Ed, strict=True)]
    (tmp_path / "cast.csv").write_text("\n".join(rows) + "\n")
    asked = ["fit-profile", "cast.csv", "--layers", "2", "--constituents", "--to", "15"]
    assert cli.run([*asked, "--solar-zenith", "40"]) == 0
    assert "chlorophyll_2" in capsys.readouterr().out
    with xr.open_dataset(tmp_path / "cast_fit.nc", group="constituents") as data:
        names = [str(name) for name in data.parameter.values]
        assert {"chlorophyll_1", "thickness_1"} <= set(names)
