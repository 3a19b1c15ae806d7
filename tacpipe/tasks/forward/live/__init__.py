"""Forecast while a rig runs: the causal chain of a model, its messages and its alarms."""
