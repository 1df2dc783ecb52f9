"""The two-stream closed form: its formula, its singularities, its limits, its accuracy."""

import csv
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mpf

import oceaninv as oi
from oceaninv.transport.closed_form.two_stream import solve
from tests.acceptance import two_stream_accuracy as accuracy
from tests.paths import REFERENCE
from tests.reference import literal as _literal

G = 0.8
SUN = float(np.degrees(np.arccos(0.8)))
MU0 = float(oi.Light(SUN, jnp.ones(1)).cosine)
SIN0 = float(np.sqrt(1 - MU0**2))
FLOOR_DEPTH, REFLECTANCE, SKY = 5.0, 0.3, 0.1


def _scene(a, b, kind, g=None):
    """Deep without surface; over a floor; or over a floor, under a surface and a sky."""
    dtype = a.dtype
    ones = jnp.ones_like(a)
    phase = oi.phase.HenyeyGreenstein(jnp.asarray(G, dtype) if g is None else g)
    water = oi.IOPs(np.arange(1.0, a.size + 1), a, b, phase)
    floor = None if kind == "deep" else oi.Floor(FLOOR_DEPTH, REFLECTANCE * ones)
    if kind != "full":
        return oi.Scene(water, oi.Light(SUN, ones), None, floor)
    n = 1.34
    sun = float(np.degrees(np.arcsin(n * SIN0)))
    air = float(np.cos(np.radians(sun)))
    # Fresnel from below at the refracted angle is the same from above.
    direct = MU0 / ((1 - float(_literal.fresnel_from_water(mpf(MU0), mpf(n)))) * air)
    light = oi.Light(sun, direct * ones, SKY * ones)
    return oi.Scene(water, light, oi.FlatSurface(jnp.asarray(n, dtype)), floor)


@functools.partial(jax.jit, static_argnames="kind")
def _radiance(a, b, z, directions, kind, g=None):
    origin = jnp.stack([jnp.zeros_like(z), jnp.zeros_like(z), z], axis=1)
    rays = oi.Rays(origin, directions)
    return oi.TwoStream().radiance(_scene(a, b, kind, g), rays).value


# a = 0.6, b = 1, g = mu0 = 0.8 meets K = k0 = 1.2 exactly.
RESONANT = [(0.6 * (1 + d), 1.0) for d in (1e-3, 1e-5, 1e-7, 1e-9, 1e-12, 1e-15, 0.0)]
WATERS = np.array(
    [
        (0.2, 0.8),
        *RESONANT,
        (0.3, 0.0),
        (0.3, 1e-9),
        (1e-4, 1.0),
        (0.001, 0.02),
        (0.01, 0.1),
        (3.0, 0.01),
        (0.5, 4.0),
    ]
)
_S = np.sqrt(0.75)
DIRECTIONS = np.array(
    [
        (SIN0, 0.0, -MU0),  # into the sun: 1 + k0 d = 0
        (SIN0 * (1 + 1e-9), 0.0, -MU0 * (1 - 1.5e-9)),
        (0.0, 0.0, -1.0),
        (0.0, 0.0, 1.0),
        (-np.sqrt(1 - 0.16), 0.0, 0.4),
        (np.sqrt(1 - 0.01**2), 0.0, -0.01),
        (0.5 * _S, _S * _S, -0.5),
    ]
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
DIRECTIONS[0] = SIN0, 0.0, -MU0
DEPTHS = np.repeat([0.0, 2.0], len(DIRECTIONS))
VIEWS = np.concatenate([DIRECTIONS, DIRECTIONS])


def _truth(a, b, z, view, kind, g=G):
    """The literal formula 1e-22 off its singularities."""
    x, y, d = (mpf(float(v)) for v in view)
    nudge = mpf(10) ** -22
    sun = mpf(MU0)
    sine = mpmath.sqrt(1 - sun**2)
    cosine = 1 - ((x - sine) ** 2 + y**2 + (d + sun) ** 2) / 2
    mirrored = 1 - ((x - sine) ** 2 + y**2 + (abs(d) + sun) ** 2) / 2
    a, b, z = mpf(a), mpf(b), mpf(z)
    a, b, z = a * (1 + nudge) + (a == 0) * nudge, b + (b == 0) * nudge**2, z + nudge
    extra = () if kind == "deep" else (FLOOR_DEPTH, REFLECTANCE)
    more = {"index": 1.34, "sky": SKY, "mirrored": mirrored} if kind == "full" else {}
    return _literal.radiance(a, b, g, sun, z, -d * (1 + nudge), cosine, *extra, **more)


def _worst(value, truth):
    """Worst error relative to the value, or to 1e-3 of the largest in the same water."""
    scale = np.maximum(np.abs(truth), 1e-3 * np.abs(truth).max(axis=0)) + 1e-30
    return (np.abs(np.asarray(value, np.float64) - truth) / scale).max()


def test_published_values():
    """The check values of the closed form (omega 0.8, tau 2, floor 0.3 at tau 5, sky 0.1)."""
    mu = np.array([0.9, 0.4, -0.4, -1.0])
    sine = np.sqrt(1 - mu**2)
    views = np.stack([0.5 * sine, _S * sine, -mu], axis=1)
    a, b = jnp.asarray([0.2]), jnp.asarray([0.8])
    value = _radiance(a, b, jnp.full(4, 2.0), jnp.asarray(views), "full")[:, 0]
    expected = [0.2001272, 0.076434563, 0.025304841, 0.014682129]
    # The first is printed to seven digits; the page rounds the diffuse reflectances to six.
    np.testing.assert_allclose(value, expected, rtol=1e-6)


# Worst measured, float64: 9e-16, 8e-16, 4e-14; float32: 8e-7, 8e-7, 3e-6.
@pytest.mark.parametrize(("kind", "x64"), [("deep", 5e-14), ("floor", 1e-14), ("full", 1e-12)])
def test_singularities(kind, x64):
    """K = k0, rays into the sun, both at once, K -> 0, b = 0, z = 0: against the formula written
    down in mpmath."""
    a, b = (jnp.asarray(x) for x in WATERS.T)
    truth = [
        [float(_truth(*water, z, view, kind)) for water in WATERS]
        for z, view in zip(DEPTHS, VIEWS, strict=True)
    ]
    truth = np.array(truth)
    z, views = jnp.asarray(DEPTHS), jnp.asarray(VIEWS)
    assert _worst(_radiance(a, b, z, views, kind), truth) < x64
    single = _radiance(*(x.astype(jnp.float32) for x in (a, b, z, views)), kind)
    assert single.dtype == jnp.float32
    assert _worst(single, truth) < 1e-5


@pytest.mark.parametrize("kind", ["deep", pytest.param("floor", marks=pytest.mark.slow)])
def test_singularities_gradient(kind):
    """d/da, d/db, d/dz at the same points, forward and reverse, against mpmath differences."""
    waters = WATERS[[0, 1, 4, 6, 7, 8, 10, 11]]
    picks = np.array([7, 8, 9, 11, 13])
    a, b = (jnp.asarray(x) for x in waters.T)
    z, views = jnp.asarray(DEPTHS[picks]), jnp.asarray(VIEWS[picks])

    def at(a, b, z):
        return _radiance(a, b, z, views, kind)

    step = mpf(10) ** -14
    point = (a, b, z)
    truth = np.zeros((3, picks.size, len(waters)))
    for i, pick in enumerate(picks):
        for j, water in enumerate(waters):
            x = [mpf(water[0]), mpf(water[1]), mpf(DEPTHS[pick])]
            for k in range(3):
                high = [v + step * (k == m) for m, v in enumerate(x)]
                low = [v - step * (k == m and v > 0) for m, v in enumerate(x)]
                rise = _truth(*high, VIEWS[pick], kind) - _truth(*low, VIEWS[pick], kind)
                truth[k, i, j] = float(rise / (high[k] - low[k]))
    for k in range(3):
        tangents = tuple(jnp.full_like(x, k == m) for m, x in enumerate(point))
        forward = jax.jvp(at, point, tangents)[1]
        # Worst measured 4e-14 (the difference at b = 0), 6e-13 in z.
        assert _worst(forward, truth[k]) < 1e-11
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(picks.size, len(waters))))
    back = jax.vjp(at, *point)[1](weights)
    for k, axis in ((0, 0), (1, 0), (2, 1)):
        np.testing.assert_allclose(back[k], (truth[k] * weights).sum(axis=axis), 1e-9, 1e-12)


def test_no_absorption_over_a_floor():
    """K = 0 exactly: value to 1e-12, derivative in a to 1e-7 (the root's slope is infinite
    there; see `solve`)."""
    a, b = jnp.zeros(1), jnp.ones(1)
    picks = np.array([2, 3, 9, 10, 11])
    z, views = jnp.asarray(DEPTHS[picks]), jnp.asarray(VIEWS[picks])
    truth = np.array([[float(_truth(0, 1, DEPTHS[p], VIEWS[p], "floor"))] for p in picks])
    at = functools.partial(_radiance, b=b, z=z, directions=views, kind="floor")
    value, slope = jax.jvp(at, (a,), (jnp.ones(1),))
    assert _worst(value, truth) < 1e-12
    step = mpf(10) ** -20
    rise = [
        [
            float(
                (
                    _truth(step, 1, DEPTHS[p], VIEWS[p], "floor")
                    - _truth(0, 1, DEPTHS[p], VIEWS[p], "floor")
                )
                / (step - mpf(10) ** -22)
            )
        ]
        for p in picks
    ]
    assert _worst(slope, np.array(rise)) < 1e-7


def test_single_precision_at_a_floor_many_lengths_down():
    """As sums of large terms Ed and E0 lose .5 % there.  Worst measured 6e-6."""
    found = []
    for dtype in (jnp.float64, jnp.float32):
        a, b, one, depth = (jnp.asarray(v, dtype) for v in ([1e-9], [1e3], [1.0], 404.0))
        water = oi.IOPs([550.0], a, b, oi.phase.HenyeyGreenstein(jnp.asarray(0.98, dtype)))
        floor = oi.Floor(depth, 0.3 * one)
        scene = oi.Scene(water, oi.Light(jnp.asarray(30.0, dtype), one), oi.FlatSurface(), floor)
        depths = depth - jnp.asarray([0.0, 2.0**-10, 0.25, 10.0], dtype)
        field = oi.irradiance(scene, depths)
        found.append(np.stack([np.asarray(x.value, float) for x in (field.Ed, field.Eu, field.E0)]))
    np.testing.assert_allclose(found[1], found[0], rtol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "dtype"), [("deep", jnp.float64), ("deep", jnp.float32), ("full", jnp.float32)]
)
def test_finite_at_the_ends(kind, dtype):
    """Value and derivatives finite without absorption, without scattering, in a vacuum, in ink."""
    waters = np.array([(0, 1), (0, 0), (0.1, 0), (1e-12, 1e-12), (60, 3), (1e4, 1e4), (0, 1e4)])
    a, b = (jnp.asarray(x, dtype) for x in waters.T)
    z, views = jnp.asarray(DEPTHS, dtype), jnp.asarray(VIEWS, dtype)

    def at(a, b, z, g):
        return _radiance(a, b, z, views, kind, g)

    for g in (0.0, 0.99):
        point = (a, b, z, jnp.asarray(g, dtype))
        value = at(*point)
        assert value.dtype == dtype
        assert bool(jnp.all(jnp.isfinite(value)))
        assert float(value.min()) > -1e-6
        slopes = jax.vjp(at, *point)[1](jnp.ones_like(value))
        assert all(bool(jnp.all(jnp.isfinite(s))) for s in slopes)


def test_pure_absorption():
    """b = 0: the sun's beam and nothing else; over the floor its attenuated radiance."""
    a, b = jnp.asarray([0.3]), jnp.zeros(1)
    z, views = jnp.asarray(DEPTHS), jnp.asarray(VIEWS)
    np.testing.assert_array_equal(_radiance(a, b, z, views, "deep"), 0.0)
    field = jax.jit(lambda a: oi.irradiance(_scene(a, b, "deep"), [0.0, 2.0, 9.0]))(a)
    expected = MU0 * np.exp(-0.3 * np.array([[0.0], [2.0], [9.0]]) / MU0)
    np.testing.assert_allclose(field.Ed.value, expected, rtol=1e-14)
    np.testing.assert_allclose(field.E0.value, expected / MU0, rtol=1e-14)
    np.testing.assert_array_equal(field.Eu.value, 0.0)
    looks_down = VIEWS[10]
    seen = _radiance(a, b, jnp.full(1, 2.0), jnp.asarray(looks_down[None]), "floor")
    lit = REFLECTANCE * MU0 * np.exp(-0.3 * FLOOR_DEPTH / MU0) / np.pi
    np.testing.assert_allclose(seen, lit * np.exp(-0.3 * 3.0 / looks_down[2]), rtol=1e-13)


def test_finite_range():
    """A(P) + e^(-cP) L(beyond) = L, A -> L for P -> infinity, A = 0 for P -> 0."""
    a, b = jnp.asarray([0.2, 0.05]), jnp.asarray([0.8, 0.4])
    scene = _scene(a, b, "deep")
    direction = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, -0.8], [1.0, 0.0, 0.0]])
    origin = np.array([0.0, 0.0, 4.0])
    c = np.array([1.0, 0.45])

    @jax.jit
    def endless(origin):
        return oi.radiance(scene, oi.Rays(origin, direction)).value

    @jax.jit
    def ending(length):
        return oi.radiance(scene, oi.Rays(origin, direction, length)).value

    whole = endless(jnp.asarray(np.tile(origin, (3, 1))))
    for length in (0.01, 1.0, 4.5):
        near = ending(length)
        beyond = endless(jnp.asarray(origin + length * direction))
        np.testing.assert_allclose(near + np.exp(-c * length)[None, :] * beyond, whole, rtol=1e-13)
        assert float(near.min()) > 0
    far = ending(300.0)
    np.testing.assert_allclose(far, whole, rtol=1e-13)
    short = ending(1e-6)
    assert float(short.max()) < 1e-5


def test_energy_over_a_white_floor():
    """Without absorption and over a white floor as much goes up as comes down, at every depth."""
    ones = jnp.ones(1)
    water = oi.IOPs([550.0], jnp.zeros(1), 0.7 * ones, oi.phase.HenyeyGreenstein(0.9))
    field = solve(oi.Scene(water, oi.Light(40.0, ones), None, oi.Floor(6.0, ones)))
    depths = jnp.linspace(0.0, 6.0, 7)
    net = field.moments(depths)[1] + field.mu0 * field.direct(depths)
    # The least K^2 that stands for K = 0 leaves 1.1e-12 of the light.
    assert float(jnp.abs(net).max()) < 2e-12


def test_layers_are_refused():
    water = oi.IOPs([550.0], jnp.ones(1), jnp.ones(1), oi.phase.Isotropic())
    scene = oi.Scene(oi.Layers([3.0], (water, water)), oi.Light(0.0, jnp.ones(1)))
    with pytest.raises(ValueError, match="one homogeneous water"):
        oi.radiance(scene, oi.Rays([0.0, 0.0, 1.0], [0.0, 0.0, 1.0]))


@functools.cache
def _exact():
    path = REFERENCE / "two_stream_exact.csv"
    found = {}
    with path.open() as file:
        for row in csv.reader(line for line in file if not line.startswith("#")):
            case = (
                row[0],
                float(row[1]),
                float(row[2]) or None,
                float(row[3]) or None,
                int(row[4]),
            )
            found.setdefault(case, {})[row[5]] = np.array([float(x) for x in row[6:]])
    return found


@functools.partial(jax.jit, static_argnames=("surface", "floor"))
def _case(a, b, sun, depths, surface, floor, phase):
    one = jnp.ones(1)
    water = oi.IOPs([550.0], a[None], b[None], phase)
    scene = oi.Scene(
        water,
        oi.Light(sun, one),
        None if surface is None else oi.FlatSurface(surface),
        None if floor is None else oi.Floor(accuracy.FLOOR_DEPTH, floor * one),
    )
    field = oi.irradiance(scene, depths)
    return (
        oi.radiance(scene, accuracy.rays()).value[:, 0],
        field.Ed.value[:, 0],
        field.Eu.value[:, 0],
    )


@functools.cache
def _errors():
    """Relative errors over 24 exact cases: radiance beyond 20 degrees of the sun, Ed, Eu."""
    radiance, down, up = [], [], []
    a, b = accuracy.coefficients()
    for (name, sun, surface, floor, i), exact in _exact().items():
        depths = jnp.asarray(exact["levels"])
        value, Ed, Eu = _case(
            jnp.asarray(a[i]),
            jnp.asarray(b[i]),
            jnp.asarray(sun),
            depths,
            surface,
            floor,
            accuracy.phase(name),
        )
        outside = accuracy.scattering_angles(sun, surface) >= 20.0
        error = np.asarray(value).reshape(len(accuracy.DEPTHS), -1)
        error = error / exact["whole"].reshape(error.shape) - 1
        radiance.append(error[:, outside].ravel())
        down.append(np.asarray(Ed) / exact["Ed"] - 1)
        if floor is None:
            up.append(np.asarray(Eu) / exact["Eu"] - 1)
    return tuple(np.abs(np.concatenate(x)) for x in (radiance, down, up))


@pytest.mark.slow
def test_accuracy():
    """Against PythonicDISORT; the whole comparison is tests/acceptance/two_stream_accuracy.py."""
    radiance, down, up = _errors()
    # Measured 0.0578, 0.189; Ed 0.0083, 0.031; Eu in deep water 0.072, 0.168.
    assert np.median(radiance) <= 0.06
    assert np.quantile(radiance, 0.9) <= 0.20
    assert np.median(down) <= 0.0087
    assert np.quantile(down, 0.9) <= 0.033
    assert np.median(up) <= 0.075


@pytest.mark.parametrize(("surface", "worst"), [(1.34, 0.045), (None, 0.21)])
def test_a_sky_lights_the_water_from_above(surface, worst):
    """Ed under an overcast sky, which comes down steeply under a surface, by the exact model."""
    b = jnp.asarray([0.3, 0.6, 0.85, 0.95])
    water = oi.IOPs(np.arange(1.0, 5.0), 1.0 - b, b, oi.phase.petzold())
    light = oi.Light(30.0, jnp.zeros(4), jnp.ones(4))
    scene = oi.Scene(water, light, None if surface is None else oi.FlatSurface(surface))
    depths = jnp.asarray([0.0, 1.0, 2.0, 3.0])
    found = oi.TwoStream().irradiance(scene, depths).Ed.value
    exact = oi.PlaneParallel(streams=8).irradiance(scene, depths).Ed.value
    assert np.abs(np.asarray(found / exact) - 1).max() < worst
    alone = oi.TwoStream().irradiance(eqx.tree_at(lambda s: s.light.diffuse, scene, None), depths)
    np.testing.assert_array_equal(alone.Ed.value, 0.0)


def test_little_absorption_is_diffusion():
    """Milk: Ed and Eu, which exceed the net flux many times, by the exact model."""
    b = jnp.asarray([0.99, 0.999, 0.9999])
    water = oi.IOPs(np.arange(1.0, 4.0), 1.0 - b, b, oi.phase.HenyeyGreenstein(0.8))
    scene = oi.Scene(water, oi.Light(40.0, jnp.ones(3)), oi.FlatSurface())
    depths = jnp.asarray([0.0, 5.0, 20.0])
    found, exact = (r.irradiance(scene, depths) for r in (oi.TwoStream(), oi.PlaneParallel(8)))
    for name, worst in (("Ed", 0.13), ("Eu", 0.20)):
        ratio = np.asarray(getattr(found, name).value / getattr(exact, name).value)
        assert np.abs(ratio - 1).max() < worst


def test_exact_reference_reproduces_published_radiances():
    """The reference itself against independent values (omega 0.8, HG 0.8, n = 1.34, floor, sky)."""
    from tests.reference.disort import solve as slab

    def phase(x):
        return (1 - G * G) / (4 * np.pi * (1 + G * G - 2 * G * x) ** 1.5)

    field = slab(
        0.8,
        G ** np.arange(80.0),
        phase,
        0.8,
        5.0,
        reflectance=0.3,
        index=1.34,
        sky=0.1,
        streams=24,
        modes=20,
        breaks=[2.0],
    )
    values = [field.radiance(2.0, mu, 0.5) for mu in (0.9, 0.4, -0.4, -1.0)]
    np.testing.assert_allclose(values, [0.196656, 0.0899949, 0.0279483, 0.015319], rtol=5e-4)
    fluxes = np.array(field.irradiance(2.0))[:, 0]
    np.testing.assert_allclose(fluxes, [0.548112, 0.0642623, 0.997377], rtol=1e-4)
