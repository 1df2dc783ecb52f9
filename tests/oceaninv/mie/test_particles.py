"""Populations of spheres against references, moments, mixing rules and differences."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oceaninv.mie import _frisvad2007_table, particles, sphere
from tests.paths import REFERENCE

REFERENCE_FILE = REFERENCE / "natural_waters.json"
WAVELENGTH = np.array([450.0, 550.0, 650.0])


def test_index_and_absorption_are_inverse():
    k = particles.index_from_absorption(np.array([0.02, 3.0]), WAVELENGTH[:2])
    np.testing.assert_allclose(k, np.array([0.02, 3.0]) * [450e-9, 550e-9] / (4 * np.pi))
    index = 1.34 + 1j * np.asarray(k)
    back = particles.absorption_from_index(index, WAVELENGTH[:2])
    np.testing.assert_allclose(back, [0.02, 3.0], rtol=1e-14)
    assert particles.index_from_absorption(np.float32(1.0), 500.0).dtype == jnp.float32


def _moment(sizes, power, count=2000):
    radius, weight = sizes.nodes(count)
    return float(jnp.sum(weight * radius**power))


@pytest.mark.parametrize(("mean_of", "order"), [("number", 0), ("surface", 2), ("volume", 3)])
def test_log_normal_has_the_mean_and_width_asked_for(mean_of, order):
    sizes = particles.LogNormal(0.7, 0.4, mean_of, minimum=1e-4, maximum=1e3)
    mean = _moment(sizes, order + 1) / _moment(sizes, order)
    assert mean == pytest.approx(0.7, rel=1e-10)
    square = _moment(sizes, order + 2) / _moment(sizes, order)
    assert np.sqrt(square / mean**2 - 1) == pytest.approx(0.4, rel=1e-9)
    assert float(sizes.mean(mean_of)) == pytest.approx(0.7, rel=1e-14)


def test_default_limits_of_the_log_normal_hold_all_but_a_trace_of_the_volume():
    default = particles.LogNormal(0.7, 0.4)
    wide = particles.LogNormal(0.7, 0.4, minimum=1e-4, maximum=1e3)
    assert _moment(default, 3) == pytest.approx(_moment(wide, 3), rel=5e-8)
    assert _moment(default, 5) == pytest.approx(_moment(wide, 5), rel=1e-5)


def test_bounded_log_normal_has_the_mean_asked_for():
    sizes = particles.BoundedLogNormal(0.043, 0.5, maximum=0.15)
    assert _moment(sizes, 3) / _moment(sizes, 2) == pytest.approx(0.043, rel=1e-7)
    assert float(sizes.nodes(50)[0].max()) < 0.15


@pytest.mark.parametrize("density_of", ["number", "volume"])
def test_tabulated_density_reproduces_the_law_it_tabulates(density_of):
    radius = np.geomspace(0.1, 10.0, 400)
    density = radius ** (-3.5 if density_of == "number" else -0.5)
    table = particles.Tabulated(radius, density, density_of)
    law = particles.PowerLaw(3.5, 0.1, 10.0)
    for power in (2, 4):
        assert _moment(table, power) / _moment(table, 3) == pytest.approx(
            _moment(law, power) / _moment(law, 3), rel=1e-4
        )


def test_equivalent_spheres_of_ellipsoids():
    """Area and volume by quadrature over the surface of revolution; a sphere where aspect = 1."""
    for aspect in (1.0, 1.0004, 1.5, 20.0):
        length, half = 3.0, 1.5
        nodes, weights = np.polynomial.legendre.leggauss(200)
        width = half / aspect
        # z = half cos t, rho = width sin t
        t, w = np.pi / 2 * (nodes + 1), np.pi / 2 * weights
        line = np.sqrt((half * np.sin(t)) ** 2 + (width * np.cos(t)) ** 2)
        area = 2 * np.pi * np.sum(w * width * np.sin(t) * line)
        volume = 4 / 3 * np.pi * half * width**2
        radius, number = particles.ellipsoid_spheres(jnp.asarray(length), jnp.asarray(aspect))
        assert float(radius) == pytest.approx(3 * volume / area, rel=1e-12)
        assert float(number) == pytest.approx(volume / (4 / 3 * np.pi * float(radius) ** 3))
    slope = jax.grad(lambda a: particles.ellipsoid_spheres(jnp.asarray(3.0), a)[0])(1.0)
    assert float(slope) == pytest.approx(-1.5 * 2 / 3, rel=1e-9)  # r = l/(1 + a + ...) at 1


def test_equivalent_spheres_of_cylinders_conserve_volume_and_area():
    length, aspect = jnp.asarray(4.0), jnp.asarray(5.0)
    radius, number = particles.cylinder_spheres(length, aspect)
    rim = 4.0 / 5.0 / 2
    assert float(number * radius**3) * 4 / 3 == pytest.approx(rim**2 * 4.0, rel=1e-14)
    assert float(number * radius**2) * 4 == pytest.approx(2 * rim * 4.0 + 2 * rim**2, rel=1e-14)


def test_populations_of_other_shapes_keep_their_largest_sphere_and_volume():
    lengths = particles.PowerLaw(2.0, 1.0, 30.0)

    def needle(length):
        return particles.cylinder_spheres(length, jnp.full_like(length, 10.0))

    sizes = particles.EquivalentSpheres(lengths, needle)
    radius, weight = sizes.nodes(500)
    assert float(radius.max()) == pytest.approx(3 * 30 / 42, rel=1e-6)
    assert sizes.largest >= float(radius.max())
    length, count = lengths.nodes(500)
    volume = jnp.sum(count * np.pi / 4 * length**3 / 100)
    assert float(jnp.sum(weight * radius**3) * 4 / 3 * np.pi) == pytest.approx(float(volume))


def _small(mean=0.3, fraction=1e-5, radii=60, index=1.5 + 1e-3j):
    sizes = particles.LogNormal(mean, 0.3, minimum=0.05, maximum=2.0)
    return particles.Population(index, sizes, fraction, radii)


def test_narrow_population_is_number_density_times_cross_section():
    sizes = particles.LogNormal(0.5, 1e-4)
    bulk = particles.Population(1.5 + 1e-3j, sizes, 1e-6, 60).bulk(WAVELENGTH, 1.34 + 1e-9j)
    c = sphere.cross_sections(0.5, WAVELENGTH, 1.5 + 1e-3j, 1.34 + 1e-9j)
    density = 1e-6 / (4 / 3 * np.pi * 0.5**3) * 1e6
    np.testing.assert_allclose(bulk.b, density * c.scattering, rtol=1e-6)
    np.testing.assert_allclose(bulk.c, density * c.extinction, rtol=1e-6)
    np.testing.assert_allclose(bulk.g, c.asymmetry, rtol=1e-6)


def test_effective_index_follows_maxwell_garnett():
    """Tiny spheres: eq 33 with the sign of exp(-i w t), and eq 6 for the imaginary part."""
    fraction, particle, host = 1e-3, 1.5 + 0.02j, 1.33
    sizes = particles.LogNormal(0.004, 0.1, maximum=0.01)
    population = particles.Population(particle, sizes, fraction, 60)
    medium = particles.medium(WAVELENGTH, host + 0j, [population])
    index = np.asarray(particles.effective_index(WAVELENGTH, host + 0j, medium))
    polarisable = (particle**2 - host**2) / (particle**2 + 2 * host**2)
    expected = host * np.sqrt((1 + 2 * fraction * polarisable) / (1 - fraction * polarisable))
    shift = expected - host
    np.testing.assert_allclose(index.real - host, shift.real, rtol=5e-3)
    np.testing.assert_allclose(index.imag, shift.imag, rtol=5e-3)


def test_phase_function_of_a_population_has_integral_one_and_mean_cosine_g():
    nodes, weights = np.polynomial.legendre.leggauss(80)
    population = _small(radii=20)
    phase = population.phase_function(nodes, WAVELENGTH, 1.34 + 0j)
    np.testing.assert_allclose(2 * np.pi * weights @ phase, 1.0, rtol=1e-11)
    g = population.bulk(WAVELENGTH, 1.34 + 0j).g
    np.testing.assert_allclose(2 * np.pi * (weights * nodes) @ phase, g, rtol=1e-11)


def test_mixtures_add_and_the_host_absorbs():
    one, two = _small(), _small(0.5, 2e-5)
    host = 1.34 + 1e-8j
    parts = [p.bulk(WAVELENGTH, host) for p in (one, two)]
    total = particles.medium(WAVELENGTH, host, [one, two])
    np.testing.assert_allclose(total.b, parts[0].b + parts[1].b)
    own = particles.absorption_from_index(host, WAVELENGTH)
    np.testing.assert_allclose(total.a, own + parts[0].a + parts[1].a)
    cosine = sum(p.b * p.g for p in parts)
    np.testing.assert_allclose(total.g, cosine / total.b)
    alone = particles.medium(WAVELENGTH, host, [])
    np.testing.assert_allclose(alone.a, own)
    assert (np.asarray(alone.b) == 0).all()


@pytest.mark.slow
def test_gradients_in_size_amount_and_index():
    """Forward and reverse against differences, through quadrature and series."""

    def scattering(p):
        population = _small(p[0], p[1] * 1e-5, 30, jax.lax.complex(p[2], p[3]))
        bulk = population.bulk(WAVELENGTH, 1.34 + 0j)
        return jnp.sum(bulk.b * bulk.g) + jnp.sum(bulk.a)

    point = jnp.array([0.3, 1.0, 1.5, 1e-3])
    function = jax.jit(scattering)
    gradient = jax.jit(jax.grad(scattering))(point)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(scattering))(point), gradient, rtol=1e-11)
    for k in range(4):
        step = jnp.zeros(4).at[k].set(1e-6)
        difference = (function(point + step) - function(point - step)) / 2e-6
        np.testing.assert_allclose(gradient[k], difference, rtol=3e-8)


def _natural_water(name, radii):
    reference = json.loads(REFERENCE_FILE.read_text())
    wavelength = np.array(reference["wavelength_nm"], float)
    water = reference["waters"][name]
    kinds = (
        ("algae", particles.PowerLaw(3.6, 0.225, 100.0), water["v_algal"]),
        ("mineral", particles.PowerLaw(3.4, 0.01, 100.0), water["v_mineral"]),
    )
    populations = [
        particles.Population(_frisvad2007_table.index(kind, wavelength), sizes, fraction, radii)
        for kind, sizes, fraction in kinds
    ]
    bulk = particles.medium(wavelength, _frisvad2007_table.index("brine", wavelength), populations)
    pairs = ((bulk.a, "sigma_a"), (bulk.b, "sigma_s"), (bulk.g, "g"))
    return bulk, max(np.abs(np.asarray(v) / np.array(water[k]) - 1).max() for v, k in pairs)


@pytest.mark.parametrize("name", ["Atlantic", "North Sea"])
@pytest.mark.parametrize(
    ("radii", "tolerance"), [(400, 6e-4), pytest.param(3200, 5e-5, marks=pytest.mark.slow)]
)
def test_natural_waters(name, radii, tolerance):
    bulk, error = _natural_water(name, radii)
    assert error < tolerance
    # The reported error is of the size of the true one.
    reported = max(float((bulk.a_error / bulk.a).max()), float((bulk.b_error / bulk.b).max()))
    assert error / 4 < reported < 20 * error


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: particles.LogNormal(-1.0, 0.5), "mean must be finite and positive"),
        (lambda: particles.LogNormal(1.0, 0.5, "area"), "mean_of must be one of"),
        (lambda: particles.LogNormal(1.0, 0.5, minimum=2.0, maximum=1.0), "minimum < maximum"),
        (lambda: particles.PowerLaw(3.0, 0.0, 1.0), "0 < minimum"),
        (lambda: particles.BoundedLogNormal(0.2, 0.5, 0.15), "mean must be below maximum"),
        (lambda: particles.Tabulated([1.0, 0.5], np.ones(2)), "rise strictly"),
        (lambda: particles.Tabulated([1.0, 2.0], np.zeros(2)), "positive value"),
        (lambda: _small(fraction=1.5), "volume_fraction must be between 0 and 1"),
        (lambda: _small(radii=2).bulk(WAVELENGTH, 1.34), "number of radii"),
        (lambda: _small().bulk(WAVELENGTH, 1.34 - 1e-3j), "host_index must be n"),
        (lambda: _small().bulk([600.0, 500.0], 1.34), "wavelength"),
    ],
)
def test_bad_input_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_traced_log_normal_needs_limits():
    with pytest.raises(ValueError, match="minimum and maximum"):
        eqx.filter_jit(lambda mean: particles.LogNormal(mean, 0.5))(jnp.asarray(1.0))
