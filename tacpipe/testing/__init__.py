"""What only tests and benchmarks need. Nothing in the package imports it at run time."""
