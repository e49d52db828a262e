"""Algorithms: one file each, in the same order (model, batch, loss, act); their flags are in `configs`.

To add one, copy the file of the most similar algorithm, give it a config, and add a line to `registry.AGENTS` and to
`configs.CONFIGS`. `foreign` is not an algorithm: it runs policies that other programs trained.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from zest_rl.agents.base import Agent, Policy
    from zest_rl.agents.registry import AGENTS, get_agent, load_policy

__all__ = ["AGENTS", "Agent", "Policy", "get_agent", "load_policy"]


def __getattr__(name: str) -> Any:
    """Load the registry when it is used: it imports torch, which flags and finished runs do without."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("zest_rl.agents.registry"), name)
