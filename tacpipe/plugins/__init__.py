"""Define what plug-ins extend: stages, their params, and the registry that finds them."""
