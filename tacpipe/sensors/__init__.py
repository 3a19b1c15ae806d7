"""One product a file: pure decoding of its bytes, and its declared rates."""
