"""What each term of a scene contributes, and the cheapest model that is good enough."""

from oceaninv.fidelity._terms import Term, thinned
from oceaninv.fidelity.choice import Plan, expected_error, plan, sufficient

__all__ = ["Plan", "Term", "expected_error", "plan", "sufficient", "thinned"]
