"""Files that hold a tree of named arrays (HDF5, Zarr), read as streams of recordings."""
