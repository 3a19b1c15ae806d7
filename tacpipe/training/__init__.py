"""Train networks: the training loop, checkpoints, scaling."""
