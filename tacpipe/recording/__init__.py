"""Record a rig: read its streams, spool their bytes so that they survive a crash, and seal them as a dataset."""
