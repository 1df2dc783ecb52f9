"""Measured absorption, scattering and attenuation of a medium."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fitting.observations.array_checks import as_array
from oceaninv.foundation.argument_names import names_checked
from oceaninv.foundation.tables import check_wavelength

_COEFFICIENTS = ("a", "b", "c")


@dataclasses.dataclass(eq=False, init=False)
class Bulk:
    """Measured absorption, scattering and beam attenuation of a medium, any of the three.

    **Arguments:**

    - `wavelength`: (wl,) nm, strictly increasing.
    - `a`, `b`, `c`: (wl,) 1/m, or `None`.  NaN, zero and negative values are masked and counted in
      `masked`.  Three that satisfy c = a + b are two measurements: c is then left out.
    - `sigma`: standard deviation in 1/m: a number, (wl,) for all, or a mapping by name; `None`
      estimates one relative noise for all from the residuals of the fit, which then also holds
      what the model does not describe.
    - `floor`: 1/m, absolute noise beside the relative one, used when `sigma` is None.
    - `source`: where the numbers come from, for reports.

    `values`, `mask`: (coefficient, wl), one row per name in `names`.
    """

    wavelength: Float[np.ndarray, " wl"]
    names: tuple[str, ...]
    values: Float[np.ndarray, "coefficient wl"]
    sigma: Float[np.ndarray, "coefficient wl"] | None
    floor: float
    mask: Bool[np.ndarray, "coefficient wl"]
    source: str

    @names_checked
    def __init__(
        self, wavelength, a=None, b=None, c=None, sigma=None, floor: Any = 0.0, source="memory"
    ):
        wavelength = check_wavelength(wavelength)
        given = {k: v for k, v in zip(_COEFFICIENTS, (a, b, c), strict=True) if v is not None}
        if not given:
            raise ValueError("Bulk needs at least one of a, b and c.")
        rows = {name: as_array(name, value, 1) for name, value in given.items()}
        for name, row in rows.items():
            if row.shape != wavelength.shape:
                raise ValueError(
                    f"{name} must have one value per wavelength, {len(wavelength)}, not {len(row)}."
                )
        if len(rows) == 3 and np.allclose(
            rows["c"], rows["a"] + rows["b"], rtol=1e-9, atol=0.0, equal_nan=True
        ):
            del rows["c"]
        values = np.stack(list(rows.values()))
        mask = np.isfinite(values) & (values > 0)
        if sigma is not None:
            sigma = _bulk_sigma(sigma, tuple(rows), values.shape)
        for name, kept in zip(rows, mask.sum(axis=1), strict=True):
            if kept == 0:
                raise ValueError(f"{name} holds no finite positive value.")
        if not (np.isfinite(floor) and floor >= 0):
            raise ValueError(f"floor must be at least 0 1/m, not {floor}.")
        for key, value in (
            ("wavelength", wavelength),
            ("names", tuple(rows)),
            ("values", values),
            ("sigma", sigma),
            ("floor", float(floor)),
            ("mask", mask),
            ("source", source),
        ):
            setattr(self, key, value)

    @property
    def masked(self) -> int:
        """How many values were missing, zero or negative."""
        return int((~self.mask).sum())


def _bulk_sigma(sigma, names: tuple[str, ...], shape: tuple[int, int]) -> np.ndarray:
    """(coefficient, wl) standard deviations."""
    if isinstance(sigma, Mapping):
        missing = [name for name in names if name not in sigma]
        if missing:
            raise ValueError(f"sigma lacks {', '.join(missing)}; it must name every coefficient.")
        rows = [np.asarray(sigma[name], dtype=np.float64) for name in names]
    else:
        rows = [np.asarray(sigma, dtype=np.float64)] * len(names)
    for row in rows:
        if row.shape not in ((), shape[1:]):
            raise ValueError(
                f"sigma must be a number or have one value per wavelength, {shape[1]}, not shape "
                f"{row.shape}."
            )
        if not np.all(np.isfinite(row) & (row > 0)):
            raise ValueError("sigma must be positive and finite, in 1/m.")
    return np.stack([np.broadcast_to(row, shape[1:]) for row in rows])
