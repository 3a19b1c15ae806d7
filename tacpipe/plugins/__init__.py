"""What others extend: stages, their params, and the registry that finds plug-ins."""
