"""Lorenz-Mie against 25-digit references, mpmath, limits and conservation laws."""

import functools
import json
import warnings

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from oceaninv.mie import sphere
from tests.paths import REFERENCE

ANGLES = (0, 30, 90, 180)
COSINES = np.array([1.0, np.sqrt(0.75), 0.0, -1.0])


def _load(name):
    return json.loads((REFERENCE / name).read_text())


def _number(value):
    return complex(*map(float, value)) if isinstance(value, list) else float(value)


def _rows(kind):
    rows = [r for r in _load("mie.json")["rows"] if r["kind"] == kind]
    inputs = {k: np.array([_number(r["inputs"][k]) for r in rows]) for k in rows[0]["inputs"]}
    keys = [k for k, v in rows[0]["outputs"].items() if k not in ("N", "x", "y")]
    outputs = {k: np.array([_number(r["outputs"][k]) for r in rows]) for k in keys}
    return inputs, outputs


def _error(value, reference):
    return np.abs(np.asarray(value).astype(float) / reference - 1)


@pytest.fixture(scope="module")
def xm():
    return _rows("xm")


@pytest.fixture(scope="module")
def phys():
    return _rows("phys")


@pytest.mark.parametrize("host", ["real", "complex"])
def test_efficiencies_match_the_references(xm, host):
    """x from 1e-4 to 1e4 in one batch; both the real and the complex arithmetic of the host."""
    inputs, outputs = xm
    x, m = inputs["x"], inputs["m"]
    if host == "real":
        values = sphere.efficiencies(x, m)
    else:
        c = sphere.cross_sections(x / 2.0, 1000.0 * np.pi, m, 1.0 + 0.0j)
        area = np.pi * (x / 2.0) ** 2
        values = c.extinction / area, c.scattering / area, c.asymmetry
    for value, key in zip(values, ("Qext", "Qsca", "g"), strict=True):
        error = _error(value, outputs[key])
        assert error[np.abs(m - 1) >= 0.03].max() < 2e-13
        assert error.max() < 1e-11


def test_cross_sections_match_the_references(phys):
    inputs, outputs = phys
    with pytest.warns(sphere.AbsorbingHostWarning, match="alpha"):
        c = sphere.cross_sections(
            inputs["r_um"], 1e3 * inputs["lambda_um"], inputs["eta_p"], inputs["eta_med"]
        )
    for value, key in zip(c, ("Ct", "Cs", "g"), strict=True):
        assert _error(value, outputs[key]).max() < 2e-14
    assert (np.asarray(c.extinction) < 0).any()  # a small particle in an absorbing host


def test_amplitudes_and_phase_function_match_the_references(phys):
    inputs, outputs = phys
    arguments = (
        inputs["r_um"],
        1e3 * inputs["lambda_um"],
        inputs["eta_p"],
        inputs["eta_med"],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", sphere.AbsorbingHostWarning)
        amplitudes = sphere.amplitudes(COSINES[:, None], *arguments)
        phase = np.asarray(sphere.phase_function(COSINES[:, None], *arguments))
        forward = np.asarray(sphere.sections_and_forward(*arguments)[1])
    scale = np.abs(outputs["S1_0"])
    for i, angle in enumerate(ANGLES):
        for name, value in zip(("S1", "S2"), amplitudes, strict=True):
            error = np.abs(np.asarray(value)[i] - outputs[f"{name}_{angle}"])
            assert (error / scale).max() < 3e-12
        assert _error(phase[i], outputs[f"p_{angle}"]).max() < 3e-10
    np.testing.assert_allclose(4 * np.pi * forward.real, outputs["Ct"], rtol=2e-14)
    # Where it refracts strongly enough not to be the small rest of a large extinction.
    refracts = np.abs(outputs["ImS0_over_k2"]) > 1e-3 * np.abs(outputs["Ct"])
    assert _error(forward.imag, outputs["ImS0_over_k2"])[refracts].max() < 1e-11


def test_published_values():
    """Bohren & Huffman (1983) and Wiscombe's MIEV0 cases, as printed."""
    checks = _load("mie.json")["published_checks"]
    x = np.array([float(c["x"]) for c in checks])
    m = np.array([_number(c["m"]) for c in checks])
    values = dict(zip(("Qext", "Qsca", "g"), sphere.efficiencies(x, m), strict=True))
    for i, check in enumerate(checks):
        for key in values.keys() & check["published"].keys():
            digits = check.get("tolerance", 1.01e-4)
            assert abs(float(values[key][i]) - check["published"][key]) <= digits


def _stacked(p, wavelength):
    host, particle = jax.lax.complex(p[1], p[2]), jax.lax.complex(p[3], p[4])
    return jnp.stack(sphere.cross_sections(p[0], wavelength, particle, host, max_size=200.0))


@pytest.mark.parametrize("mode", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.slow)])
def test_derivatives_match_the_references(mode):
    """d(Ct, Cs, g)/d(radius, Re and Im of both indices) against 70-digit differences."""
    rows = _load("mie_gradients.json")["rows"]
    jacobian = jax.jit(jax.vmap(mode(_stacked)))
    points = [[r["inputs"]["r_um"], *r["inputs"]["eta_med"], *r["inputs"]["eta_p"]] for r in rows]
    wavelength = jnp.array([1e3 * r["inputs"]["lambda_um"] for r in rows])
    value = np.asarray(jacobian(jnp.array(points), wavelength))
    names = ("r", "re_eta_med", "im_eta_med", "re_eta_p", "im_eta_p")
    reference = [[[float(r["grad"][n][q]) for n in names] for q in ("Ct", "Cs", "g")] for r in rows]
    assert _error(value, np.array(reference)).max() < 1e-12


@pytest.mark.slow
def test_derivatives_in_a_strongly_absorbing_host():
    """Beyond Im x = 1/2 another second solution and another scale take over."""
    point = jnp.array([2.0, 1.34, 0.1, 1.5, 0.02])  # Im x = 2.5
    jacobian = jax.jit(jax.jacfwd(_stacked))(point, jnp.asarray(500.0))
    function = jax.jit(_stacked)
    for k in range(5):
        step = jnp.zeros(5).at[k].set(1e-5)
        ahead, behind = function(point + step, 500.0), function(point - step, 500.0)
        np.testing.assert_allclose(jacobian[:, k], (ahead - behind) / 2e-5, rtol=2e-7)


def _mpmath_sphere(x, m, terms):
    """Eqs 9, 10, 22, 23 and 26 as they stand, with zeta = z (j + iy): slow and exact."""
    x, m = mp.mpmathify(x), mp.mpmathify(m)

    def riccati(z, kind):
        j = [mp.sqrt(mp.pi * z / 2) * mp.besselj(n + mp.mpf(1) / 2, z) for n in range(terms + 1)]
        if kind == "psi":
            return j
        y = [mp.sqrt(mp.pi * z / 2) * mp.bessely(n + mp.mpf(1) / 2, z) for n in range(terms + 1)]
        return [p + 1j * q for p, q in zip(j, y, strict=True)]

    def slope(f, z):
        return [None] + [f[n - 1] - n * f[n] / z for n in range(1, terms + 1)]

    P, p, z = riccati(m * x, "psi"), riccati(x, "psi"), riccati(x, "zeta")
    dP, dp, dz = slope(P, m * x), slope(p, x), slope(z, x)
    orders = range(1, terms + 1)
    a = [(dP[n] * p[n] - m * P[n] * dp[n]) / (dP[n] * z[n] - m * P[n] * dz[n]) for n in orders]
    b = [(m * dP[n] * p[n] - P[n] * dp[n]) / (m * dP[n] * z[n] - P[n] * dz[n]) for n in orders]
    weights = [2 * n + 1 for n in orders]
    amplitude = mp.fsum(w * (u + v) for w, u, v in zip(weights, a, b, strict=True))
    power = mp.fsum(w * (abs(u) ** 2 + abs(v) ** 2) for w, u, v in zip(weights, a, b, strict=True))
    cosine = mp.fsum(
        mp.mpf(n * (n + 2)) / (n + 1) * mp.re(a[n - 1] * mp.conj(a[n]) + b[n - 1] * mp.conj(b[n]))
        for n in orders[:-1]
    ) + mp.fsum(
        mp.mpf(2 * n + 1) / (n * (n + 1)) * mp.re(a[n - 1] * mp.conj(b[n - 1])) for n in orders
    )
    return amplitude, power, 2 * cosine / power


@pytest.mark.parametrize(
    ("radius", "particle", "host"),
    [
        (1.0, 1.5 + 0.02j, 1.34 + 0.8j),  # Im x = 10: psi and zeta differ by e^20
        (0.5, 1.2, 1.34 + 0.16j),  # Im x just above 1
        (0.5, 1.6 + 0.3j, 1.34 + 0.079j),  # Im x just below 1/2
        (0.5, 1.6 + 0.3j, 1.34 + 0.081j),  # just above
        (1.25, 1.5, 1.0),  # x = 5 pi: psi_0 vanishes
    ],
)
def test_against_mpmath(radius, particle, host):
    """Absorbing hosts far beyond the references, and x = k pi."""
    wavelength = 500.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", sphere.AbsorbingHostWarning)
        c = sphere.cross_sections(radius, wavelength, particle, host)
    with mp.workdps(60):
        k0 = 2 * mp.pi * mp.mpf(radius) / (mp.mpf(wavelength) / 1000)
        amplitude, power, g = _mpmath_sphere(k0 * host, mp.mpc(particle) / mp.mpc(host), 45)
        alpha = 2 * k0 * mp.mpf(np.imag(host))
        gamma = 2 * (1 + (alpha - 1) * mp.exp(alpha)) / alpha**2 if alpha else mp.mpf(1)
        area = 2 * mp.pi * mp.mpf(radius) ** 2 / k0**2
        extinction = area * mp.re(amplitude / mp.mpc(host) ** 2)
        scattering = area * mp.exp(-alpha) / gamma * power / abs(mp.mpc(host)) ** 2
    expected = np.array([float(extinction), float(scattering), float(g)])
    np.testing.assert_allclose(np.array(c), expected, rtol=1e-13)


def test_mixed_sizes_in_one_batch_stay_finite():
    """Sizes from 0 to 1e4 side by side, each as if it were alone."""
    x = np.concatenate([[0.0], np.geomspace(1e-30, 1e4, 40)])
    for m in (1.5 + 0j, 1.33 + 1e-5j, 0.75 + 0j, 3.0 + 4.0j):
        batch = np.array(sphere.efficiencies(x, m))
        assert np.isfinite(batch).all()
        assert (batch[:2, x > 1e-20] > 0).all()
        assert (batch[:, 0] == 0).all()
        alone = np.array([sphere.efficiencies(v, m) for v in x[[10, 38]]]).T
        np.testing.assert_allclose(batch[:, [10, 38]], alone, rtol=1e-13)


def test_rayleigh_limit():
    """Q of small spheres: 8/3 x^4 |K|^2 and 4 x Im K, K = (m^2 - 1)/(m^2 + 2); below 1e-25 too."""
    x = np.array([1e-30, 1e-12, 1e-6, 1e-5])
    for m in (1.5, 1.2 + 0.1j):
        K = (m * m - 1) / (m * m + 2)
        q_ext, q_sca, g = (np.asarray(v) for v in sphere.efficiencies(x, m))
        scattering = 8 / 3 * x**4 * abs(K) ** 2
        np.testing.assert_allclose(q_sca, scattering, rtol=1e-9)
        # To relative order x^2 = 1e-10; below 1e-25 scattering is lost beside absorption's form.
        resolved = slice(0, None) if np.imag(m) else slice(1, None)
        total = 4 * x * np.imag(K) + scattering
        np.testing.assert_allclose(q_ext[resolved], total[resolved], rtol=1e-9)
        assert (np.abs(g) < x**2).all()


def test_gradient_at_zero_radius():
    """Value and slope vanish at radius 0; the slope just above follows r^3 of absorption."""

    def extinction(radius):
        return sphere.cross_sections(radius, 500.0, 1.5 + 0.1j, 1.34, max_size=1.0).extinction

    slope = jax.jit(jax.vmap(jax.grad(extinction)))(jnp.array([0.0, 1e-32, 1e-5]))
    assert slope[0] == 0
    assert np.isfinite(slope).all()
    np.testing.assert_allclose(slope[2], 3 * extinction(1e-5) / 1e-5, rtol=1e-6)


@pytest.mark.slow
def test_energy_is_conserved_and_large_spheres_remove_twice_their_area():
    x = np.geomspace(1e-3, 2000.0, 60)
    q_ext, q_sca, _ = sphere.efficiencies(x, 1.4)
    np.testing.assert_allclose(q_ext, q_sca, rtol=1e-12)
    q_ext, q_sca, _ = sphere.efficiencies(x, 1.4 + 0.5j)
    assert (np.asarray(q_ext) > np.asarray(q_sca)).all()
    assert float(sphere.efficiencies(1e4, 1.4 + 0.5j)[0]) == pytest.approx(2.0, abs=6e-3)


@pytest.mark.parametrize("host", [1.34, pytest.param(1.34 + 0.01j, marks=pytest.mark.slow)])
def test_phase_function_integrates_to_one_with_mean_cosine_g(host):
    nodes, weights = np.polynomial.legendre.leggauss(120)
    radius = np.array([0.01, 0.3, 2.0])
    phase = np.asarray(sphere.phase_function(nodes[:, None], radius, 550.0, 1.5 + 0.01j, host))
    np.testing.assert_allclose(2 * np.pi * weights @ phase, 1.0, rtol=1e-11)
    g = sphere.cross_sections(radius, 550.0, 1.5 + 0.01j, host).asymmetry
    np.testing.assert_allclose(2 * np.pi * (weights * nodes) @ phase, g, rtol=1e-11)


@pytest.mark.slow
def test_phase_function_broadcasts_like_numpy():
    """Angles with or without an axis of their own give the same numbers."""
    radius, wavelength = np.array([0.2, 0.5, 1.0]), np.array([[450.0], [600.0]])
    cosine = np.linspace(-1, 1, 5)
    table = sphere.phase_function(cosine[:, None, None], radius, wavelength, 1.5, 1.34)
    assert table.shape == (5, 2, 3)
    single = sphere.phase_function(cosine, 0.5, 600.0, 1.5, 1.34)
    np.testing.assert_allclose(table[:, 1, 1], single, rtol=1e-13)
    paired = sphere.phase_function(cosine[:3], radius, wavelength, 1.5, 1.34)
    assert paired.shape == (2, 3)
    np.testing.assert_allclose(paired[0], np.asarray(table)[[0, 1, 2], 0, [0, 1, 2]], rtol=1e-13)


@pytest.mark.slow
def test_derivatives_of_the_phase_function():
    """In angle, radius and both parts of both indices, forward and reverse, against differences."""

    def phase(p):
        particle, host = jax.lax.complex(p[2], p[3]), jax.lax.complex(p[4], p[5])
        return sphere.phase_function(p[0], p[1], 550.0, particle, host, max_size=40.0)

    point = jnp.array([-0.3, 1.2, 1.5, 1e-3, 1.34, 1e-3])
    gradient = jax.jit(jax.grad(phase))(point)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(phase))(point), gradient, rtol=1e-12)
    function = jax.jit(phase)
    for k in range(6):
        step = jnp.zeros(6).at[k].set(1e-5)
        difference = (function(point + step) - function(point - step)) / 2e-5
        np.testing.assert_allclose(gradient[k], difference, rtol=2e-7)


def test_float32(xm):
    """Against the references' own inputs, rounded: float32 in, float32 out."""
    inputs, _ = xm
    x, m = inputs["x"].astype(np.float32), inputs["m"].astype(np.complex64)
    # Compiled as users' programs are, not as other tests: of 1e4 terms the rounding counts.
    within = functools.partial(sphere.efficiencies, max_size=float(x.max()))
    values = jax.jit(within, compiler_options={"xla_backend_optimization_level": 3})(x, m)
    exact = sphere.efficiencies(x.astype(float), m.astype(complex))
    apart = np.abs(m - 1) > 0.049
    for value, reference in zip(values, exact, strict=True):
        assert value.dtype == jnp.float32
        error = _error(value, np.asarray(reference))
        assert error[apart & (x >= 0.1) & (x <= 100)].max() < 7e-6
        assert error[apart & (x <= 1e4)].max() < 1e-5
    tiny = np.geomspace(1e-6, 1e-3, 12, dtype=np.float32)
    for m32 in (np.float32(1.33), np.complex64(1.33 + 0.01j)):
        q_ext, q_sca, g = sphere.efficiencies(tiny, m32)
        reference = sphere.efficiencies(tiny.astype(float), complex(m32))
        assert _error(q_ext, np.asarray(reference[0])).max() < 1e-5
        assert _error(q_sca, np.asarray(reference[1])).max() < 1e-5
        assert np.isfinite(g).all()
    c = sphere.cross_sections(np.float32(1.0), 550.0, 1.58 + 1e-4j, 1.34 + 1e-6j)
    assert {v.dtype for v in c} == {jnp.dtype("float32")}


def test_the_printed_sign_of_zeta_is_wrong():
    """Eq 8 with -i y would give a negative extinction for m = 1.5 + i, x = 1."""
    q_ext = float(sphere.efficiencies(1.0, 1.5 + 1.0j)[0])
    assert q_ext == pytest.approx(2.3363, abs=5e-5)
    with mp.workdps(30):  # zeta -> zeta with -i y is the conjugate problem of m -> conj m
        amplitude, _, _ = _mpmath_sphere(1.0, 1.5 - 1.0j, 20)
    assert float(2 * amplitude.real) == pytest.approx(-3.35, abs=5e-3)


def test_one_program_serves_every_size():
    sphere.cross_sections(np.full(9, 0.01), 550.0, 1.58, 1.34)
    programs = sphere._cross_sections._cache_size()
    for radius in (1e-4, 0.3, 7.0, 150.0):
        sphere.cross_sections(np.full(9, radius), 550.0, 1.58, 1.34)
    assert sphere._cross_sections._cache_size() == programs


@pytest.mark.slow
def test_jit_and_vmap_agree_with_the_plain_call():
    radius = np.geomspace(0.01, 10.0, 9)
    plain = np.array(sphere.cross_sections(radius, 550.0, 1.58 + 1e-3j, 1.34))

    def one(r):
        return sphere.cross_sections(r, 550.0, 1.58 + 1e-3j, 1.34, max_size=200.0)

    np.testing.assert_allclose(np.array(jax.jit(one)(radius)), plain, rtol=1e-13)
    np.testing.assert_allclose(np.array(jax.vmap(one)(radius)), plain, rtol=1e-13)


def test_bad_lanes_become_nan_inside_jit():
    radius = jnp.array([-1.0, 0.5, jnp.nan, 1e3])
    c = jax.jit(lambda r: sphere.cross_sections(r, 550.0, 1.58, 1.34, max_size=100.0))(radius)
    for value in c:
        np.testing.assert_array_equal(np.isnan(value), [True, False, True, True])


GOOD = {"radius": 1.0, "wavelength": 550.0, "particle_index": 1.5, "host_index": 1.34}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius": -1.0}, "radius must be at least 0"),
        ({"radius": np.array([1.0, np.nan])}, "radius must be finite"),
        ({"wavelength": 0.0}, "wavelength must be positive"),
        ({"particle_index": 1.5 - 0.1j}, r"particle_index must be n \+ ik with k >= 0"),
        ({"host_index": 1.34 - 1e-9j}, r"host_index must be n \+ ik"),
        ({"host_index": 0.0}, "host_index must be positive"),
        ({"radius": np.ones(2), "wavelength": np.full(3, 500.0)}, "do not broadcast: radius"),
        ({"host_index": 1.34 + 1e-2j, "radius": 1e4}, "overflows float64 at Im x"),
        ({"max_size": 1.0}, "max_size must be at least"),
    ],
)
def test_bad_input_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        sphere.cross_sections(**(GOOD | change))


def test_bad_input_of_efficiencies_and_phase_function():
    with pytest.raises(ValueError, match="x must be at least 0"):
        sphere.efficiencies(-1.0, 1.5)
    with pytest.raises(ValueError, match=r"m must be n \+ ik"):
        sphere.efficiencies(1.0, 1.5 - 1j)
    with pytest.raises(ValueError, match="cos_theta must be a cosine"):
        sphere.phase_function(1.5, **GOOD)
    with pytest.raises(ValueError, match="max_size"):
        jax.jit(lambda x: sphere.efficiencies(x, 1.5))(1.0)
