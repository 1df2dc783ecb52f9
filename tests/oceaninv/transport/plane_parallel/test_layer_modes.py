"""The core of the plane-parallel solver against 256-stream references, conservation, limits and
finite differences."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oceaninv.foundation.numerics import gauss_legendre
from oceaninv.foundation.quadrature import angular_basis, double_gauss, legendre, snell_gauss
from oceaninv.transport.plane_parallel import _column
from oceaninv.transport.plane_parallel import _matrix_functions as mf
from tests.paths import REFERENCE

REFERENCE_FILE = REFERENCE / "radiative_transfer.json"


def column_fluxes(a, moments, thickness, cosine, rho, shares, streams):
    """Ed, Eu, E0 (row, depth) of one layer over a floor, beam of unit normal irradiance."""
    mu, weight = (jnp.asarray(v, dtype=a.dtype) for v in double_gauss(streams))
    basis = jax.tree.map(lambda v: v[0], angular_basis(mu, weight, 1, 2 * streams))
    angular = legendre(cosine[None], 1, 2 * streams)[0, :, 0]
    sources = _column.Sources(cosine, jnp.ones_like(a), angular, None, None, rho)
    column = _column.solve(_column.Water(a[None], moments[None], thickness[None]), sources, basis)
    down, up, depth = jax.vmap(lambda z: _column.within(*_column.locate(column, z)))(
        shares * thickness
    )
    flux = 2 * np.pi * basis.flux
    beam = jnp.exp(-depth / cosine)
    scalar = (down + up) @ (flux / basis.mu) + beam
    return jnp.stack([down @ flux + cosine * beam, up @ flux, scalar])


fluxes = jax.jit(column_fluxes, static_argnames="streams")


def henyey_greenstein(p, thickness, shares):
    """Fluxes of 16 streams as a function of p = (a, b, g, mu0, rho)."""
    a, b, g, cosine, rho = p
    moments = b * jnp.cumprod(jnp.full(33, g).at[0].set(1.0))
    return column_fluxes(a, moments, thickness, cosine, rho, shares, 16)


value = jax.jit(henyey_greenstein)
forward = jax.jit(jax.jacfwd(henyey_greenstein))
SHARES = jnp.asarray([0.0, 0.3, 1.0])


def cases():
    return json.loads(REFERENCE_FILE.read_text())["flux"]["cases"]


@pytest.mark.parametrize("streams", [16, 48])
def test_fluxes_against_256_streams(streams):
    """|error| <= 1e-6 |value| + A, A = 1e-6 (1e-5 for g = 0.924) at 16 streams, 1e-8 at 48."""
    worst = 0.0
    for case in cases():
        if len(case["tau"]) != 5:
            continue
        moments = case["omega"] * float(case["g"]) ** np.arange(2 * streams + 1)
        found = fluxes(
            jnp.asarray(1 - case["omega"]),
            jnp.asarray(moments),
            jnp.asarray(float(case["T_solved"])),
            jnp.asarray(case["mu0"]),
            jnp.asarray(case["rho"]),
            jnp.asarray(case["tau"]) / case["T_solved"],
            streams=streams,
        )
        floor = 1e-8 if streams == 48 else 1e-6 if case["g"] < 0.9 else 1e-5
        for row, name in ((0, "Ed"), (1, "Eu")):
            exact = np.asarray(case[name])
            error = np.abs(np.asarray(found[row]) - exact) / (1e-6 * np.abs(exact) + floor)
            worst = max(worst, float(error.max()))
        error = np.abs(np.asarray(found[2]) / np.asarray(case["E0"]) - 1)
        assert error.max() < (1e-3 if streams == 16 else 2e-6)
    assert worst <= 1.0


@pytest.mark.parametrize("g", [-0.5, 0.0, 0.924, 0.99])
@pytest.mark.parametrize("thickness", [1e-8, 1.0, 100.0, 1e4])
def test_conservative_slab_loses_nothing(g, thickness):
    p = jnp.asarray([0.0, 1.0, g, 0.5, 0.0])
    down, up, _ = value(p, jnp.asarray(thickness), SHARES)
    np.testing.assert_allclose(down - up, down[-1], atol=1e-12)
    assert abs(down[-1] + up[0] - 0.5) < 1e-12


@pytest.mark.parametrize(
    ("g", "transmitted"), [(0.0, 5.8095665e-5), (0.924, 7.607287e-4), (0.99, 5.712110e-3)]
)
def test_conservative_slab_of_thickness_10000(g, transmitted):
    """Plain doubling returns zero here; values of an independent prototype."""
    p = jnp.asarray([0.0, 1.0, g, 0.5, 0.0])
    np.testing.assert_allclose(value(p, jnp.asarray(1e4), SHARES)[0, -1], transmitted, rtol=2e-7)


def central(f, x, i, step):
    """Fourth-order difference; one-sided where x is 0 and must not be negative."""
    unit = np.eye(len(x))[i] * step
    if float(x[i]) == 0.0 and i != 2:
        weights = {0: -25, 1: 48, 2: -36, 3: 16, 4: -3}
    else:
        weights = {-2: 1, -1: -8, 1: 8, 2: -1}
    return sum(w * np.asarray(f(x + k * unit)) for k, w in weights.items()) / (12 * step)


# a, b, g, mu0, rho, thickness
GRADIENT_POINTS = [
    (0.2, 0.8, 0.9, 0.7, 0.3, 1.0),
    (0.0, 1.0, 0.8, 0.5, 0.2, 2.0),
    (0.5, 0.0, 0.8, 0.5, 0.2, 2.0),
    (0.1, 0.9, 0.0, 0.5, 0.1, 1.0),
    (0.1, 0.9, -0.5, 0.999, 0.1, 1.0),
    (0.1, 0.9, 0.8, 0.01, 0.1, 1.0),
    (0.1, 0.9, 0.8, 0.5, 0.1, 60.0),
    (0.1, 0.9, 0.8, float(gauss_legendre(16, 0.0, 1.0)[0][8]), 0.1, 2.0),
]


@pytest.mark.parametrize("point", GRADIENT_POINTS)
def test_gradients_against_differences(point):
    p, thickness = jnp.asarray(point[:5]), jnp.asarray(point[5])
    exact = np.asarray(forward(p, thickness, SHARES))
    assert np.isfinite(exact).all()
    for i in range(5):
        step = 5e-4 * max(abs(point[i]), 0.02)
        differences = central(lambda q: value(q, thickness, SHARES), p, i, step)
        scale = np.abs(differences).max(axis=1, keepdims=True) + 1e-6
        assert (np.abs(exact[..., i] - differences) / scale).max() < 1e-6


def test_empty_water():
    """a = b = 0: nothing happens, and the first absorption acts as Beer's law says."""
    p, thickness = jnp.asarray([0.0, 0.0, 0.8, 0.5, 0.0]), jnp.asarray(1.0)
    down, up, scalar = value(p, thickness, SHARES)
    np.testing.assert_allclose(down, 0.5, rtol=1e-15)
    np.testing.assert_allclose(scalar, 1.0, rtol=1e-15)
    np.testing.assert_allclose(up, 0.0, atol=1e-15)
    derivative = np.asarray(forward(p, thickness, SHARES))
    assert np.isfinite(derivative).all()
    np.testing.assert_allclose(derivative[0, :, 0], -SHARES, atol=1e-12)


def test_reverse_is_forward():
    backward = jax.jit(jax.jacrev(henyey_greenstein))
    for point in ((0.2, 0.8, 0.9, 0.7, 0.3, 1.0), (0.0, 1.0, 0.0, 1.0, 0.0, 30.0)):
        p, thickness = jnp.asarray(point[:5]), jnp.asarray(point[5])
        np.testing.assert_allclose(
            forward(p, thickness, SHARES), backward(p, thickness, SHARES), rtol=1e-9, atol=1e-11
        )


def test_extremes_in_single_precision():
    """Thickness up to 100, a/c down to 1e-6: within 1e-5 of float64; derivatives 5e-4 of the
    largest, and 5e-5 in thin layers, whose changes are no larger than the rounding of the light."""
    for a in (1e-6, 0.1, 1.0):
        for thickness in (1e-8, 1e-3, 1.0, 100.0):
            for g in (-0.5, 0.0, 0.9, 0.99):
                args = (jnp.asarray([a, 1.0 - a, g, 0.6, 0.1]), jnp.asarray(thickness), SHARES)
                low = jax.tree.map(lambda x: x.astype(jnp.float32), args)
                exact, found = np.asarray(value(*args)), np.asarray(value(*low))
                assert found.dtype == np.float32
                assert np.abs(found - exact).max() < 1e-5 * exact.max()
                exact, found = np.asarray(forward(*args)), np.asarray(forward(*low))
                assert np.isfinite(found).all()
                scale = np.abs(exact).max(axis=(0, 1)) + 1e-12
                error = np.abs(found - exact).max(axis=(0, 1)) / scale
                assert error.max() < (5e-4 if thickness >= 1 else 5e-5)


def test_functions_of_k_are_their_definitions():
    k, t, share, nu, rate = 1.7, 2.3, 0.4, 1.25, 1.1
    s, w = gauss_legendre(60, 0.0, t)
    h = t / 2
    at = lambda x: jnp.asarray(np.array([x]))  # noqa: E731
    tanh, _, sech2, coth, csch = mf.through(at(k), jnp.asarray(t))[:, 0]
    np.testing.assert_allclose(
        [tanh, sech2], [np.tanh(k * h) / k, np.cosh(k * h) ** -2], rtol=1e-13
    )
    np.testing.assert_allclose([coth, csch], [k / np.tanh(k * t), k / np.sinh(k * t)], rtol=1e-13)
    beam = w * np.exp(-nu * s)
    even = (beam * np.cosh(k * (s - h))).sum() / 2 / np.cosh(k * h)
    odd = (beam * np.sinh(k * (h - s))).sum() / 2 / k / np.cosh(k * h)
    below = (beam * np.sinh(k * s)).sum() / np.sinh(k * t)
    found = mf.forced(at(k), jnp.asarray(t), jnp.asarray(nu))[:, 0]
    np.testing.assert_allclose(found, [even, odd, below], rtol=1e-12)

    def source(x):
        ends = np.sinh(k * (t - x)) + np.sinh(k * x) * np.exp(-nu * t)
        return (np.exp(-nu * x) - ends / np.sinh(k * t)) / (k**2 - nu**2)

    place = share * t
    found = mf.forced_inside(at(k), jnp.asarray(t), jnp.asarray(share), jnp.asarray(nu))[:, 0]
    ends = np.sinh(k * (t - place)) / np.sinh(k * t), np.sinh(k * place) / np.sinh(k * t)
    np.testing.assert_allclose(found, [*ends, source(place)], rtol=1e-12)
    for along in (True, False):
        seen = w * np.exp(-rate * s)
        lit = seen if along else w * np.exp(-rate * (t - s))
        numbers = (jnp.asarray(v) for v in (t, rate, nu, along))
        found = mf.forced_seen(at(k), *numbers)[:, 0]
        near = (seen * np.sinh(k * (t - s))).sum() / np.sinh(k * t)
        far = (seen * np.sinh(k * s)).sum() / np.sinh(k * t)
        np.testing.assert_allclose(found, [near, far, (lit * source(s)).sum()], rtol=1e-11)


def test_sum_of_products_of_many_axes_in_single_precision():
    """As a sum, this ends the process (jaxlib 0.10.2, on a CPU)."""

    def total(x, y):
        return mf.added(x * y)

    many = jax.jit(jax.vmap(jax.vmap(jax.vmap(total))))
    for count in (3, 8):
        one = jnp.ones((3, 1, 2, 2, count, 8, 8), jnp.float32)
        np.testing.assert_array_equal(many(one, one), np.full((3, 1, 2, count, 8, 8), 2))


def test_matrix_function_derivative():
    """d f(B) of a full perturbation, with equal and with vanishing eigenvalues."""
    rng = np.random.default_rng(1)
    x = np.array([0.0, 0.3, 0.3, 2.0])
    change = rng.normal(size=(4, 4))
    change = change + change.T
    vectors = jnp.asarray(rng.normal(size=(5, 4, 2)))

    def f(s):
        matrix = jnp.diag(jnp.asarray(x)) + s * change
        return mf.apply_functions(mf.through, jnp.asarray(x), matrix, (jnp.asarray(1.3),), vectors)

    def exact(s):
        values, v = np.linalg.eigh(np.diag(x) + s * change)
        k = np.sqrt(values.astype(complex))
        h, t = 0.65, 1.3
        with np.errstate(all="ignore"):
            rows = np.stack(
                [
                    np.where(abs(k) < 1e-12, h, np.tanh(k * h) / k),
                    np.where(abs(k) < 1e-12, h, np.tanh(k * h) / k),
                    np.cosh(k * h) ** -2,
                    np.where(abs(k) < 1e-12, 1 / t, k / np.tanh(k * t)),
                    np.where(abs(k) < 1e-12, 1 / t, k / np.sinh(k * t)),
                ]
            ).real
        return np.einsum("ij,fj,kj,fkm->fim", v, rows, v, np.asarray(vectors))

    _, derivative = jax.jvp(f, (0.0,), (1.0,))
    step = 1e-4
    differences = (
        (8 * (exact(step) - exact(-step)) - exact(2 * step) + exact(-2 * step)) / 12 / step
    )
    np.testing.assert_allclose(derivative, differences, atol=1e-7)


def test_nodes_and_basis():
    """Both node sets integrate fluxes; the basis is the Legendre functions, orthonormal."""
    mu, weight = snell_gauss(16, jnp.asarray(1.34))
    np.testing.assert_allclose(jnp.sum(weight * mu), 0.5, rtol=1e-14)
    np.testing.assert_allclose(jnp.sum(weight), 1.0, rtol=1e-9)
    table = np.asarray(legendre(jnp.asarray([0.3, 1.0]), 3, 5))
    sine = np.sqrt(1 - 0.09)
    np.testing.assert_allclose(table[0, :2, 0], [1.0, np.sqrt(3) * 0.3], rtol=1e-14)
    np.testing.assert_allclose(table[1, 2, 0], np.sqrt(5 / 6) * 3 * 0.3 * sine, rtol=1e-14)
    expected = np.sqrt(9 * 2 / 720) * 7.5 * (0.63 - 1) * sine**2
    np.testing.assert_allclose(table[2, 4, 0], expected, rtol=1e-13)
    assert (table[1:, :, 1] == 0).all()
    nodes, weights = (jnp.asarray(v) for v in double_gauss(8))
    basis = angular_basis(nodes, weights, 2, 16)
    for order in (0, 1):
        even = np.asarray(basis.turn[order].T @ basis.even[order])[:, :3]
        np.testing.assert_allclose(even.T @ even, np.eye(3), atol=1e-13)


def test_orthonormal_basis():
    """On nodes split at a surface: orthonormal, low degrees as they are, with the derivative of
    the index; degrees below the order and beyond the last stay empty."""

    def bases(index, streams=16, dtype=jnp.float64):
        mu, weight = snell_gauss(streams, jnp.asarray(index, dtype))
        return angular_basis(mu, weight, 4, 2 * (5 * streams // 8), orthonormal=True), mu, weight

    basis, mu, weight = bases(1.34)
    for order in (0, 1, 3):
        even = np.asarray(basis.turn[order].T @ basis.even[order])
        for columns in (even, np.asarray(basis.odd[order])):
            # Degrees order, order + 2, ... below 20.
            held = np.sum(columns**2, axis=0) > 0
            np.testing.assert_allclose(columns.T @ columns, np.diag(held.astype(float)), atol=1e-14)
        assert held.sum() == (20 - order) // 2
    # What the nodes integrate well is unchanged.
    plain = legendre(mu, 1, 20)[0] * jnp.sqrt(weight)[None, :]
    even = np.asarray(basis.turn[0].T @ basis.even[0])
    np.testing.assert_allclose(even[:, :5], plain[:10:2].T, atol=2e-3)
    assert np.abs(even - plain[::2].T).max() > 0.05
    single = bases(1.34, dtype=jnp.float32)[0]
    np.testing.assert_allclose(single.even, basis.even, atol=2e-5)

    def number(index):
        found = bases(index)[0]
        return jnp.stack([jnp.sum(jnp.sin(v)) for v in (found.even, found.odd)])

    slope = jax.jit(jax.jacrev(number))(1.34)
    step = 1e-4
    difference = (number(1.34 + step) - number(1.34 - step)) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(number))(1.34), slope, rtol=1e-9)
