"""Store bytes: objects by digest, records by key, roots, and leases."""
