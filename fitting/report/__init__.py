"""Results as pictures, pages and files."""

from fitting.report.netcdf_file import save

__all__ = ["save"]
