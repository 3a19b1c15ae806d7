"""How predictions are evaluated: errors, skill over a baseline, intervals."""
