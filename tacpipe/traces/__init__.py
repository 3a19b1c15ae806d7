"""Turn recordings into arrays to draw: curves, maps of taxels, spans, paths and predictions."""
