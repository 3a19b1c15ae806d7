"""Rank candidate grasps on request."""
