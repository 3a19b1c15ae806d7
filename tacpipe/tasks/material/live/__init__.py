"""Predict the material of a slide during the slide."""
