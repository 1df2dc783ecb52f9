"""Priors of what milk, natural water and populations of spheres hold, a number a row."""

import pytest

import oceaninv as oi
from fitting import Identity, Log
from fitting.bulk import media

# name: centre, spread, unit, transform.
MILK = {
    "fat": (2.0, 2.3, "g/(100 g)", Log()),
    "protein": (3.0, 2.3, "g/(100 g)", Log()),
    # Homogenised or not, globules differ by a third, micelles by half as much.
    "globule_size": (1.0, 0.3, "1", Log()),
    "micelle_size": (1.0, 0.15, "1", Log()),
    "riboflavin": (1.0, 0.3, "1", Log()),
}
WATER = {
    # Frisvad et al. 2007: a few tenths of a part in a million of the volume.
    "algae": (5e-7, 2.3, "1", Log()),
    "minerals": (3e-7, 2.3, "1", Log()),
    "algae_exponent": (3.6, 0.3, "1", Identity()),
    "mineral_exponent": (3.4, 0.3, "1", Identity()),
    # Pigment per cell and iron per grain vary several-fold.
    "algae_absorption": (1.0, 0.5, "1", Log()),
    "mineral_absorption": (1.0, 0.7, "1", Log()),
    "cdom": (0.05, 2.3, "m-1", Log()),
    "cdom_slope": (0.0176, 0.25, "nm-1", Log()),
}


def rows(unknowns):
    return {p.name: (p.centre, p.spread, p.unit, p.transform) for p in unknowns}


@pytest.mark.parametrize(
    ("medium", "table"),
    [
        (media.Milk(), MILK),
        (media.NaturalWater(), WATER),
        (
            media.NaturalWater(cdom=False),
            {name: row for name, row in WATER.items() if "cdom" not in name},
        ),
    ],
)
def test_priors_of_media_are_those_of_the_table(medium, table):
    assert rows(medium.unknowns()) == table


def test_sizes_of_spheres_are_known_to_a_third_or_a_half():
    """Exponents to 0.3; mean radii to 50 % and their coefficient of variation to 30 %."""
    small = oi.particles.Population(1.5 + 0j, oi.particles.PowerLaw(3.8, 0.1, 10.0), 1e-6)
    large = oi.particles.Population(1.5 + 0j, oi.particles.LogNormal(0.7, 0.4), 2e-6)
    found = rows(media.Populations({"small": small, "large": large}, 1.34).unknowns())
    assert found["small_fraction"] == (pytest.approx(1e-6, rel=1e-6), 2.3, "1", Log())
    assert found["large_fraction"] == (pytest.approx(2e-6, rel=1e-6), 2.3, "1", Log())
    assert found["small_exponent"] == (pytest.approx(3.8, rel=1e-6), 0.3, "1", Identity())
    assert found["large_mean"] == (pytest.approx(0.7, rel=1e-6), 0.5, "um", Log())
    assert found["large_cv"] == (pytest.approx(0.4, rel=1e-6), 0.3, "1", Log())
