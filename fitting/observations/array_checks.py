"""Measured values as arrays of the expected number of dimensions."""

import numpy as np


def as_array(name: str, value, ndim: int) -> np.ndarray:
    """`value` as float64; ValueError, naming it, unless it has `ndim` dimensions."""
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != ndim:
        raise ValueError(f"{name} must have {ndim} dimension(s), not shape {array.shape}.")
    return array
