"""What trains a network: loop, checkpoints, scaling."""
