"""Exact light of horizontally uniform water, by discrete ordinates."""
