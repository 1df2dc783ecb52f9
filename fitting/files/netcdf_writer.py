"""netCDF without xarray, whose import alone would take as long as a fit."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from oceaninv.foundation import provenance

Variables = Mapping[str, Any]


def write(
    path: Path,
    data: Variables,
    coords: Variables,
    attributes: Mapping[str, str],
    group: str = "",
    mark: bool = False,
) -> None:
    """Add variables to a netCDF-4 file, made if need be; arguments as of `xarray.Dataset`.

    A variable is (dims, values) or (dims, values, attributes), dims a name or a tuple of names; an
    array alone lies along the dimension of its own name.  `mark`: a file that oceaninv may replace,
    with attributes that say what made it (`oceaninv.foundation.provenance`).
    """
    import h5netcdf

    with h5netcdf.File(path, "a") as file:
        place = file.create_group(group) if group else file
        for name, variable in {**coords, **data}.items():
            dims, values, notes = _described(name, variable)
            for dim, size in zip(dims, values.shape, strict=True):
                if dim not in place.dimensions:
                    place.dimensions[dim] = size
            text = values.dtype.kind in "UO"
            made = place.create_variable(
                name,
                dims,
                _text() if text else values.dtype,
                data=values.astype(object) if text else values,
                # What is missing is NaN; files say so, but CF allows no gap along an axis.
                fillvalue=(
                    np.array(np.nan, values.dtype)
                    if values.dtype.kind == "f" and name not in coords
                    else None
                ),
            )
            made.attrs.update(notes)
        place.attrs.update(attributes)
        if mark:
            made_by = provenance.current()
            place.attrs.update({"history": made_by.history, **made_by.facts})


def _described(name: str, variable) -> tuple[tuple[str, ...], np.ndarray, Mapping[str, Any]]:
    if not isinstance(variable, tuple):
        return (name,), np.asarray(variable), {}
    dims, values, notes = (*variable, {})[:3]
    return (dims,) if isinstance(dims, str) else tuple(dims), np.asarray(values), notes


def _text():
    import h5py

    return h5py.string_dtype()
