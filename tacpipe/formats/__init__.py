"""Readers of recordings in other formats, one module or package per format."""
