"""Name the material of a slide while it lasts."""
