"""Fits as netCDF files."""

from pathlib import Path
from typing import TYPE_CHECKING

from fitting.core.result import Fit, dataset_content
from fitting.files import netcdf_writer
from oceaninv.foundation.atomic_write import atomic_write

if TYPE_CHECKING:
    from fitting.profile.kd.smooth_kd import SmoothKd


def save(
    path: str | Path,
    fit: Fit,
    constituents: Fit | None = None,
    smooth: "SmoothKd | None" = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a fit as netCDF; constituents and a smooth Kd(z) go into groups of these names."""
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.unlink()  # the writer starts from nothing or from a netCDF file, not an empty one
        netcdf_writer.write(temporary, *dataset_content(fit), mark=True)
        if constituents is not None:
            netcdf_writer.write(temporary, *dataset_content(constituents), group="constituents")
        if smooth is not None:
            netcdf_writer.write(temporary, *smooth.content(), group="smooth")


# `Fit` lies in a package below this one and must not import it.
Fit.write = staticmethod(save)
