"""What a user opens: datasets, their manifests, labels, splits and lineage."""
