"""Forecast during a live session: the causal chain of a model, its messages and its alarms."""
