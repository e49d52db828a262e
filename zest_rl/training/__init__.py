"""Episodes → a run folder with a policy."""
