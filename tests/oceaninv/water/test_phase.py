"""Phase functions against their own integrals, literal formulas, limits and published numbers."""

import doctest
import functools
import sys

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.optimize
import scipy.special

import oceaninv as oi
from oceaninv.water.phase import (
    FournierForand,
    HenyeyGreenstein,
    Isotropic,
    Mixture,
    Seawater,
    Tabulated,
    TwoTermHenyeyGreenstein,
    fit_two_term,
    petzold,
)

CAP = np.radians(0.1)
EDGES = np.concatenate([np.geomspace(CAP, 0.3, 40), np.linspace(0.3, np.pi, 41)[1:]])


def _phases():
    flat = jnp.asarray([1.0, 0.5, 0.2, 0.1, 0.3])
    return {
        "isotropic": Isotropic(),
        "hg 0": HenyeyGreenstein(0),
        "hg .9": HenyeyGreenstein(0.9),
        "hg -.9": HenyeyGreenstein(-0.9),
        "two-term": TwoTermHenyeyGreenstein(0.93, -0.5, 0.99),
        "seawater": Seawater(),
        "ff .0183": FournierForand(0.0183),
        "ff .005": FournierForand(0.005),
        "ff n mu": FournierForand(index=1.15, slope=4.874),
        "ff steep": FournierForand(index=1.05, slope=3.01),
        "petzold": petzold(),
        "from 0": Tabulated([0, 10, 60, 120, 180], flat),
        "from 5": Tabulated([5, 10, 60, 120, 180], flat),
        "mixture": Mixture(jnp.asarray([2.0, 1.0]), [Seawater(), FournierForand(0.01)]),
    }


PHASES = _phases()
every_phase = pytest.mark.parametrize("name", PHASES)


def _solid_angle_rule():
    """Cosines and weights that integrate over the sphere what any of the phases returns."""
    knots = [np.radians(getattr(phase, "angle_deg", ())) for phase in PHASES.values()]
    edges = np.unique(np.round(np.concatenate([[0, np.pi / 2], EDGES, *knots]), 12))
    x, w = np.polynomial.legendre.leggauss(12)
    half = np.diff(edges)[:, None] / 2
    theta = (edges[:-1, None] + half * (x + 1)).ravel()
    return np.cos(theta), 2 * np.pi * (half * w).ravel() * np.sin(theta)


COSINE, WEIGHT = _solid_angle_rule()


@functools.cache
def _measure(name):
    values = np.asarray(PHASES[name](jnp.asarray(COSINE)))
    assert np.all(values > 0)
    return values * WEIGHT


@every_phase
def test_integral_backscatter_and_asymmetry(name):
    phase, measure = PHASES[name], _measure(name)
    assert measure.sum() == pytest.approx(1, abs=1e-11)
    back = measure[COSINE < 0].sum()
    assert float(phase.backscatter_ratio) == pytest.approx(back, abs=1e-12)
    # The flattened forward cone of 0.1 degree moves the mean cosine by at most 8e-7.
    assert float(phase.asymmetry) == pytest.approx(COSINE @ measure, abs=8e-7)


def _ff_literal(theta, n, mu):
    """4 pi times the function as printed by Fournier & Jonasz 1999, and its cumulative form."""
    nu = (3 - mu) / 2
    half = mpmath.sin(theta / 2) ** 2
    top = 4 / (3 * (n - 1) ** 2)
    d = top * half
    back = (1 - top**nu) / ((top - 1) * top**nu)
    body = nu * (1 - d) - (1 - d**nu) + (d * (1 - d**nu) - nu * (1 - d)) / half
    density = body / ((1 - d) ** 2 * d**nu) + back * (3 * mpmath.cos(theta) ** 2 - 1) / 4
    inner = ((1 - d ** (nu + 1)) - (1 - d**nu) * half) / ((1 - d) * d**nu)
    cumulative = inner + back * mpmath.cos(theta) * mpmath.sin(theta) ** 2 / 8
    return density, cumulative


@pytest.mark.parametrize(("n", "mu"), [(1.08, 3.483), (1.15, 4.874), (1.02, 3.07), (1.3, 3.2)])
def test_fournier_forand_is_the_printed_function(n, mu):
    """Measured: 3e-13 relative, through delta = 1, where the printed form needs 40 digits."""
    phase = FournierForand(index=n, slope=mu)
    with mpmath.workdps(40):
        n, mu = mpmath.mpf(float(phase.index)), mpmath.mpf(float(phase.slope))
        unity = float(np.arcsin(np.sqrt(3 / 4) * float(n - 1))) * 2
        theta = np.array([0.1001, 0.3, 1, 10, 90, 150, 180]) * np.pi / 180
        theta = np.concatenate([theta, unity * (1 + np.array([-0.5, -1e-4, 1e-9, 1e-5, 0.3]))])
        cosine = np.cos(theta)
        at = [mpmath.acos(mpmath.mpf(float(c))) for c in cosine]
        want = [float(_ff_literal(t, n, mu)[0] / (4 * mpmath.pi)) for t in at]
        cap = mpmath.pi / 1800
        cone = _ff_literal(cap, n, mu)[1] / (4 * mpmath.pi * mpmath.sin(cap / 2) ** 2)
    np.testing.assert_allclose(phase(jnp.asarray(cosine)), want, rtol=1e-12)
    assert float(phase(jnp.asarray(1.0))) == pytest.approx(float(cone), rel=1e-12)


@pytest.mark.parametrize("ratio", [0.005, 0.0183, 0.03])
def test_fournier_forand_moments(ratio):
    """chi_l = 1 - integral of p (1 - P_l), so that no forward tail is left out."""
    phase = FournierForand(ratio)
    edges = np.concatenate([np.geomspace(1e-7, 0.1, 30), np.linspace(0.1, np.pi, 31)[1:]])
    x, w = np.polynomial.legendre.leggauss(20)
    half = np.diff(edges)[:, None] / 2
    theta, weight = (edges[:-1, None] + half * (x + 1)).ravel(), (half * w).ravel()
    with mpmath.workdps(30):
        n, mu = mpmath.mpf(float(phase.index)), mpmath.mpf(float(phase.slope))
        density = np.array([float(_ff_literal(mpmath.mpf(t), n, mu)[0]) for t in theta])
    mass = density * np.sin(theta) / 2 * weight
    orders = np.array([1, 2, 3, 10, 64])
    lost = 1 - np.array([scipy.special.eval_legendre(l, np.cos(theta)) for l in orders])
    np.testing.assert_allclose(phase.moments(64)[orders], 1 - lost @ mass, atol=1e-10)


@every_phase
def test_moments_are_those_of_the_function(name):
    """Against what __call__ returns, but for what the flattened forward cone changes."""
    measure, moments = _measure(name), PHASES[name].moments(40)
    assert moments.shape == (41,)
    assert float(moments[0]) == pytest.approx(1, abs=1e-12)
    want = np.polynomial.legendre.legvander(COSINE, 40).T @ measure
    # With a fraction F inside the cone chi_l is at most F (1 - P_l(cone))/2 larger.
    order = np.arange(41)
    inside = measure[np.cos(CAP) < COSINE].sum()
    allowance = 1e-11 + order * (order + 1) * np.sin(CAP / 2) ** 2 * inside / 2
    assert np.all(np.abs(np.asarray(moments) - want) < allowance)


def test_published_numbers():
    """Mobley et al. 2002 (bb/b of n, mu); Mobley 1994 (Petzold); Morel 1974 (bb/b = 1/2)."""
    for n, mu, ratio, digits in [
        (1.021, 3.0742, 1e-4, 6e-6),
        (1.04, 3.201, 1e-3, 1e-5),
        (1.08, 3.483, 0.01, 5e-5),
        (1.1, 3.5835, 0.0183, 5e-5),
        (1.175, 4.065, 0.1, 5e-4),
        (1.15, 4.874, 0.4, 6e-4),
    ]:
        got = float(FournierForand(index=n, slope=mu).backscatter_ratio)
        assert got == pytest.approx(ratio, abs=digits)
    average = FournierForand(0.0183)
    assert float(average.index) == pytest.approx(1.1, abs=5e-5)
    assert float(average.slope) == pytest.approx(3.5835, abs=1e-4)
    particle = petzold()
    assert float(particle.asymmetry) == pytest.approx(0.924, abs=5e-5)
    assert float(particle.backscatter_ratio) == pytest.approx(0.0183, abs=5e-5)
    # The 55-row table of Mobley et al. 1993 has slightly other values.
    older = [0.92412, 0.86138, 0.80245, 0.75343]
    np.testing.assert_allclose(particle.moments(4)[1:], older, atol=5e-4)
    # The forward 0.1 degree holds 5.2 %.
    cone = float(particle(jnp.asarray(1.0))) * 4 * np.pi * np.sin(CAP / 2) ** 2
    assert cone == pytest.approx(0.052, abs=5e-4)
    assert float(Seawater().backscatter_ratio) == 0.5


@pytest.mark.slow
@pytest.mark.parametrize("index", [1.05, 1.15])
@pytest.mark.parametrize("slope", [3.5, 4.0, 4.3])
def test_a_population_of_the_same_index_and_slope(index, slope):
    """Lorenz-Mie theory for N(r) ~ r^-slope: near the sun the light falls as angle^(slope - 5),
    the power of diffraction; how far the Fournier-Forand function is from it elsewhere."""
    degrees = np.array([0.3, 1.0, 3.0, 10.0, 20.0, 30.0])
    nodes, weights = np.polynomial.legendre.leggauss(16)
    cosines = np.concatenate([np.cos(np.radians(degrees)), (nodes - 1) / 2])
    population = oi.particles.Population(
        index * 1.34, oi.particles.PowerLaw(slope, 0.01, 50.0), 1e-6, radii=100
    )
    mie = np.asarray(population.phase_function(cosines, [550.0], 1.34))[:, 0]
    ff = FournierForand(index=index, slope=slope)
    ratio = np.asarray(ff(jnp.asarray(cosines[:6]))) / mie[:6]
    # From 1 to 30 degrees; worst 0.486 and 2.08.
    assert np.all((ratio[1:] > 0.48) & (ratio[1:] < 2.09))
    # The power: both reach it towards 0 degrees only, from either side (worst 0.27 and 0.28); a
    # slope that meant numbers larger than r would be 1 away.
    powers = np.log([mie[1] / mie[0], ratio[1] / ratio[0]]) / np.log(degrees[1] / degrees[0])
    assert powers[0] == pytest.approx(slope - 5, abs=0.28)
    assert powers.sum() == pytest.approx(slope - 5, abs=0.29)
    back = np.pi * mie[6:] @ weights
    expected = {(1.05, 3.5): 2.15, (1.05, 4.0): 4.04, (1.05, 4.3): 4.72}
    expected |= {(1.15, 3.5): 1.14, (1.15, 4.0): 2.76, (1.15, 4.3): 3.59}
    assert float(ff.backscatter_ratio) / back == pytest.approx(expected[index, slope], rel=0.01)


@pytest.mark.parametrize("ratio", [1.1e-5, 1e-4, 0.003, 0.02, 0.2, 0.48])
def test_backscatter_ratio_is_met(ratio):
    make = jax.jit(lambda r: FournierForand(r).backscatter_ratio)
    assert float(make(ratio)) == pytest.approx(ratio, rel=1e-12)
    assert float(jax.grad(make)(ratio)) == pytest.approx(1, rel=1e-9)


def test_closed_moments():
    for g in (0.0, 0.9, -0.5):
        np.testing.assert_allclose(
            HenyeyGreenstein(g).moments(20), float(g) ** np.arange(21), rtol=1e-14
        )
    assert float(HenyeyGreenstein(0.9).backscatter_ratio) == pytest.approx(
        0.1 / 1.8 * (1.9 / np.sqrt(1.81) - 1), rel=1e-13
    )
    assert Seawater(1.0).moments(1).shape == (2,)
    assert float(Seawater(1.0).moments(2)[2]) == pytest.approx(0.1)  # Rayleigh
    np.testing.assert_array_equal(Isotropic().moments(3), [1, 0, 0, 0])


def _check_gradient(function, points, step=1e-6, rtol=1e-6):
    """Forward, reverse and central differences agree for a vector function of a vector."""
    jitted = [jax.jit(f) for f in (function, jax.jacfwd(function), jax.jacrev(function))]
    value, forward, reverse = (lambda x, f=f: np.asarray(f(x)) for f in jitted)
    for point in points:
        at = np.asarray(point, float)
        exact = forward(at)
        scale = np.abs(exact).max(axis=0) + 1e-300
        np.testing.assert_allclose(reverse(at) / scale, exact / scale, rtol=1e-9, atol=1e-12)
        for i, unit in enumerate(np.eye(len(at))):
            central = (value(at + step * unit) - value(at - step * unit)) / (2 * step)
            np.testing.assert_allclose(
                exact[:, i] / scale[i], central / scale[i], rtol=rtol, atol=rtol * 1e-2
            )


CHAIN = jnp.asarray(np.cos(np.radians([0.0, 0.05, 0.2, 3.0, 9.0, 60.0, 90.0, 140.0, 180.0])))


def _everything(phase):
    ratio = phase.backscatter_ratio[None]
    return jnp.concatenate([jnp.log(phase(CHAIN)), phase.moments(12)[1:], ratio])


@pytest.mark.parametrize(
    ("make", "points"),
    [
        (HenyeyGreenstein, [[0.0], [0.9], [-0.9]]),
        (TwoTermHenyeyGreenstein, [[0.9, -0.3, 0.97], [0.0, 0.0, 0.5]]),
        (Seawater, [[0.835]]),
        pytest.param(FournierForand, [[0.0183], [0.3]], marks=pytest.mark.slow),
        (
            lambda *v: Mixture(jnp.stack(v[:2]), [Seawater(), HenyeyGreenstein(v[2])]),
            [[0.4, 1.0, 0.8], [0.0, 1.0, 0.0]],
        ),
        (lambda *v: Tabulated([1, 5, 90, 180], jnp.stack(v)), [[12.0, 3.0, 1.0, 0.6]]),
    ],
)
def test_gradient_in_parameters(make, points):
    _check_gradient(lambda x: _everything(make(*x)), points)


def test_gradient_in_direction():
    for phase in (HenyeyGreenstein(0.9), FournierForand(0.0183), petzold()):
        points = [[0.9999], [0.9], [0.123], [-0.99]]
        _check_gradient(lambda c, p=phase: jnp.log(p(c)), points, step=1e-8, rtol=3e-6)


@pytest.mark.slow
def test_gradient_through_delta_one():
    """delta = 4/(3 (n-1)^2) sin^2(theta/2) = 1 is a removable singularity in n, mu and angle."""
    n = 1.1

    def log_value(x):
        return jnp.log(FournierForand(index=x[0], slope=x[1])(x[2:]))

    point = np.array([n, 3.6, 1 - 2 * 0.75 * (n - 1) ** 2, 0.999, 0.3, -0.9])
    _check_gradient(log_value, [point], step=1e-7, rtol=2e-6)
    slope = jax.jit(jax.grad(lambda x: log_value(x)[0]))
    curvature = jax.jit(jax.jacfwd(jax.grad(lambda x: log_value(x)[0])))(point)
    step = 1e-5 * np.eye(6)[0]
    difference = (slope(point + step) - slope(point - step)) / 2e-5
    np.testing.assert_allclose(curvature[0], difference, rtol=1e-4)


EXTREMES = {
    "hg": (HenyeyGreenstein, [[-0.999], [0.0], [0.999]]),
    "ff bb/b": (FournierForand, [[1.1e-5], [0.02], [0.489]]),
    "ff n mu": (
        lambda n, mu: FournierForand(index=n, slope=mu),
        [[1.1, 3.001], [1.1, 4.999], [1.001, 3.6], [3.0, 3.6]],
    ),
    "seawater": (Seawater, [[0.0], [1.0]]),
}


@pytest.mark.parametrize(
    "name",
    ["hg", "seawater", *(pytest.param(n, marks=pytest.mark.slow) for n in EXTREMES if "ff" in n)],
)
def test_extremes_are_finite_in_both_precisions(name):
    make, points = EXTREMES[name]

    @jax.jit
    def value_and_slopes(x, cosine):
        def everything(x):
            phase = make(*x)
            return phase(cosine), phase.moments(9), phase.backscatter_ratio

        return everything(x), jax.jacfwd(everything)(x)

    for point in points:
        single, slopes = value_and_slopes(np.float32(point), CHAIN.astype(jnp.float32))
        # cos(0.05 degrees) and cos(0.2 degrees) round by 6e-8: compare at the rounded cosines.
        rounded = np.float32(CHAIN).astype(float)
        double, double_slopes = value_and_slopes(np.float32(point).astype(float), rounded)
        for leaf in (*single, *slopes):
            assert leaf.dtype == np.float32
            assert np.all(np.isfinite(leaf))
        assert all(np.all(np.isfinite(leaf)) for leaf in (*double, *double_slopes))
        np.testing.assert_allclose(single[0], double[0], rtol=3e-4)
        np.testing.assert_allclose(single[1], double[1], atol=2e-6)
        np.testing.assert_allclose(single[2], double[2], rtol=3e-4)


def test_single_precision_of_every_phase():
    every = jax.jit(lambda cosine: jnp.stack([phase(cosine) for phase in PHASES.values()]))
    values = every(CHAIN.astype(jnp.float32))
    assert values.dtype == jnp.float32
    assert np.all(np.isfinite(values))
    np.testing.assert_allclose(values[:, 3:], every(CHAIN)[:, 3:], rtol=3e-5)


def test_rounded_cosines_beyond_one():
    for phase in (FournierForand(0.02), petzold()):
        beyond = phase(jnp.asarray([1 + 1e-15, -1 - 1e-15]))
        np.testing.assert_allclose(beyond, phase(jnp.asarray([1.0, -1.0])), rtol=1e-12)


def test_table_of_a_known_function():
    """A fine table of Henyey-Greenstein comes back, with and without a row at 0 degrees."""
    known = HenyeyGreenstein(0.8)
    for angle in (np.linspace(0, 180, 361), np.geomspace(0.05, 180, 361)):
        angle[-1] = 180
        values = np.asarray(known(jnp.asarray(np.cos(np.radians(angle)))))
        phase = Tabulated(angle, values, normalise=False)
        np.testing.assert_allclose(phase.moments(64), known.moments(64), atol=2e-4)
        # Between 0 and the second row ln p is linear in the angle: 5.5e-4 off a rounded peak.
        np.testing.assert_allclose(phase(CHAIN), known(CHAIN), rtol=6e-4)
    scaled = Tabulated(angle, 7 * values)
    total = float(phase.moments(0)[0])
    np.testing.assert_allclose(scaled.log_values, np.log(values / total), atol=1e-12)


def test_mixture_is_the_weighted_mean():
    first, second = HenyeyGreenstein(0.9), Seawater()
    mixture = Mixture(jnp.asarray([3.0, 1.0]), [first, second])
    np.testing.assert_allclose(mixture(CHAIN), 0.75 * first(CHAIN) + 0.25 * second(CHAIN))
    same = TwoTermHenyeyGreenstein(0.9, -0.2, 0.75)
    other = Mixture(jnp.asarray([3.0, 1.0]), (first, HenyeyGreenstein(-0.2)))
    np.testing.assert_allclose(other.moments(30), same.moments(30), rtol=1e-14)
    assert float(other.backscatter_ratio) == pytest.approx(float(same.backscatter_ratio))


@pytest.mark.parametrize(
    ("phase", "rms", "second"),
    [
        (petzold(), 0.135, 0.0016),
        (FournierForand(0.005), 0.136, 0.0008),
        (FournierForand(0.0183), 0.125, 0.0019),
        (FournierForand(0.1), 0.134, 0.0080),
    ],
)
def test_two_term_fit(phase, rms, second):
    fit = fit_two_term(phase)
    assert float(fit.asymmetry) == pytest.approx(float(phase.asymmetry), abs=1e-12)
    assert float(fit.backscatter_ratio) == pytest.approx(float(phase.backscatter_ratio), abs=1e-12)
    cosine = jnp.asarray(np.cos(np.radians(np.linspace(5, 175, 86))))
    misfit = np.asarray(jnp.log(fit(cosine) / phase(cosine)))
    assert np.sqrt(np.mean(misfit**2)) < rms
    assert abs(float(fit.moments(2)[2] - phase.moments(2)[2])) < second
    # Any other second term that keeps both numbers is worse.
    for g2 in (float(fit.g2) - 0.05, float(fit.g2) + 0.05):
        g1 = _math_first(g2, phase)
        weight = (float(phase.asymmetry) - g2) / (g1 - g2)
        other = TwoTermHenyeyGreenstein(g1, g2, weight)
        worse = np.asarray(jnp.log(other(cosine) / phase(cosine)))
        assert np.mean(worse**2) > np.mean(misfit**2)


def _math_first(g2, phase):
    """g1 that keeps mean cosine and bb/b for a given g2."""
    mean, back = float(phase.asymmetry), float(phase.backscatter_ratio)

    def excess(g1):
        weight = (mean - g2) / (g1 - g2)
        both = TwoTermHenyeyGreenstein(g1, g2, weight)
        return float(both.backscatter_ratio) - back

    return scipy.optimize.brentq(excess, mean + 1e-9, 0.9999, xtol=1e-12)


def test_two_term_fit_returns_what_it_is_given():
    given = TwoTermHenyeyGreenstein(0.92, -0.4, 0.98)
    fit = fit_two_term(given)
    for name in ("g1", "g2", "weight"):
        assert float(getattr(fit, name)) == pytest.approx(float(getattr(given, name)), abs=1e-8)
    assert float(fit_two_term(HenyeyGreenstein(0.7)).g1) == pytest.approx(0.7)
    with pytest.raises(ValueError, match="no two-term function"):
        fit_two_term(FournierForand(0.003))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HenyeyGreenstein(1.0), "g must lie"),
        (lambda: HenyeyGreenstein(jnp.asarray(-1.5)), "g must lie"),
        (lambda: HenyeyGreenstein(float("nan")), "g must lie"),
        (lambda: TwoTermHenyeyGreenstein(0.9, 0.1, 1.1), "weight must lie"),
        (lambda: FournierForand(0.5), "backscatter_ratio must lie"),
        (lambda: FournierForand(index=1.0, slope=3.5), "index must lie"),
        (lambda: FournierForand(index=1.1, slope=3.0), "slope must lie"),
        (lambda: FournierForand(0.02, slope=3.5), "either backscatter_ratio alone"),
        (lambda: FournierForand(), "either backscatter_ratio alone"),
        (lambda: Seawater(1.5), "k must lie"),
        (lambda: Tabulated([1, 2, 170], jnp.ones(3)), "exactly 180"),
        (lambda: Tabulated([1, 1, 180], jnp.ones(3)), "exactly 180"),
        (lambda: Tabulated([1, 2, 3, 180], jnp.ones(3)), "one per angle"),
        (lambda: Tabulated([1, 90, 180], jnp.asarray([1.0, 0.0, 1.0])), "positive"),
        (lambda: Tabulated([1, 2, 180], jnp.asarray([9.0, 1.0, 1.0])), "below 2"),
        (lambda: Mixture(jnp.asarray([1.0]), []), "one weight per phase"),
        (lambda: Mixture(jnp.asarray([1.0, -1.0]), [Isotropic()] * 2), ">= 0"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_works_under_vmap_and_inside_jit():
    ratios = jnp.asarray([0.005, 0.0183, 0.03])
    batch = jax.jit(jax.vmap(lambda r: FournierForand(r).moments(4)))(ratios)
    for ratio, row in zip(ratios, batch, strict=True):
        np.testing.assert_allclose(FournierForand(ratio).moments(4), row, rtol=1e-12)
    inside = jax.jit(lambda c: petzold()(c) + fit_two_term(petzold())(c))(CHAIN)
    np.testing.assert_allclose(inside, petzold()(CHAIN) + fit_two_term(petzold())(CHAIN))


def test_examples():
    result = doctest.testmod(sys.modules[HenyeyGreenstein.__module__])
    assert result.failed == 0
    assert result.attempted > 0
