"""What is drawn of a recording, as arrays: curves, maps of taxels, spans, paths and forecasts."""
