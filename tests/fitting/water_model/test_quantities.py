"""The nearest Jerlov type weighs bands by their own error and a tenth for the types' own."""

import numpy as np
import pytest

from fitting.core.result import Quantity
from fitting.water_model.quantities import nearest_jerlov
from oceaninv.water.attenuation import kd_jerlov1976

BANDS = np.array([450.0, 550.0])


@pytest.mark.parametrize(("beyond", "nearest"), [(-0.004, "II"), (0.004, "III")])
def test_a_type_differs_within_itself_by_a_tenth(beyond, nearest):
    """A Kd exactly known at 550 nm, where it lies between two types, and to 0.3 at 450 nm, where
    it is the second's.  Both are as near where t of the way at 550 nm solves
    w2 t^2 L2^2 + w1 L1^2 = w2 (1 - t)^2 L2^2, with w = 1/(sd^2 + 0.1^2) and L what they differ by.
    """
    first, second = (np.log(np.asarray(kd_jerlov1976(name, BANDS))) for name in ("II", "III"))
    apart = (second - first) ** 2
    weight = 1.0 / (np.array([0.3, 0.0]) ** 2 + 0.01)
    t = 0.5 * (1.0 - weight[0] * apart[0] / (weight[1] * apart[1])) + beyond
    ln_kd = np.array([second[0], first[1] + t * (second[1] - first[1])])
    kd = Quantity(np.exp(ln_kd), np.array([0.3, 0.0]), "m-1", "Kd")
    found, away = nearest_jerlov(BANDS, kd)
    assert found == nearest
    expected = first if nearest == "II" else second
    assert away == pytest.approx(np.sqrt(np.mean((ln_kd - expected) ** 2)), rel=1e-6)
