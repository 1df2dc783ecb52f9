"""Depth profiles of irradiance to Kd and constituents."""
