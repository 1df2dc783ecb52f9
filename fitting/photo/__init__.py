"""Photographs of charts and open water to constituents."""

from fitting.observations.photo import WAVELENGTH

__all__ = ["WAVELENGTH"]
