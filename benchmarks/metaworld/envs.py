"""Three tasks of Meta-World as environments that `zest relabel`, `evaluate` and `reproduce` can name with ``--env``.

Its own ids (``Meta-World/MT1``) choose one of 50 placements of the object, whatever seed a reset gets. Here the seed of
a reset decides where the object stands, so that every episode has a placement of its own, and can be had again.
"""

from __future__ import annotations

import warnings
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import numpy as np
from gymnasium.wrappers import DtypeObservation, TimeLimit
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_HIDDEN

TASKS = ("door-open", "drawer-open", "window-open")
HORIZON = 125
"""Steps of an episode: the scripted policies need 70 to 115 to open the object."""


def door_open() -> gymnasium.Env[Any, Any]:
    """Pull a door open by its handle."""
    return make("door-open")


def drawer_open() -> gymnasium.Env[Any, Any]:
    """Pull a drawer open by its handle."""
    return make("drawer-open")


def window_open() -> gymnasium.Env[Any, Any]:
    """Slide a window open by its handle."""
    return make("window-open")


def make(task: str) -> gymnasium.Env[Any, Any]:
    """Make the environment of a task: float32 observations, without the goal's position, `HORIZON` steps."""
    bare = ALL_V3_ENVIRONMENTS_GOAL_HIDDEN[f"{task}-v3-goal-hidden"](seed=0)
    bare._freeze_rand_vec, bare.seeded_rand_vec = False, True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gymnasium warns of the precision of float32
        return TimeLimit(DtypeObservation(_Seeded(bare), np.float32), HORIZON)


class _Seeded(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Gives the environment the seed of a reset, which its own reset ignores."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        if seed is not None:
            self.env.unwrapped.seed(seed)
        return self.env.reset(options=options)
