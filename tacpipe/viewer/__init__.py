"""Recordings as they are seen: in Rerun's viewer, and as a picture."""
