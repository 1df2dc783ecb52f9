"""Measured a, b and c of a medium to what it holds."""
