"""Constituents of the water from what casts say."""
