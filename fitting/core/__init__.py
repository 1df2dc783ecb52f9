"""Unknowns, problems, least squares and results: what all fits share."""
