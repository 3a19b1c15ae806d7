"""The rig without hardware: each sensor's own bytes, at its own rate, driven by one physical simulation."""
