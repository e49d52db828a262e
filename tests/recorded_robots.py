"""Short recordings of real environments other than the kitchen, as a user makes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import gymnasium_robotics  # noqa: F401  # registers its environments
import numpy as np

from zest_rl.simulation.recorder import Recorder

SMALL: dict[str, Any] = {"n_updates": 5, "hidden_size": 16, "n_layers": 1, "device": "cpu", "threads": 1}
"""A training of a second."""


def record(
    env: str | gymnasium.Env[Any, Any],
    dataset_id: str,
    n_episodes: int = 3,
    n_steps: int = 10,
    pushed: str | None = None,
) -> list[np.ndarray]:
    """Record episodes, reset with the seeds 0, 1, …, in which one random action is held; return their actions.

    `pushed` is a joint of an object, which nobody touches, that is given a push at the start of each episode.
    """
    recorder = Recorder(gymnasium.make(env) if isinstance(env, str) else env)
    recorder.action_space.seed(0)
    taken = []
    for seed in range(n_episodes):
        recorder.reset(seed=seed)
        if pushed is not None:
            recorder.unwrapped.data.joint(pushed).qvel[0] = (seed + 1) / 2  # type: ignore[attr-defined]
        actions = [recorder.action_space.sample()] * n_steps
        for step, action in enumerate(actions):
            *_, terminated, truncated, _ = recorder.step(action)
            if terminated or truncated:
                actions = actions[: step + 1]
                break
        taken.append(np.stack(actions))
    recorder.write(dataset_id)
    return taken


def write_module(folder: Path, name: str, *lines: str) -> None:
    """Write a module of a user's own."""
    (folder / f"{name}.py").write_text("\n".join(["import gymnasium", "import gymnasium_robotics", *lines, ""]))


class Replay:
    """Plays recorded actions, one array (T, act_dim) per episode; keeps what it sees and is told."""

    agent, uses_return = "replay", True

    def __init__(self, meta: dict[str, Any], actions: Sequence[np.ndarray]) -> None:
        self.meta, self.actions = meta, actions
        self.seen: list[np.ndarray] = []
        self.told: list[np.ndarray] = []

    def begin(self, n_episodes: int, target_return: float | None = None) -> None:
        assert n_episodes == len(self.actions)

    def act(self, obs: np.ndarray) -> np.ndarray:
        self.seen.append(obs)
        step = len(self.seen) - 1
        return np.stack([episode[min(step, len(episode) - 1)] for episode in self.actions]).astype(np.float32)

    def observe(self, rewards: np.ndarray) -> None:
        self.told.append(rewards.copy())

    def end(self) -> dict[str, np.ndarray]:
        return {}
