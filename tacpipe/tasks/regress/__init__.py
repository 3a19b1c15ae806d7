"""Estimate quantities from touch."""
