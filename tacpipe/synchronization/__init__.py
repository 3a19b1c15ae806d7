"""Streams with stamps of their own brought onto one grid: between their samples, or causally from the samples before."""
