"""MonteCarlo: exact values and derivatives within their own standard errors; limits."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import oceaninv as oi
from oceaninv.transport.monte_carlo import _array_rqmc, _event_loop, _forward
from oceaninv.water.phase import HenyeyGreenstein, Seawater
from tests.paths import ROOT

WAVELENGTH = np.array([450.0, 550.0])
A = jnp.asarray


def sidak(count: int, level: float = 0.01) -> float:
    """Greatest |z| that `count` right cases pass together with probability 1 - level."""
    return float(stats.norm.isf((1 - (1 - level) ** (1 / count)) / 2))


def within(found, exact, few: bool = True) -> None:
    """A z-test of all entries at once; no band's error may be more than a fifth of its value."""
    value, stderr = np.asarray(found.value), np.asarray(found.stderr)
    exact = np.asarray(exact)
    counted = stderr > 0
    np.testing.assert_allclose(value[~counted], exact[~counted], rtol=1e-6)
    z = (value - exact)[counted] / stderr[counted]
    assert np.abs(z).max() < sidak(z.size), z
    if few:
        assert (stderr < 0.2 * np.abs(exact) + 1e-12).all()


def nadir(p, dtype=jnp.float64, zenith=0.0):
    """The camera that looks straight down from above: p = a, b, g and the floor's reflectance."""
    one = jnp.ones(1, dtype)
    water = oi.IOPs([500.0], p[0] * one, p[1] * one, HenyeyGreenstein(p[2]))
    return oi.Scene(water, oi.Light(A(zenith, dtype), one), floor=oi.Floor(10.0, p[3] * one))


def down(dtype=jnp.float64, depth=0.0):
    return oi.Rays(A([0.0, 0.0, 1.0], dtype) * depth, A([[0.0, 0.0, 1.0]], dtype))


@jax.jit
def nadir_groups(p, key, zenith=0.0, depth=0.0):
    """Value, standard error, bias and Jacobian of the nadir radiance."""

    def value(p):
        scene, rays = nadir(p, p.dtype, zenith), down(p.dtype, depth)
        found = oi.radiance(scene, rays, oi.MonteCarlo(2**13, 32), key=key)
        return found.value[0, 0], found

    jacobian, found = jax.jacfwd(value, has_aux=True)(p)
    return found.value[0, 0], found.stderr[0, 0], found.bias[0, 0], jacobian


EXACT = 0.02425532, np.array([-0.467556, 0.0104316, -0.0142426])


def test_nadir_camera_and_its_derivatives():
    """Twelve keys: value and d/d(a, b, g) against the exact ones, |z| < 3."""
    p = A([0.065, 0.178, 0.8, 0.3])
    runs = [nadir_groups(p, jax.random.key(i)) for i in range(12)]
    value = np.array([r[0] for r in runs])
    z = (value.mean() - EXACT[0]) / (value.std(ddof=1) / np.sqrt(len(runs)))
    assert abs(z) < 3
    gradient = np.array([r[3][:3] for r in runs])
    z = (gradient.mean(0) - EXACT[1]) / (gradient.std(0, ddof=1) / np.sqrt(len(runs)))
    assert (np.abs(z) < 3.5).all(), z
    # The stated error is that of the scatter between keys, and truncation is far below it.
    stated = np.mean([r[1] for r in runs])
    assert 0.5 < value.std(ddof=1) / stated < 1.8
    assert max(r[2] for r in runs) < 0.01 * stated


EXTREMES = {
    "thin": (1e-5, 1e-4, 0.8, 0.0),
    "thick": (10.0, 90.0, 0.9, 0.3),
    "milk": (1e-6, 1.0, 0.5, 0.3),
    "no scattering": (0.1, 0.0, 0.8, 0.3),
    "no absorption": (0.0, 0.3, 0.8, 0.3),
    "vacuum": (0.0, 0.0, 0.8, 0.3),
    "peaked": (0.1, 0.5, 0.99, 1.0),
    "backward": (0.1, 0.5, -0.9, 0.0),
    "horizon": (0.1, 0.5, 0.9, 0.3),
    "at the floor": (0.1, 0.5, 0.9, 0.3),
}
PLACES = {"horizon": (89.9, 0.0), "at the floor": (30.0, 10.0)}


@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)])
def test_extremes_are_finite(dtype):
    """Value, stderr and every derivative, from optical thickness 1e-3 to 1e3, albedo to 0.999999,
    g to 0.99, the sun to the horizon; the eye at the surface and at the floor."""
    for name, p in EXTREMES.items():
        place = (A(v, dtype) for v in PLACES.get(name, (0.0, 0.0)))
        value, stderr, bias, jacobian = nadir_groups(A(p, dtype), jax.random.key(1), *place)
        assert value.dtype == jacobian.dtype == stderr.dtype == dtype
        numbers = np.array([value, stderr, *jacobian])
        assert np.isfinite(numbers).all(), (name, numbers)
        assert value >= 0, name
        # No bound where nothing is absorbed, or where 32 events are too few.
        assert np.isfinite(bias) or name in ("no absorption", "vacuum", "milk"), name


@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)])
def test_under_a_surface_at_its_extremes(dtype):
    """Eyes at the surface, in mid-water and at the floor that look up, level and down, the sun in
    the zenith and on the horizon, a uniform sky or none: finite values, errors, derivatives."""

    @jax.jit
    @jax.vmap
    def radiance(p, zenith, sky):
        def value(p):
            water, light = nadir(p, dtype).water, oi.Light(zenith, p[:1] * 0 + 1, sky[None])
            scene = oi.Scene(water, light, oi.FlatSurface(1.34), nadir(p, dtype).floor)
            z, level = A([0.0, 5.0, 10.0], dtype), jnp.zeros(9, dtype)
            origin = jnp.stack([level, level, jnp.repeat(z, 3)], axis=1)
            looks = A([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype)
            rays = oi.Rays(origin, jnp.tile(looks, (3, 1)))
            found = oi.radiance(scene, rays, oi.MonteCarlo(64, 6), key=jax.random.key(1))
            return found.value[:, 0], (found.value[:, 0], found.stderr[:, 0])

        slopes, (value, stderr) = jax.jacfwd(value, has_aux=True)(p)
        return value, stderr, slopes

    waters = A(list(EXTREMES.values()), dtype)
    places = [(z, s) for z in (0.0, 90.0) for s in (0.0, 0.1)]
    p = jnp.repeat(waters, len(places), axis=0)
    zenith, sky = (A(v * len(waters), dtype) for v in map(list, zip(*places, strict=True)))
    for numbers in radiance(p, zenith, sky):
        assert numbers.dtype == dtype
        assert np.isfinite(numbers).all()
    assert (radiance(p, zenith, sky)[0] >= 0).all()


def test_no_scattering_is_the_floor_and_its_derivatives():
    """At b = 0: L = rho/pi exp(-2 a H), and d/db of single scattering is not lost."""
    a, rho, depth = 0.1, 0.3, 10.0
    value, stderr, _, jacobian = nadir_groups(A([a, 0.0, 0.0, rho]), jax.random.key(0))
    exact = rho / np.pi * np.exp(-2 * a * depth)
    np.testing.assert_allclose(value, exact, rtol=1e-12)
    np.testing.assert_allclose(stderr, 0.0, atol=1e-15)
    np.testing.assert_allclose(jacobian[0], -2 * depth * exact, rtol=1e-9)
    np.testing.assert_allclose(jacobian[3], exact / rho, rtol=1e-9)
    step = 1e-3
    below = [nadir_groups(A([a, b, 0.0, rho]), jax.random.key(0))[0] for b in (step, 2 * step)]
    slope = (4 * below[0] - below[1] - 3 * value) / (2 * step)
    np.testing.assert_allclose(jacobian[1], slope, rtol=0.03)


SKY = oi.Light(40.0, A([1.0, 0.8]), A([0.05, 0.1]))


def two_shapes(a, scale):
    phases = (Seawater(), HenyeyGreenstein(0.85))
    return oi.IOPs(WAVELENGTH, A(a), A([[0.01, 0.005], [0.2, 0.3]]) * scale, phases)


LAYERED = oi.Scene(
    oi.Layers(
        A([1.5]),
        (two_shapes([0.1, 0.2], 1.0), two_shapes([0.05, 0.1], 2.0)),
    ),
    SKY,
    oi.FlatSurface(1.34),
    oi.Floor(6.0, A([0.1, 0.4])),
)


@pytest.fixture(scope="module")
def layered():
    return oi.radiance(LAYERED, LOOKS, oi.MonteCarlo(2**12), key=jax.random.key(3))


LOOKS = oi.Rays(
    A([0.0, 0.0, 1.0]),
    A([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.6, 0.0, -0.8], [0.0, 1.0, 0.0], [0.8, 0.0, -0.6]]),
    A([np.inf, np.inf, np.inf, np.inf, 1.2]),
)


def test_layers_surface_floor_and_sky_against_the_exact_radiance(layered):
    """Two shapes in two layers, seen down, up through the window, level, and along 1.2 m."""
    within(layered, oi.radiance(LAYERED, LOOKS, oi.PlaneParallel(16)).value)


def test_layers_surface_floor_and_sky_against_the_exact_irradiance():
    depths = A([0.0, 1.0, 2.5, 5.0])
    found = oi.irradiance(LAYERED, depths, oi.MonteCarlo(2**14), key=jax.random.key(0))
    exact = oi.irradiance(LAYERED, depths, oi.PlaneParallel(16))
    for name in ("Ed", "Eu", "E0"):
        within(getattr(found, name), getattr(exact, name).value)


def test_chunks_do_not_matter(layered, monkeypatch):
    monkeypatch.setattr(_event_loop, "_CHUNK", 1000)
    found = oi.radiance(LAYERED, LOOKS, oi.MonteCarlo(2**12), key=jax.random.key(3))
    np.testing.assert_allclose(found.value, layered.value, rtol=1e-12)
    np.testing.assert_allclose(found.stderr, layered.stderr, rtol=1e-9)
    transport = oi.MonteCarlo(2**12, 6, roulette=False)
    fluxes = below(P, jax.random.key(3), transport)
    monkeypatch.setattr(_event_loop, "_CHUNK", 100)
    jax.clear_caches()
    for one, other in zip(fluxes, below(P, jax.random.key(3), transport), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


def below(p, key, transport):
    """(value, stderr) of Ed, Eu and E0 at two depths."""
    found = oi.irradiance(nadir(p), A([1.0, 6.0]), transport, key=key)
    parts = found.Ed, found.Eu, found.E0
    return tuple(jnp.stack([getattr(e, name) for e in parts]) for name in ("value", "stderr"))


def test_the_error_of_ordered_walks_is_that_between_keys():
    """Of 48 keys, though the walks of a group are not independent."""
    keys, transport = jax.random.split(jax.random.key(11), 48), oi.MonteCarlo(2**12, 8, False)
    value, stderr = jax.lax.map(lambda key: below(THICK, key, transport), keys)
    ratio = value.std(0, ddof=1) / np.sqrt((stderr**2).mean(0))
    assert (ratio > 0.7).all(), ratio
    assert (ratio < 1.4).all(), ratio


@pytest.mark.slow
def test_order_pays(monkeypatch):
    """Walks that take the same points in no order have greater errors."""
    monkeypatch.setattr(_forward, "grouped", lambda paths: 1024)
    transport, key = oi.MonteCarlo(2**15, 8, roulette=False), jax.random.key(12)
    sorted_and_resampled = below(THICK, key, transport)[1]
    monkeypatch.setattr(
        _array_rqmc, "places", lambda z, _: jnp.broadcast_to(jnp.arange(z.shape[1]), z.shape)
    )
    jax.clear_caches()
    ratio = below(THICK, key, transport)[1] / sorted_and_resampled
    jax.clear_caches()
    assert np.exp(np.log(ratio).mean()) > 1.3, ratio


@pytest.mark.slow
def test_longer_flights_and_the_worth_of_walks_up_pay(monkeypatch):
    """Deep in water that absorbs."""
    transport, key = oi.MonteCarlo(2**15, 16, roulette=False), jax.random.key(14)
    now = below(DEEP, key, transport)[1]
    for name in ("_LONGER", "_TILT"):
        monkeypatch.setattr(_forward, name, 0.0)
    jax.clear_caches()
    ratio = below(DEEP, key, transport)[1][:, 1] / now[:, 1]
    jax.clear_caches()
    assert (ratio > 1.2).all(), ratio


def test_light_of_the_floor_at_the_floor_is_known():
    """Lambert's law: its scalar irradiance is twice what goes up, walk by walk."""
    found = oi.irradiance(
        nadir(A([0.2, 0.0, 0.5, 0.3])), A([10.0]), oi.MonteCarlo(64, 2), key=jax.random.key(1)
    )
    np.testing.assert_allclose(found.E0.value - found.Ed.value, 2 * found.Eu.value, rtol=1e-12)


THICK = A([0.3, 0.5, 0.5, 0.3])
DEEP = A([0.5, 0.5, 0.5, 0.3])


_ON_DEVICES = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import oceaninv as oi
from tests.oceaninv.transport.monte_carlo.test_monte_carlo import down, nadir
scene, done = nadir(jnp.asarray([0.065, 0.178, 0.8, 0.3])), []
mc = oi.MonteCarlo(33 * 32, 6, progress=lambda i, n: done.append((int(i), int(n))))
seen = oi.radiance(scene, down(), mc, key=jax.random.key(1))
jax.effects_barrier()
below = oi.irradiance(scene, jnp.ones(1), oi.MonteCarlo(65 * 32, 6), key=jax.random.key(1)).Eu
numbers = [found[0, 0].item() for e in (seen, below) for found in (e.value, e.stderr)]
print(jax.local_device_count(), *numbers)
assert sorted(done) == [(i, done[0][1]) for i in range(done[0][1])], done
"""


@pytest.mark.slow
def test_devices_do_not_matter():
    """One device and two: the same walks, and every chunk is told of once."""
    found = {}
    for count in (1, 2):
        flags = f"--xla_force_host_platform_device_count={count}"
        done = subprocess.run(
            [sys.executable, "-c", _ON_DEVICES],
            cwd=ROOT,
            env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        devices, *numbers = map(float, done.stdout.split())
        assert devices == count
        found[count] = numbers
    np.testing.assert_allclose(found[2], found[1], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_extreme_irradiances_are_finite(dtype):
    """Ed, Eu, E0, their errors and derivatives, at the surface and at the floor."""
    key = jax.random.key(2)

    @jax.jit
    def fluxes(p, zenith):
        def value(p):
            scene, depths = nadir(p, p.dtype, zenith), A([0.0, 10.0], p.dtype)
            found = oi.irradiance(scene, depths, oi.MonteCarlo(2**10, 32), key=key)
            parts = found.Ed, found.Eu, found.E0
            return jnp.stack([f.value for f in parts]), jnp.stack([f.stderr for f in parts])

        jacobian, stderr = jax.jacfwd(value, has_aux=True)(p)
        return value(p)[0], stderr, jacobian

    for name, p in EXTREMES.items():
        zenith = A(PLACES.get(name, (0.0, 0.0))[0], dtype)
        numbers = fluxes(A(p, dtype), zenith)
        assert all(np.isfinite(np.asarray(n)).all() for n in numbers), name
        assert all(n.dtype == dtype for n in numbers)
        assert (numbers[0] >= 0).all()


@pytest.mark.parametrize(
    ("name", "scene"),
    [
        ("light.zenith", lambda x: oi.Scene(nadir(P).water, oi.Light(x, jnp.ones(1)))),
        (
            "floor.depth",
            lambda x: oi.Scene(nadir(P).water, nadir(P).light, floor=oi.Floor(x, jnp.ones(1))),
        ),
        (
            "surface.index",
            lambda x: oi.Scene(nadir(P).water, nadir(P).light, oi.FlatSurface(1 + 0.1 * x)),
        ),
    ],
)
def test_geometry_has_no_derivative(name, scene):
    def value(x):
        return oi.radiance(scene(x), down(), oi.MonteCarlo(32, 2), key=jax.random.key(0)).value[
            0, 0
        ]

    for derivative in (jax.jacfwd, jax.grad):
        with pytest.raises(ValueError, match=name):
            derivative(value)(A(2.0))


P = A([0.065, 0.178, 0.8, 0.3])


def test_rays_and_depths_have_no_derivative():
    transport, key = oi.MonteCarlo(32, 2), jax.random.key(0)
    with pytest.raises(ValueError, match=r"rays\.origin"):
        jax.jacfwd(
            lambda z: (
                oi.radiance(
                    nadir(P), oi.Rays(A([0.0, 0.0, 1.0]) * z, down().direction), transport, key=key
                ).value
            )
        )(A(1.0))
    with pytest.raises(ValueError, match="depths"):
        jax.jacfwd(lambda z: oi.irradiance(nadir(P), z, transport, key=key).Ed.value)(A(1.0))


def test_an_unknown_error_stays_unknown_in_a_sum():
    one, unknown = (oi.Estimate(A([1.0]), A([e]), A([0.0])) for e in (3.0, np.nan))
    assert np.isnan(_event_loop.summed([one, unknown]).stderr).all()
    np.testing.assert_allclose(_event_loop.summed([one, one]).stderr, np.sqrt(18.0))


def test_bad_input_says_what_to_do():
    with pytest.raises(ValueError, match="paths must be at least 1"):
        oi.MonteCarlo(0)
    with pytest.raises(ValueError, match="bounces must be at least 1"):
        oi.MonteCarlo(8, 0)
    with pytest.raises(ValueError, match="pass key="):
        oi.radiance(nadir(P), down(), oi.MonteCarlo(32))


@pytest.mark.slow
def test_similar_water_is_the_same_where_scattering_is_even():
    """At g = 0 the switch changes nothing; elsewhere its error has no bound."""
    p, key = A([0.065, 0.178, 1e-4, 0.3]), jax.random.key(3)
    plain, soft = (
        oi.radiance(nadir(p), down(), oi.MonteCarlo(2**9, 12, similar=n), key=key)
        for n in (None, 3)
    )
    np.testing.assert_allclose(soft.value, plain.value, rtol=1e-2)
    assert np.isfinite(plain.bias).all()
    assert np.isnan(soft.bias).all()
    with pytest.raises(ValueError, match="similar must be at least 1"):
        oi.MonteCarlo(32, similar=0)


@pytest.mark.slow
def test_too_few_events_for_turbid_water_say_so():
    """32 events lose up to 98 % of the light: the bound covers the loss, or there is none."""
    lost = 0
    for a, b in ((0.1, 2.0), (0.05, 5.0)):
        water = oi.IOPs([500.0], A([a]), A([b]), HenyeyGreenstein(0.924))
        scene, depths = oi.Scene(water, oi.Light(30.0, jnp.ones(1))), A([0.0, 2.0, 5.0])
        found = oi.irradiance(scene, depths, oi.MonteCarlo(2**12, 32), key=jax.random.key(0))
        exact = oi.irradiance(scene, depths, oi.PlaneParallel(24))
        for name in ("Ed", "Eu", "E0"):
            own = getattr(found, name)
            error = np.abs(np.asarray(own.value - getattr(exact, name).value))
            bias, stderr = np.asarray(own.bias), np.asarray(own.stderr)
            bounded = np.isfinite(bias)
            assert (error <= bias + 4 * stderr + 1e-9)[bounded].all(), (name, error, bias, stderr)
            lost += int(np.sum(error > 0.2 * np.asarray(getattr(exact, name).value)))
    assert lost >= 8
