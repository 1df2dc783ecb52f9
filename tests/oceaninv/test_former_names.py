"""Former public names still work and give a DeprecationWarning."""

import pytest

import oceaninv as oi
from oceaninv.fidelity.trade_off import Trade


def test_shadows_is_with_objects():
    with pytest.warns(DeprecationWarning, match="WithObjects"):
        former = oi.Shadows(oi.TwoStream(), 7)
    assert former == oi.WithObjects(oi.TwoStream(), 7)


@pytest.mark.parametrize("transport", [oi.PlaneParallel, oi.MonteCarlo])
def test_generations_are_inelastic_orders(transport):
    with pytest.warns(DeprecationWarning, match="inelastic_orders"):
        former = transport(generations=3)
    assert former == transport(inelastic_orders=3)


def test_doubt_is_the_error_of_the_reference():
    with pytest.warns(DeprecationWarning, match="reference_error"):
        assert Trade("sea", "photograph", "exact", 0.25, ()).doubt == 0.25
