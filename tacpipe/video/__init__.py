"""Streams of encoded frames: their columns, reading and writing video files, decoding and encoding."""
