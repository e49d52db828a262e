"""Names of what `conftest` makes once for all tests: a tiny dataset, and policies that are trained on it."""

COLLECTED = "zest/kitchen-micro-tiny-v0"
SHORT_HORIZON = 25
"""Steps of an evaluated episode."""
