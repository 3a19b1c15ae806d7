"""Base classes and registry of plug-ins: stages, their params, and the lookup of installed plug-ins."""
