"""A lab's own tables (CSV, Parquet, NPZ, JSON lines), read as a layout file describes them."""
