"""Photographs, and the charts in them."""
