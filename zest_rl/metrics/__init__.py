"""Pure functions: statistics of returns, what a reward is worth, how well a selection finds its frames."""
