"""A trained model while the hand moves: its chain of stages, fed samples as they arrive."""
