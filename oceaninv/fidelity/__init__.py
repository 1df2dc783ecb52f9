"""The contribution of each term of a scene, and the cheapest sufficient model."""

from oceaninv.fidelity.planning import Plan, expected_error, plan, sufficient
from oceaninv.fidelity.scene_terms import Term, scene_at_bands

__all__ = ["Plan", "Term", "expected_error", "plan", "scene_at_bands", "sufficient"]
