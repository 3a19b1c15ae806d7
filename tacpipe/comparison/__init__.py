"""Results of evaluations next to each other: what differs between them, how they compare with baselines, and how surely."""
