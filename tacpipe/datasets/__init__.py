"""Open datasets: recordings, manifests, labels, splits and lineage."""
