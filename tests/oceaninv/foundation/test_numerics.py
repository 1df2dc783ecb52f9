"""Exponential integrals, safe powers, interpolation and quadrature against mpmath."""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from oceaninv.foundation.numerics import (
    exp_mean,
    exp_mean3,
    exp_moment,
    gauss_legendre,
    linear_interpolation_matrix,
    safe_power,
    safe_sqrt,
)

mpmath.mp.dps = 60

# Around the switch of formula (0.5), at nothing, at almost nothing, and beyond what e^-x can hold.
POINTS = np.array(
    [
        0.0,
        1e-300,
        1e-17,
        1e-9,
        1e-4,
        0.03,
        0.3,
        0.4999,
        0.5,
        0.5001,
        0.8,
        1.7,
        6.0,
        30.0,
        400.0,
        1e5,
    ]
)


def _moment(n, x):
    """I_n(x) from the lower incomplete gamma function."""
    x = mpmath.mpf(float(x))
    if x < mpmath.mpf("1e-20"):
        return 1 / mpmath.mpf(n + 1) - x / (n + 2)
    return mpmath.gammainc(n + 1, 0, x) / x ** (n + 1)


def _divided_difference(*at):
    """Integral of e^-u over the simplex of the arguments, by spreading coincident ones at high
    precision: the error is of the order of the shift."""
    with mpmath.workdps(180):
        shift = mpmath.mpf(10) ** -40
        u = [mpmath.mpf(float(x)) + k * shift for k, x in enumerate(at)]
        total = mpmath.mpf(0)
        for i, x in enumerate(u):
            bottom = mpmath.mpf(1)
            for j, y in enumerate(u):
                if i != j:
                    bottom *= x - y
            total += mpmath.exp(-x) / bottom
        return (-1) ** (len(at) - 1) * total


def _relative(value, truth):
    truth = [mpmath.mpf(t) for t in truth]
    return max(
        float(abs(mpmath.mpf(float(v)) - t) / (abs(t) if t else 1))
        for v, t in zip(np.ravel(np.asarray(value, np.float64)), truth, strict=True)
    )


# Worst relative errors over POINTS: 2e-16, 4e-16, 2e-15, 3e-14 in float64.
@pytest.mark.parametrize(("n", "x64"), [(0, 5e-16), (1, 2e-15), (2, 2e-14), (3, 2e-13)])
def test_exp_moment(n, x64):
    truth = [_moment(n, x) for x in POINTS]
    assert _relative(jax.jit(exp_moment, static_argnums=0)(n, jnp.asarray(POINTS)), truth) < x64
    single = POINTS.astype(np.float32)
    value = exp_moment(n, jnp.asarray(single))
    assert value.dtype == jnp.float32
    # Subnormal float32 counts as 0, where the value is the limit.
    assert _relative(value, [_moment(n, x) for x in single]) < 1e-5


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_exp_moment_derivatives(mode):
    """d/dx I_n = -I_(n+1), at every order, in both modes, at 0 as well."""
    first = jax.jit(jax.vmap(mode(lambda x: exp_moment(0, x))))(jnp.asarray(POINTS))
    second = jax.jit(jax.vmap(mode(mode(lambda x: exp_moment(0, x)))))(jnp.asarray(POINTS))
    assert _relative(first, [-_moment(1, x) for x in POINTS]) < 2e-15
    assert _relative(second, [_moment(2, x) for x in POINTS]) < 2e-14


PAIRS = [
    (a, a + d) for a in (0.0, 0.3, 7.0, 80.0) for d in (0.0, 1e-15, 1e-8, 1e-3, 0.7, 20.0, 1e4)
]


def test_exp_mean():
    a, b = (jnp.asarray(x) for x in np.array(PAIRS).T)
    truth = [_divided_difference(*p) for p in np.array(PAIRS)]
    # e^-80 itself costs 80 ulp of its argument.
    assert _relative(exp_mean(a, b), truth) < 2e-14
    assert np.array_equal(exp_mean(a, b), exp_mean(b, a))
    low, high = (np.array(PAIRS)[:28].astype(np.float32)).T
    single = exp_mean(jnp.asarray(low[:14]), jnp.asarray(high[:14]))
    truth = [_divided_difference(*p) for p in zip(low[:14], high[:14], strict=True)]
    assert single.dtype == jnp.float32
    assert _relative(single, truth) < 1e-5


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_exp_mean_derivatives(mode):
    """d/da is minus the divided difference with a twice; exact also where a = b."""
    a, b = (jnp.asarray(x) for x in np.array(PAIRS[:14]).T)
    slopes = jax.jit(jax.vmap(mode(exp_mean, argnums=(0, 1))))(a, b)
    ours = np.array(slopes)
    for (x, y), da, db in zip(PAIRS[:14], *ours, strict=True):
        assert _relative([da], [-_divided_difference(x, x, y)]) < 1e-12
        assert _relative([db], [-_divided_difference(x, y, y)]) < 1e-12


TRIPLES = [
    (a, a + p, a + q)
    for a in (0.0, 0.4, 30.0)
    for p, q in [
        (0.0, 0.0),
        (1e-15, 1e-9),
        (0.0, 0.1),
        (0.1, 0.1),
        (0.0, 0.2499),
        (0.1, 0.2501),
        (0.25, 0.25),
        (0.0, 5.0),
        (5.0, 5.0),
        (1e-12, 3.0),
        (2.0, 900.0),
    ]
]


def test_exp_mean3():
    points = np.array(TRIPLES)
    truth = [_divided_difference(*p) for p in points]
    order = [(0, 1, 2), (2, 0, 1), (1, 2, 0), (2, 1, 0)]
    for i, j, k in order:
        value = jax.jit(exp_mean3)(*(jnp.asarray(points[:, x]) for x in (i, j, k)))
        assert _relative(value, truth) < 5e-14
    single = points[:22].astype(np.float32)
    value = exp_mean3(*(jnp.asarray(x) for x in single.T))
    assert value.dtype == jnp.float32
    assert _relative(value, [_divided_difference(*p) for p in single]) < 1e-5


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_exp_mean3_derivatives(mode):
    """Each slope is minus the third divided difference, also where arguments coincide."""
    points = np.array(TRIPLES[:22])
    slope = jax.jit(jax.vmap(mode(exp_mean3, argnums=(0, 1, 2))))
    ours = np.array(slope(*(jnp.asarray(x) for x in points.T)))
    for p, got in zip(points, ours.T, strict=True):
        truth = [-_divided_difference(*p, x) for x in p]
        assert _relative([got.sum()], [sum(truth)]) < 1e-10
        for g, t in zip(got, truth, strict=True):
            assert abs(g - float(t)) < 1e-10 * abs(float(sum(truth)))


def test_safe_sqrt():
    x = jnp.asarray([-3.0, -0.0, 0.0, 1e-300, 4.0])
    np.testing.assert_array_equal(safe_sqrt(x), [0, 0, 0, 1e-150, 2])
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.vmap(mode(safe_sqrt))(x), [0, 0, 0, 0.5e150, 0.25])


def test_safe_power():
    x = jnp.asarray([0.0, 1e-300, 1e-7, 1e-6, 1e-5, 0.3, 50.0])
    e = jnp.full_like(x, 0.62)
    value = np.asarray(safe_power(x, e))
    np.testing.assert_allclose(value[3:], np.asarray(x)[3:] ** 0.62, rtol=1e-15)
    # Linear through the origin below the knee, and continuous there.
    np.testing.assert_allclose(value[:3], 1e-6**-0.38 * np.asarray(x)[:3], rtol=1e-14)
    for mode in (jax.jacfwd, jax.jacrev):
        dx, de = jax.vmap(mode(safe_power, argnums=(0, 1)))(x, e)
        assert np.all(np.isfinite(dx))
        assert np.all(np.isfinite(de))
        np.testing.assert_allclose(dx[:3], 1e-6**-0.38, rtol=1e-14)
        np.testing.assert_allclose(dx[4:], 0.62 * np.asarray(x)[4:] ** -0.38, rtol=1e-14)
    assert safe_power(jnp.float32(0.5), jnp.float32(0.6)).dtype == jnp.float32
    assert float(safe_power(jnp.asarray(-1e-7), jnp.asarray(0.62))) < 0


def test_interpolation_matrix():
    knots = np.array([1.0, 2.0, 4.0, 4.5])
    at = np.array([1.0, 1.25, 2.0, 3.9, 4.5])
    matrix = linear_interpolation_matrix(at, knots)
    values = np.array([3.0, -1.0, 5.0, 2.0])
    np.testing.assert_allclose(matrix @ values, np.interp(at, knots, values), atol=1e-15)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(matrix @ knots, at, atol=1e-15)


@pytest.mark.parametrize("n", [1, 5, 48])
def test_gauss_legendre(n):
    """Exact for polynomials up to degree 2n - 1, and not beyond."""
    x, w = gauss_legendre(n, -0.5, 2.0)

    def integral(degree):
        return (2.0 ** (degree + 1) - (-0.5) ** (degree + 1)) / (degree + 1)

    np.testing.assert_allclose(w @ x ** (2 * n - 1), integral(2 * n - 1), rtol=1e-12)
    if n == 5:
        assert abs(w @ x**10 / integral(10) - 1) > 1e-6


@functools.cache
def _monotone():
    return jax.jit(functools.partial(exp_moment, 1))


def test_exp_moment_is_continuous_at_its_switch():
    """No step where the series hands over to the closed form."""
    x = np.nextafter(0.5, 0), 0.5, np.nextafter(0.5, 1)
    values = np.asarray(_monotone()(jnp.asarray(x)))
    assert np.ptp(values) < 1e-15
