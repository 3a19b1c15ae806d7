"""Datasets written for other tools: files of their formats, with a list of what a format cannot carry."""
