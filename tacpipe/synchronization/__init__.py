"""Resample streams with their own timestamps to a common grid, by interpolation or causally."""
