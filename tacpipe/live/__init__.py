"""Live sessions: run a trained model and its chain of stages while samples arrive."""
