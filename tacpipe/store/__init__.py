"""Store content by digest and results by key, with roots and leases."""
