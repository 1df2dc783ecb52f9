"""What each term of a scene contributes, and the cheapest model that is good enough."""

from oceaninv.fidelity._terms import Term
from oceaninv.fidelity.choice import Plan, plan

__all__ = ["Plan", "Term", "plan"]
