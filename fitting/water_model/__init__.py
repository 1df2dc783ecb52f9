"""The bio-optical model of a fit: its unknowns, alternatives and derived quantities."""
