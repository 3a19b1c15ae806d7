"""Test sensors of other packages: random samples, dialogues with a device, and faults of the bytes on a link."""
