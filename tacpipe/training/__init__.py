"""Train networks: the loop, checkpoints, scaling."""
