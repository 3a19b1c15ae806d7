"""Examine a dataset for faults of time and identity that a result would not show. One module per kind of question."""
