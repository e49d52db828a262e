"""Experts that reinforcement learning found, one network per task, shipped in ``experts_rl/``.

They are the paper's kind of expert: `zest_rl.kitchen.rl_training` trained them on the ground truth, which is allowed
here because they make data and nothing is compared with them. A Gaussian policy, two hidden layers, run by NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import numpy as np

from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.arm import Vector
from zest_rl.kitchen.env import ACT_DIM, KitchenEnv
from zest_rl.kitchen.experts import SKILLS, DoorPlane, DragThenPush, Joint, Push, kitchen_of
from zest_rl.types import FloatArray

WEIGHTS = Path(__file__).with_name("experts_rl")
FEATURE_DIM = 2 * ACT_DIM + 1 + 3 + 6
_POSITION, _GAP = 0.5, 0.2  # rad or m that make a feature of 1
_PUSH_N, _PAST_EDGE = 0.035, 0.045  # m behind a door at which it is pushed, and past its edge on the way there
_LARGEST = 5.0  # features are clipped to it
_LOG_STD = (-20.0, 2.0)  # as stable-baselines3 clips it
Weights = Mapping[str, FloatArray]


class Senses:
    """What an expert sees of the simulator's state: the robot, the task's joint, and the way from hand to contact."""

    def __init__(self, env: KitchenEnv) -> None:
        """Read from `env`, whose task names the contact by its row in `SKILLS`."""
        skill = SKILLS[env.task.name]
        self._env, self._joint = env, Joint(env)
        self._door = skill if isinstance(skill, DragThenPush) else None
        self._skill = skill.drag if isinstance(skill, DragThenPush) else skill
        self._part, self._hand = env.model.site(self._skill.site).id, env.model.site("end_effector").id

    def gap(self) -> Vector:
        """Return the way (3,) to the tip of the gripper, in m, from the contact or the next point behind a door."""
        behind = self._behind_door()
        return np.asarray(self._tip() - (behind[0] if behind else self._contact()))

    def way_behind_door(self) -> float | None:
        """Return how far the tip must go, in m, to push a door from inside; None before it is ajar, or for others."""
        points = [self._tip(), *self._behind_door()]
        return sum(float(np.linalg.norm(b - a)) for a, b in pairwise(points)) if len(points) > 1 else None

    def _tip(self) -> Vector:
        approach = self._env.data.site_xmat[self._hand].reshape(3, 3)[:, 2]
        return np.asarray(self._env.data.site_xpos[self._hand] + self._skill.tip_offset * approach)

    def _contact(self) -> Vector:
        skill = self._skill
        offset = self._joint.turned(skill.contact) if isinstance(skill, Push) else np.array([0, 0, skill.grip_offset])
        return np.asarray(self._env.data.site_xpos[self._part] + offset)

    def _behind_door(self) -> list[Vector]:
        """Return the points (3,) still to pass on the way round the free edge of a door that is ajar."""
        door = self._door
        if door is None or abs(self._joint.position) <= door.ajar:
            return []
        plane = DoorPlane(self._joint, door.height)
        pushing = plane.place(door.push_at, _PUSH_N)
        is_inside = plane.coordinates(self._tip())[1] > 0.0
        return [pushing] if is_inside else [plane.place(door.width + _PAST_EDGE, 0.0), pushing]

    def features(self) -> FloatArray:
        """Return (`FEATURE_DIM`,) float32: the robot's positions and velocities, the progress, the gap, two axes."""
        data = self._env.data
        parts = (
            (data.qpos[:ACT_DIM] - self._env.start_qpos[:ACT_DIM]) / _POSITION,
            data.qvel[:ACT_DIM],
            [self._env.progress],
            self.gap() / _GAP,
            data.site_xmat[self._hand].reshape(3, 3)[:, 1:].ravel(),
        )
        return np.concatenate(parts).clip(-_LARGEST, _LARGEST).astype(np.float32)


class RLExpert:
    """Acts by the mean of its Gaussian, or by samples of it."""

    def __init__(self, env: KitchenEnv, weights: Weights, rng: np.random.Generator | None = None) -> None:
        """Act on `env` with the tensors of stable-baselines3's SAC actor; with `rng` actions are sampled."""
        self._senses, self._weights, self._rng = Senses(env), weights, rng

    def act(self) -> FloatArray:
        """Return the action (9,) float32 in [-1, 1] for the environment's current state, which is not changed."""
        hidden = self._senses.features()
        for layer in ("latent_pi.0", "latent_pi.2"):
            hidden = np.maximum(self._linear(layer, hidden), 0.0)
        action = self._linear("mu", hidden)
        if self._rng is not None:
            std = np.exp(self._linear("log_std", hidden).clip(*_LOG_STD))
            action = action + std * self._rng.standard_normal(ACT_DIM)
        return np.tanh(action).astype(np.float32)

    def _linear(self, layer: str, x: FloatArray) -> FloatArray:
        return self._weights[f"{layer}.weight"] @ x + self._weights[f"{layer}.bias"]


def weights_file(task_name: str) -> Path:
    """Return the file of a task's expert."""
    return WEIGHTS / f"{task_name}.safetensors"


def make_rl_expert(task_name: str, env: gymnasium.Env[Any, Any], rng: np.random.Generator | None = None) -> RLExpert:
    """Return the expert of `task_name` that reinforcement learning found, acting on `env`.

    Args:
        task_name: a name in ``zest_rl.kitchen.tasks.TASKS``.
        env: a `KitchenEnv` of that task, wrapped or not.
        rng: of the actions' samples; without it the expert acts by its mean.

    Raises:
        BadInput: there is no such expert (the message names the nearest), or `env` is of another task.
    """
    from safetensors.numpy import load_file

    if not weights_file(task_name).is_file():
        known = sorted(path.stem for path in WEIGHTS.glob("*.safetensors"))
        raise BadInput(f"no expert was trained by RL for task {task_name!r}; {nearest(task_name, known)}")
    return RLExpert(kitchen_of(task_name, env), load_file(weights_file(task_name)), rng)
