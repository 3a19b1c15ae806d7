"""Forecast during a live session: the causal chain of a model and its messages."""
