"""Fits of underwater light to water constituents: the inverse side of oceaninv."""
