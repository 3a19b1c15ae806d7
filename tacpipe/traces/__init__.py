"""Convert recordings to arrays for drawing: curves, maps of taxels, spans, paths and predictions."""
