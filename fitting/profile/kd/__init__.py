"""Kd of single bands, and the reflectances that follow."""
