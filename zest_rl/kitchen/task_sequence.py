"""Kitchen experts that do several tasks one after another, without a reset in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.env import HORIZON, KitchenEnv, env_spec
from zest_rl.kitchen.experts import make_expert
from zest_rl.kitchen.tasks import get_task


@dataclass(frozen=True)
class Performance:
    """One episode of several tasks."""

    states: NDArray[np.float64]
    """(T+1, nq) simulator positions."""
    done_at: dict[str, int]
    """Task → step at which it succeeds by ground truth."""


def perform(tasks: Sequence[str], seed: int) -> Performance:
    """Let the experts do `tasks` in this order; each starts where the previous one succeeded.

    Args:
        tasks: names in ``zest_rl.kitchen.tasks.TASKS``, at least 2, all different.
        seed: of the arm's start.

    Raises:
        BadInput: too few tasks, a repeated task, or an unknown one.
        ZestError: an expert did not succeed within `HORIZON` steps.
    """
    if len(tasks) < 2 or len(set(tasks)) < len(tasks):
        raise BadInput(f"an episode of several steps needs 2 or more different tasks, got {', '.join(tasks) or 'none'}")
    for task in tasks:
        get_task(task)
    states: list[NDArray[np.float64]] = []
    done_at: dict[str, int] = {}
    before: mujoco.MjData | None = None
    for task in tasks:
        env = gymnasium.make(env_spec(task))
        env.reset(seed=seed)
        kitchen = env.unwrapped
        assert isinstance(kitchen, KitchenEnv)
        if before is None:
            states.append(kitchen.data.qpos.copy())
        else:
            kitchen.data.qpos[:], kitchen.data.qvel[:] = before.qpos, before.qvel
            mujoco.mj_forward(kitchen.model, kitchen.data)
        expert = make_expert(task, env)
        for _ in range(HORIZON):
            info = env.step(expert.act())[-1]
            states.append(kitchen.data.qpos.copy())
            if info["gt"]["success"]:
                break
        else:
            raise ZestError(
                f"the expert of {task!r} did not succeed within {HORIZON} steps after "
                f"{', '.join(done_at) or 'the start'}; try another order or another --seed"
            )
        done_at[task] = len(states) - 1
        before = kitchen.data
        env.close()
    return Performance(np.stack(states), done_at)
