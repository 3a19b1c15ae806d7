"""LeRobot datasets, version 2.0, 2.1 and 3.0, read with pyarrow and json alone."""
