"""How a stage runs: keys, the store's answer, execution of the rest, and publication of the result."""
