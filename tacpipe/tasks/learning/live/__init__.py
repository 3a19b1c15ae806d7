"""Answer windows of touch while the rig runs."""
