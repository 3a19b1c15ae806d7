"""Read files with a tree of named arrays (HDF5, Zarr) as streams of recordings."""
