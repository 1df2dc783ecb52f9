"""Lorenz-Mie theory: spheres, populations of them, and the media that they make."""

from oceaninv.mie.sphere import (
    CrossSections,
    amplitudes,
    cross_sections,
    efficiencies,
    phase_function,
    sections_and_forward,
)

__all__ = [
    "CrossSections",
    "amplitudes",
    "cross_sections",
    "efficiencies",
    "phase_function",
    "sections_and_forward",
]
