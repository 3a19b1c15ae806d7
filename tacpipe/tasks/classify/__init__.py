"""Name labels from touch."""
