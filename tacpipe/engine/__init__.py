"""Run stages: compute keys, reuse stored results, execute what is missing, publish the output."""
