"""The physics of the simulated rig."""
