"""Atheris on everything that reads what others wrote: coverage leads it to bytes that no valid example is near."""
