"""Show recordings in Rerun's viewer, or draw them as a picture."""
