"""What each term of a scene contributes, and the cheapest model that is good enough."""

from oceaninv.fidelity.planning import Plan, expected_error, plan, sufficient
from oceaninv.fidelity.scene_terms import Term, thinned

__all__ = ["Plan", "Term", "expected_error", "plan", "sufficient", "thinned"]
