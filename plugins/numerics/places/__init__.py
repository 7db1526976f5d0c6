"""Places seen before: hypotheses, checks, pose graphs."""
