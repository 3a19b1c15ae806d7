"""Predict slips while the rig runs."""
