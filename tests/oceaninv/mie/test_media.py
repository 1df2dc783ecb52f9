"""Recipes of media against the paper's own numbers, and as IOPs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oceaninv.mie import media, particles
from oceaninv.water import phase

WAVELENGTH = np.array([450.0, 550.0, 650.0])


@pytest.fixture(scope="module")
def north_sea():
    return media.natural_water("North Sea", radii=60)


@pytest.mark.slow
def test_every_sea_has_the_coefficients_of_its_volume_fractions():
    """Scattering is linear in the volume fractions; the clearest sea is the bluest."""
    seas = {name: media.natural_water(name, radii=60).bulk(WAVELENGTH) for name in media.SEAS}
    unit = [
        media.natural_water(algae=a, minerals=m, radii=60).bulk(WAVELENGTH)
        for a, m in ((1e-6, 0.0), (0.0, 1e-6))
    ]
    for name, (algae, minerals) in media.SEAS.items():
        expected = (algae * unit[0].b + minerals * unit[1].b) / 1e-6
        np.testing.assert_allclose(seas[name].b, expected, rtol=1e-12)
    slope = {name: float(s.a[0] / s.a[2]) for name, s in seas.items()}
    assert min(slope, key=slope.get) == "Atlantic"
    assert max(slope, key=slope.get) == "North Sea"


def test_effective_index_of_sea_water(north_sea):
    index = np.asarray(north_sea.effective_index(WAVELENGTH))
    shift = index.real - 1.34
    # Particles are denser optically than water: a rise of about contrast times volume fraction.
    contrast = 2.171e-6 * (1.41 - 1.34) + 2.077e-6 * (1.58 - 1.34)
    assert (shift > 0).all()
    assert (shift < 2 * contrast).all()
    bulk = north_sea.bulk(WAVELENGTH)
    np.testing.assert_allclose(4e9 * np.pi * index.imag / WAVELENGTH, bulk.a, rtol=1e-12)


@pytest.fixture(scope="module")
def water_iops(north_sea):
    """IOPs on a grid that contains the anchors of 3 shapes, and between them."""
    return north_sea.iops(np.array([400.0, 475.0, 550.0, 625.0, 700.0]), shapes=3)


def test_iops_add_up_to_the_bulk_coefficients(north_sea, water_iops):
    bulk = north_sea.bulk(water_iops.wavelength)
    np.testing.assert_allclose(water_iops.a, bulk.a, rtol=1e-12)
    np.testing.assert_allclose(water_iops.b, bulk.b, rtol=1e-12)
    assert (np.asarray(water_iops.b_components) >= 0).all()
    assert water_iops.scatterers[0] == "algae 400 nm"
    # The mixture's mean cosine is the bulk's: exact at the anchors, and linear between them.
    moments = water_iops.scattering_moments(1)
    np.testing.assert_allclose(moments[1] / moments[0], bulk.g, rtol=6e-3)


@pytest.mark.slow
def test_error_of_the_mixture_of_shapes(north_sea):
    """Phase function between the anchors of 1, 2 and 3 shapes against the true one there."""
    grid = np.linspace(400.0, 700.0, 7)
    exact = north_sea.iops(grid, shapes=7)
    ratio = np.asarray(exact.bb / exact.b)
    cosine = jnp.cos(jnp.linspace(0.1, 3.1, 40))
    true = np.asarray(exact.volume_scattering(cosine))
    worst = {}
    for shapes in (1, 2, 3):
        iops = north_sea.iops(grid, shapes=shapes)
        worst[shapes] = (
            np.abs(np.asarray(iops.bb / iops.b) / ratio - 1).max(),
            np.abs(np.asarray(iops.volume_scattering(cosine)) / true - 1).mean(),
        )
    assert worst[1][0] > worst[2][0] > worst[3][0]
    assert worst[2][0] < 0.03
    assert worst[3][0] < 0.01
    assert worst[3][1] < 0.02


@pytest.mark.slow
def test_lobe_fits_keep_the_mean_cosine(north_sea, water_iops):
    """Two and three Henyey-Greenstein lobes: same g, p within a factor of 4 over 5-175 degrees."""
    table = water_iops.phases[-1]
    cosine = jnp.cos(jnp.radians(jnp.linspace(5.0, 175.0, 35)))
    misfit = {}
    for lobes in (2, 3):
        fitted = media.fit_lobes(table, lobes)
        assert len(fitted.phases) <= lobes
        assert float(fitted.moments(1)[1]) == pytest.approx(float(table.moments(1)[1]), abs=1e-5)
        misfit[lobes] = float(jnp.abs(jnp.log(fitted(cosine) / table(cosine))).max())
    assert misfit[3] < misfit[2] < 1.4
    simple = north_sea.iops(WAVELENGTH, shapes=1, fit=media.fit_lobes)
    assert isinstance(simple.phases[0], phase.Mixture)


def test_milk_scatters_as_the_fitted_model_says():
    """Fat of whole milk against eq 40: within 5 % at 3.5 wt-% in the green, 12 % in red and blue,
    which are broad bands here seen at single wavelengths."""
    ours = media.milk(3.5, 0.0, radii=60).bulk(np.array([450.0, 550.0, 600.0]))
    _, b, g = media.milk_fit(3.5, 0.0)
    ratio = np.asarray(ours.b)[::-1] / np.asarray(b)
    assert abs(ratio[1] - 1) < 0.05
    assert np.abs(ratio - 1).max() < 0.12
    np.testing.assert_allclose(np.asarray(ours.g)[::-1], g, rtol=0.012)


def test_casein_width_matches_the_mean_cosine_of_the_fitted_model():
    ours = media.milk(0.0, 1.0, radii=60).bulk(np.array([450.0, 550.0, 600.0]))
    _, b, g = media.milk_fit(0.0, 1.0)
    np.testing.assert_allclose(np.asarray(ours.g)[::-1], g, rtol=0.1)
    # Scattering is known to come out higher than eq 40 at any width.
    ratio = np.asarray(ours.b)[::-1] / np.asarray(b)
    assert ((ratio > 1.3) & (ratio < 1.65)).all()


def test_fitted_milk_model():
    a, b, g = media.milk_fit(0.0, 3.0)
    np.testing.assert_allclose(b, [640.5, 1014.9, 1842.0], rtol=1e-12)
    np.testing.assert_allclose(g, [18.63 / 213.5, 37.79 / 338.3, 96.69 / 614.0], rtol=1e-12)
    np.testing.assert_allclose(a[0], 1.381 - 3 * 0.0086, rtol=1e-12)
    # At 1 wt-% of fat all logarithms vanish.
    a, b, g = media.milk_fit(1.0, 0.0)
    np.testing.assert_allclose(b, [15631.0, 18349.0, 22585.0], rtol=1e-12)
    np.testing.assert_allclose(g, [0.9576, 0.9585, 0.9577], rtol=1e-12)
    below, above = (np.asarray(media.milk_fit(f, 3.0)[2]) for f in (0.7 - 1e-9, 0.7))
    np.testing.assert_allclose(below, above, rtol=5e-3)  # the two pieces nearly meet
    slopes = jax.jacfwd(lambda f: jnp.stack(media.milk_fit(f, 3.0)))(0.0)
    assert np.isfinite(slopes).all()
    assert (np.asarray(media.milk_fit(0.0, 0.0)[1]) == 0).all()


def test_fat_globule_size_and_volume_fractions_as_printed():
    assert float(media.fat_globule_mean(1.0)) == pytest.approx(1.419 - 0.2528)
    assert float(media.fat_globule_mean(4.0)) == pytest.approx(1.456 * 4**0.36)
    jump = float(media.fat_globule_mean(2.0) / media.fat_globule_mean(2.0 - 1e-12))
    assert jump == pytest.approx(1.023, abs=5e-4)
    fat, casein = media.milk_volume_fractions(3.5, 3.0)
    assert float(fat) == pytest.approx(3.5 / 0.915 / (100 / 1.03))
    assert float(casein) == pytest.approx(0.76 * 3.0 / 1.11 / (100 / 1.03))


def test_brine_aspect_never_falls_below_a_sphere():
    length = jnp.array([1.0, 30.5, 31.0, 500.0, 14600.0])
    aspect = np.asarray(media.brine_aspect(length))
    assert (aspect >= 1).all()
    assert 10.3 * 0.0305**0.67 < 1  # what is printed
    np.testing.assert_allclose(aspect[3:], 10.3 * np.array([0.5, 14.6]) ** 0.67)


def test_pure_ice_only_absorbs():
    bulk = media.ice().bulk(WAVELENGTH)
    np.testing.assert_allclose(
        bulk.a, 4e9 * np.pi * media.ice().host_index(WAVELENGTH).imag / WAVELENGTH
    )
    assert (np.asarray(bulk.b) == 0).all()


@pytest.mark.slow
def test_large_inclusions_scatter_twice_their_projected_area():
    """Air bubbles (0.1-2 mm) and brine: b near 2 x area per volume (Q = 2), air brightest."""
    wavelength = np.array([775.0])
    air = media.ice(air=1e-3, radii=12).bulk(wavelength)
    sizes = media.ice(air=1e-3).inclusions[0].sizes
    radius, weight = sizes.nodes(12)
    area = float(jnp.sum(weight * radius**2) / jnp.sum(weight * radius**3)) * 0.75e-3 * 1e6
    assert float(air.b[0]) == pytest.approx(2 * area, rel=0.02)
    brine = media.ice(brine=1e-3, radii=24)
    assert [i.substance for i in brine.inclusions] == ["brine"] * 3
    bulk = brine.bulk(wavelength)
    areas = []
    for inclusion in brine.inclusions:
        radius, weight = inclusion.sizes.nodes(24)
        ratio = jnp.sum(weight * radius**2) / jnp.sum(weight * radius**3)
        areas.append(float(inclusion.volume_fraction * ratio) * 0.75e6)
    assert float(bulk.b[0]) == pytest.approx(2 * sum(areas), rel=0.05)
    assert float(bulk.g[0]) > 0.98 > float(air.g[0])


def _as_spheres_of_its_volume(shape):
    """Lengths to spheres of equal volume: pi/6 l^3/gamma^2 (ellipsoid), pi/4 l^3/gamma^2."""

    def spheres(length):
        volume = (np.pi / 6 if shape == "ellipsoid" else np.pi / 4) * length**3
        volume = volume / media.brine_aspect(length) ** 2
        return (volume * (3 / (4 * np.pi))) ** (1 / 3), jnp.ones_like(length)

    return spheres


@pytest.mark.slow
def test_brine_as_bubbles_outshines_equivalent_spheres_and_these_spheres_of_equal_volume():
    """Reduced scattering of first-year ice (v_air 0.006, v_brine 0.02): the paper's ranking, 30 >
    8.1 > 6.4 1/m.  Its 8.1 cannot be reproduced with the inputs it lists: they give 2.6."""
    wavelength, air, brine = np.array([650.0]), 0.006, 0.02
    ours = media.ice(air=air, brine=brine, radii=24)
    bubbles, ellipsoids, cylinders = ours.inclusions[1:]
    assert [float(i.volume_fraction / brine) for i in ours.inclusions[1:]] == pytest.approx(
        [0.02, 0.06, 0.92]
    )
    by_volume = [
        media.Inclusion(
            "brine",
            particles.EquivalentSpheres(part.sizes.lengths, _as_spheres_of_its_volume(shape)),
            part.volume_fraction,
        )
        for shape, part in (("ellipsoid", ellipsoids), ("cylinder", cylinders))
    ]
    all_bubbles = media.Inclusion("brine", bubbles.sizes, brine)
    media_of = {
        "bubbles": (all_bubbles,),
        "equivalent": ours.inclusions[1:],
        "volume": (bubbles, *by_volume),
    }
    reduced = {}
    for name, inclusions in media_of.items():
        bulk = media.Medium("ice", tuple(inclusions), 24).bulk(wavelength)
        reduced[name] = float((bulk.b * (1 - bulk.g))[0])
    assert reduced["bubbles"] > 5 * reduced["equivalent"]
    assert reduced["equivalent"] > 1.5 * reduced["volume"]
    bulk = ours.bulk(wavelength)  # the air as well
    assert float((bulk.b * (1 - bulk.g))[0]) == pytest.approx(2.6, rel=0.03)


@pytest.mark.slow
def test_gradients_reach_the_contents():
    """d b/d(fat, protein) through sizes and volume fractions, against differences."""

    def scattering(p):
        return media.milk(p[0], p[1], radii=20).bulk(WAVELENGTH).b[1]

    function = jax.jit(scattering)
    point = jnp.array([2.5, 3.0])
    gradient = jax.jit(jax.grad(scattering))(point)
    for k in range(2):
        step = jnp.zeros(2).at[k].set(1e-4)
        difference = (function(point + step) - function(point - step)) / 2e-4
        np.testing.assert_allclose(gradient[k], difference, rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: media.natural_water("Atlantik"), "Atlantic"),
        (lambda: media.natural_water(algae=1e-6), "needs a region"),
        (lambda: media.natural_water("Atlantic", minerals=-1e-9), "volume fraction of mineral"),
        (lambda: media.milk(50.0, 3.0), "fat must be between 0 and 10"),
        (lambda: media.ice(air=2.0), "volume fraction of air"),
        (lambda: media.natural_water("Atlantic").bulk([300.0, 500.0]), "within 375-775 nm"),
        (lambda: media.natural_water("Atlantic").iops(WAVELENGTH, shapes=0), "shapes must be"),
    ],
)
def test_bad_input_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_an_absent_inclusion_scatters_nothing():
    """Milk without fat keeps the shape of fat's phase function and the scattering of protein."""
    grid = np.array([500.0])
    skimmed, fat = (media.milk(f, 3.0, radii=20).iops(grid, shapes=1) for f in (0.0, 1.0))
    np.testing.assert_array_equal(skimmed.b_components[0], 0.0)
    np.testing.assert_allclose(skimmed.b_components[1], fat.b_components[1], rtol=1e-12)
    assert np.isfinite(skimmed.phases[0](jnp.asarray([0.3]))).all()
