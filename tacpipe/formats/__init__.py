"""One published layout of recordings a file."""
