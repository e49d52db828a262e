"""Rules of the fields of a config."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from zest_rl.errors import BadInput

Rule = tuple[bool, str]  # (holds, "must be …")
Rules = Mapping[str, Rule]  # by field

LARGEST_WIDTH, MOST_LAYERS, MOST_WEIGHTS = 2**14, 1000, 10**9
LARGEST_BATCH, MOST_NETWORKS = 2**20, 100
"""Room is made only below these bounds."""


def whole(value: int, largest: int) -> Rule:
    """Return the rule of a number that is counted from 1."""
    return 1 <= value <= largest, f"1 to {largest}"


def few_weights(n_layers: int, weights_per_layer: int, n_networks: int) -> Rule:
    """Return the rule of a number of equal layers in each of several networks."""
    return (
        1 <= n_layers <= MOST_LAYERS and n_networks * n_layers * weights_per_layer <= MOST_WEIGHTS,
        f"1 to {MOST_LAYERS}, and few enough for {MOST_WEIGHTS:,} weights in all",
    )


def check_fields(title: str, values: Any, rules: Rules) -> None:
    """Raise one `BadInput` that lists every field of `values` (an object with attributes) that breaks its rule."""
    problems = [f"{f} must be {rule}, got {getattr(values, f)!r}" for f, (holds, rule) in rules.items() if not holds]
    if problems:
        raise BadInput(f"{title}: " + "; ".join(problems))
