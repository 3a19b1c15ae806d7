"""Read and write safely: atomic files, digests, Parquet, YAML, the terminal, memory limits, signals."""
