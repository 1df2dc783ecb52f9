"""Differentiable inverse rendering under water."""
