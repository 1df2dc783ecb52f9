"""Constituents of many casts at once: the reduction of a cast, and the same answers as alone."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

import oceaninv as oi
from fitting import Profile, fit_apparent, fit_profile, fit_profiles, stream_profiles
from fitting.core.parameters import Parameter, Parameters
from fitting.profile.constituents.batched_search import Water, _rows, curve, nodes_and_basis
from fitting.profile.constituents.from_kd_and_r import _WORTH, _spectra, _weighed
from fitting.profile.constituents.reduced_data import spectra_of
from fitting.profile.kd.batching import fit_windows
from fitting.profile.kd.cast import cast_of
from fitting.water_model.unknowns import absorption_shapes, water_iops, water_unknowns

BANDS = np.array([412.0, 490.0, 555.0, 665.0])
TRUTH = {"chlorophyll": 1.2, "cdom": 0.12, "detritus": 0.05}


def light(bands=BANDS, depth=None):
    """Ed and Eu of a known water."""
    depth = np.linspace(0.3, 12.0, 30) if depth is None else depth
    water = oi.BioOpticalModel().iops(oi.Constituents(**TRUTH), bands)
    scene = oi.Scene(water, oi.Light(35.0, jnp.ones(len(bands))), oi.FlatSurface())
    field = oi.irradiance(scene, depth)
    return depth, np.asarray(field.Ed.value), np.asarray(field.Eu.value)


def cast(seed=0, bands=BANDS, up=False):
    depth, Ed, Eu = light(bands)
    rng = np.random.default_rng(seed)
    seen = [c * (1 + 0.03 * rng.standard_normal(c.shape)) for c in (Ed, Eu)]
    return Profile(
        depth,
        bands,
        seen[0],
        sigma=0.03 * Ed,
        solar_zenith=35.0,
        Eu=seen[1] if up else None,
        source=f"cast {seed}",
    )


def test_a_few_depths_hold_the_curve():
    layout = Parameters(water_unknowns(35.0))
    x = jnp.asarray([p.transform.coordinate(p.centre) for p in layout])
    depth = np.linspace(0.1, 40.0, 57)
    nodes, basis = nodes_and_basis(depth, 40.0)
    assert nodes[0] == 0.0
    np.testing.assert_allclose(basis.sum(axis=1), 1.0, rtol=1e-12)
    grid = tuple(BANDS.tolist())
    at_nodes, _ = curve(layout.values(x), grid, oi.TwoStream(), jnp.asarray(nodes))
    # Depth 0 is where the curve is 0.
    exact, _ = curve(
        layout.values(x), grid, oi.TwoStream(), jnp.concatenate([jnp.zeros(1), jnp.asarray(depth)])
    )
    # Measured: 1.3e-4 at 665 nm, where the curve goes down to -14; 2e-7 elsewhere.
    found = basis @ np.asarray(at_nodes)
    np.testing.assert_allclose(found, exact[1:], rtol=0.0, atol=2e-4)
    np.testing.assert_allclose(found[:, :3], exact[1:, :3], rtol=0.0, atol=1e-6)
    hit = nodes_and_basis(nodes, 40.0)[1]
    np.testing.assert_allclose(hit, np.eye(len(nodes)), atol=1e-9)


def test_the_triangles_hold_all_that_samples_say():
    made = cast_of(cast(), None, 1)
    data = spectra_of(made, {"Ed": fit_windows([made.window])[0]}, oi.TwoStream())
    rows = np.asarray(_rows(jax.device_put(data), jnp.asarray(data.start)))
    rng = np.random.default_rng(0)
    shift = rng.standard_normal(data.basis.shape[1])
    for band in range(len(BANDS)):
        weight = np.where(data.used, data.start / data.sd, 0.0)[:, band]
        target = np.log(data.start) + (data.light - data.start) / data.start
        unknown = np.concatenate([[0.3], shift, [-1.0]])
        design = np.concatenate(
            [np.ones((len(weight), 1)), data.basis, target[:, band : band + 1]], axis=1
        )
        left = weight * (design @ unknown)
        assert np.sum((rows[band] @ unknown) ** 2) == pytest.approx(np.sum(left**2), rel=1e-9)


def test_bad_spectra_are_sentences():
    good = np.full((2, 4), 0.1)
    cases: tuple[tuple[dict, str], ...] = (
        ({"Kd": good[:, :3]}, r"Kd must have shape \(station, 4\)"),
        ({"R": good[:1]}, "R must have the shape of Kd"),
        ({"Kd": np.where(np.arange(2)[:, None] == 1, np.nan, good)}, "station 1 holds no positive"),
    )
    for change, words in cases:
        with pytest.raises(ValueError, match=words):
            fit_apparent(BANDS, change.get("Kd", good), change.get("R"), transport=oi.TwoStream())
    with pytest.raises(ValueError, match="priors apply to a fit through a transport"):
        fit_profiles([cast()], priors={"cdom": Parameter("cdom", 0.1, 0.1)})
    with pytest.raises(ValueError, match="give fit_profiles a transport"):
        fit_profiles([cast()]).water(0)


def test_streams_are_the_same_as_one_call():
    many = [cast(seed) for seed in range(5)]
    whole = fit_profiles(many).to_xarray()
    parts = list(stream_profiles(iter(many), group=2))
    assert [part.sizes["cast"] for part in parts] == [2, 2, 1]
    together = np.concatenate([part.Kd for part in parts])
    np.testing.assert_allclose(together, whole.Kd, rtol=1e-12)


@pytest.mark.slow
def test_a_water_is_the_same_alone_and_in_a_batch():
    bands = oi.spectrum.bands(8)
    many = [cast(seed, bands) for seed in range(3)]
    fits = fit_profiles(many, transport=oi.TwoStream())
    alone = fit_profile(many[0], transport=oi.TwoStream())
    water = fits.water(0)
    count = len(water.parameters)
    assert water.parameters.names == alone.parameters.names[:count]
    sd = np.sqrt(np.diag(alone.covariance))[:count]
    # Measured: 3e-4 of a standard deviation; of the deviations themselves 1e-4.
    np.testing.assert_allclose((water.x - alone.x[:count]) / sd, 0.0, atol=2e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(water.covariance)), sd, rtol=1e-3)
    np.testing.assert_allclose(
        water.quantities["c_550"].value, alone.quantities["c_550"].value, rtol=1e-3
    )
    data = fits.to_xarray()
    np.testing.assert_allclose(data.chlorophyll[0], water.value["chlorophyll"])
    np.testing.assert_allclose(data.chlorophyll_high[0], water.interval("chlorophyll")[1])
    order = fit_profiles(many[::-1], transport=oi.TwoStream())
    np.testing.assert_allclose(order.water(2).x, water.x, atol=1e-9)

    # Threads, as of a cluster's worker: they would hang if their programs ran at the same time.
    def fit():
        for _ in range(5):
            found.append(fit_profiles(many, transport=oi.TwoStream()).water(0).x)

    found = []
    threads = [threading.Thread(target=fit, daemon=True) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60.0)
    assert len(found) == 20
    np.testing.assert_allclose(found, np.broadcast_to(water.x, (20, count)), atol=1e-9)


def test_bands_beyond_the_tables_leave_the_others_as_they_are():
    """305 and 790 nm change nothing about the constituents and are named; their Kd is there."""
    inside = cast(up=True)
    wide = np.array([305.0, *BANDS, 790.0])

    def with_ends(table):
        return np.column_stack([table[:, 0], table, table[:, -1]])

    outside = Profile(
        inside.depth,
        wide,
        with_ends(inside.Ed),
        sigma=with_ends(inside.sigma),
        solar_zenith=35.0,
        Eu=with_ends(inside.Eu),
    )
    fits = fit_profiles([inside, outside], transport=oi.TwoStream())
    plain, other = fits.water(0), fits.water(1)
    assert other.metadata["bands_not_modelled_nm"] == [305.0, 790.0]
    assert "bands_not_modelled_nm" not in plain.metadata
    np.testing.assert_allclose(other.x, plain.x, atol=1e-6)
    np.testing.assert_array_equal(other.wavelength, BANDS)
    assert fits[1].quantities["Kd"].value.shape == (6,)
    # A cast without any such band keeps its Kd, and does not keep others from their water.
    alone = fit_profiles([outside.of_bands(wide < 400), inside], transport=oi.TwoStream())
    with pytest.raises(ValueError, match=r"305 nm\.  Kd alone can be fitted"):
        alone.water(0)
    np.testing.assert_allclose(alone[0].quantities["Kd"].value, fits[1].quantities["Kd"].value[0])
    np.testing.assert_allclose(alone.water(1).x, plain.x, atol=1e-6)
    assert "Kd alone" in alone.content()[0]["failure"][1][0]


@pytest.mark.slow
def test_reflectance_fixes_backscatter():
    plain = fit_profiles([cast()], transport=oi.TwoStream()).water(0)
    both = fit_profiles([cast(up=True)], transport=oi.TwoStream()).water(0)
    assert both.metadata["reflectance_used_nm"] == BANDS.tolist()
    assert both.quantities["bb_550"].sd < 0.6 * plain.quantities["bb_550"].sd
    low, high = both.quantities["bb_550"].interval()
    water = oi.BioOpticalModel().iops(oi.Constituents(**TRUTH), np.array([500.0, 550.0]))
    assert low < float(water.bb[1]) < high


@pytest.mark.slow
def test_kd_and_r_return_their_water():
    depth, Ed, Eu = light(depth=np.linspace(0.0, 20.0, 2001))
    at = np.argmax(Ed / Ed[0] < np.exp(-1.0), axis=0)
    kd = np.array([np.log(Ed[0, i] / Ed[k, i]) / depth[k] for i, k in enumerate(at)])
    kd = np.stack([kd, np.where(BANDS == 555.0, np.nan, kd)])
    ratio = np.tile(Eu[0] / Ed[0], (2, 1))
    fits = fit_apparent(BANDS, kd, ratio, transport=oi.TwoStream(), solar_zenith=[35.0, np.nan])
    for fit in fits:
        assert fit.converged
        for name, value in TRUTH.items():
            low, high = fit.interval(name)
            assert low < value < high, name
        seen = fit.posterior_predictive
        np.testing.assert_allclose(
            np.where(np.isfinite(seen.observed), seen.predicted, np.nan), seen.observed, rtol=0.05
        )


BEAMS = np.array([412.0, 440.0, 488.0, 510.0, 555.0, 650.0])


def with_beams(x, seed):
    """A cast of the water with the coordinates `x`, with a and c, each with its noise."""
    layout = Parameters(water_unknowns(35.0))
    values = layout.values(jnp.asarray(x))
    depth = np.linspace(0.0, 12.0, 30)
    shape, _ = curve(values, tuple(BANDS.tolist()), oi.TwoStream(), jnp.asarray(depth))
    Ed = np.exp(np.asarray(shape))
    water, pure = (water_iops(v, BEAMS) for v in (values, {}))
    rng = np.random.default_rng(seed)
    beams = [np.asarray(water.a - pure.a), np.asarray(water.c - pure.c)]
    # What such readings are worth: one draw for all depths, and scatter between them.
    beams = [
        v
        + np.hypot(0.03 * v, 0.005) * rng.standard_normal(v.shape)
        + 0.02 * v * rng.standard_normal((len(depth), len(v)))
        for v in beams
    ]
    return Profile(
        depth,
        BANDS,
        Ed * (1 + 0.03 * rng.standard_normal(Ed.shape)),
        sigma=0.03 * Ed,
        solar_zenith=35.0,
        beam_wavelength=BEAMS,
        a=beams[0],
        c=beams[1],
    )


@pytest.mark.slow
def test_a_and_c_are_fitted_with_the_light():
    layout = Parameters(water_unknowns(35.0))
    rng, inside, narrower = np.random.default_rng(3), [], []
    centre = np.array([p.transform.coordinate(p.centre) for p in layout])
    spread = np.array([p.spread or 0.0 for p in layout])
    spread[:3] = 0.7  # waters of a region; the prior of the fit is wider
    truths = centre + spread * rng.standard_normal((60, len(layout)))
    casts = [with_beams(x, seed) for seed, x in enumerate(truths)]
    fits = fit_profiles(casts, transport=oi.TwoStream(), depth_range=(0.0, 12.0))
    blind = [Profile(c.depth, BANDS, c.Ed, sigma=c.sigma, solar_zenith=35.0) for c in casts]
    without = fit_profiles(blind, transport=oi.TwoStream(), depth_range=(0.0, 12.0))
    for i, x in enumerate(truths):
        fit, plain = fits.water(i), without.water(i)
        assert fit.converged
        assert fit.metadata["c_used_nm"] == BEAMS.tolist()
        sd = np.sqrt(np.diag(fit.covariance))[:3]
        inside.append(np.abs(fit.x[:3] - x[:3]) < 1.96 * sd)
        narrower.append(
            [
                *sd / np.sqrt(np.diag(plain.covariance))[:3],
                fit.quantities["c_550"].sd / plain.quantities["c_550"].sd,
            ]
        )
    # The 99 % binomial band of 60 at 0.95.
    share = np.mean(inside, axis=0)
    assert np.all(share >= binom.ppf(0.005, 60, 0.95) / 60), share
    # Measured for chlorophyll, CDOM, detritus: 0.78, 0.86, 0.95.
    assert np.all(np.median(narrower, axis=0) < [0.85, 0.95, 1.0, 0.3]), np.median(narrower, axis=0)
    # One cast alone takes the same road.
    alone = fit_profile(casts[0], transport=oi.TwoStream(), depth_range=(0.0, 12.0))
    np.testing.assert_allclose(alone.x, fits.water(0).x, atol=1e-6)


def test_a_bad_band_is_not_believed():
    kd, bands = np.full(8, 0.2), 8
    exact = _spectra(kd, np.full(bands, np.nan), 0.05, 0.05, oi.TwoStream())
    rng = np.random.default_rng(0)
    slope = kd * (1 + 0.15 * rng.standard_normal(bands))
    slope[3] = 0.6
    model = np.concatenate([np.ones((1, bands)), np.exp(-slope / kd) * np.ones((bands, 1))])
    unknowns = Parameters([Parameter("cdom", 0.1, 1.0)])
    blank = np.zeros(bands)
    water = Water(
        jnp.zeros(1), jnp.eye(1), jnp.asarray(0), {}, {}, jnp.asarray(model), jnp.asarray(blank)
    )
    assert isinstance(exact.sd, np.ndarray)
    scale = 1.0
    for _ in range(20):
        seen, scale, dof = _weighed(kd, exact, water, unknowns, scale, 0.05)
    # Three times 5 %, within what eight bands tell; the bad band counts an eighth of the others.
    assert 1.7 < scale < 4.0
    assert dof == pytest.approx(_WORTH + bands)
    assert np.asarray(seen.sd)[0, 3] > 2.5 * np.median(np.asarray(seen.sd)[0])


def test_absorption_may_depart_from_the_model():
    values = Parameters([*water_unknowns(35.0), *absorption_shapes()]).values
    layout = Parameters([*water_unknowns(35.0), *absorption_shapes()])
    x = np.array([p.transform.coordinate(p.centre) for p in layout])
    plain, pure = water_iops(values(jnp.asarray(x)), BEAMS), water_iops({}, BEAMS)
    x[layout.names.index("shape_443")] = np.log(1.2)
    bent = water_iops(values(jnp.asarray(x)), BEAMS)
    ratio = np.asarray((bent.a - pure.a) / (plain.a - pure.a))
    expected = 1.0 + 0.2 * np.interp(BEAMS, [412.0, 443.0, 490.0], [0.0, 1.0, 0.0])
    np.testing.assert_allclose(ratio, expected, rtol=1e-6)
    np.testing.assert_array_equal(bent.b, plain.b)
