"""The built-in stages: the first plug-in, found through entry points like any other."""
