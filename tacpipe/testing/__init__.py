"""Helpers that only tests and benchmarks need. Nothing in the package imports them at run time."""
