"""Casts and tables in files."""
