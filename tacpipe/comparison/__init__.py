"""Compare results of evaluations: how methods differ, their gain over baselines, and its uncertainty."""
