"""Photographs of charts and open water to constituents."""
