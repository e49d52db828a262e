"""What is known of other packages' environments: where their state is recorded, and how it is put back to be drawn.

One row of `RECORDED_ENVS` is one environment; of one that has no row, the recorded ``qpos`` is all there is to draw.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Columns = tuple[tuple[str, int, int | None], ...]
"""Paths within an episode and which of their columns make up qpos, in order: from the first number to before the
second; None: to the end."""
State = Mapping[str, Doubles]
"""``qpos`` (nq,), and by its last name all else that is put into the scene."""


@dataclass(frozen=True)
class RecordedEnv:
    """How the states of one environment, or of several alike, are recorded."""

    prefix: str
    """Start of the entry points."""
    qpos: Columns | None = None
    """Where qpos stands in what is observed; None: it is not there to the bit."""
    put: Callable[[Any, State], None] | None = None
    """Puts a state into the environment; None: qpos is all that a frame depends on."""
    scenery: Callable[[Any], tuple[str, ...]] = lambda env: ()
    """Environment → paths of what `put` takes besides qpos; ``{folder}`` is the group that qpos is recorded in."""
    noise: tuple[str, ...] = ()
    """Arguments of the environment that, unless they are 0, blur what it observes."""

    def observed_qpos(self, kwargs: Mapping[str, Any]) -> Columns | None:
        """Return where qpos stands in the observations of an environment that was made with `kwargs`."""
        if self.qpos is None or kwargs.get("exclude_current_positions_from_observation", True):
            return self.qpos
        return (("observations", 0, sum((end or 0) - first for _, first, end in self.qpos)),)

    def put_state(self, env: Any, state: State) -> None:
        """Put a recorded state into the environment; positions in the world are not computed yet."""
        if self.put is None:
            env.data.qpos[:] = state["qpos"]
        else:
            self.put(env, state)


def _put_hand(env: Any, state: State) -> None:
    known = {name: state[name] for name in env._state_space.spaces if name != "qvel"}
    env.set_env_state({**known, "qvel": np.zeros(env.model.nv)})


def _hand_scenery(env: Any) -> tuple[str, ...]:
    return tuple(f"{{folder}}/{name}" for name in env._state_space.spaces if name not in ("qpos", "qvel"))


def _put_maze(env: Any, state: State) -> None:
    env.data.qpos[:] = state["qpos"]
    env.goal = state["desired_goal"]
    env.update_target_site_pos()


def _put_fetch(env: Any, state: State) -> None:
    env.data.qpos[:] = state["qpos"]
    mujoco.mj_forward(env.model, env.data)
    env._utils.reset_mocap2body_xpos(env.model, env.data)  # faint lines that lead the gripper
    env.goal = state["desired_goal"]
    env._render_callback()  # what it does before each frame of its own: the target goes where the goal is


def _goal(env: Any) -> tuple[str, ...]:
    return ("observations/desired_goal",)


_GYMNASIUM, _ROBOTICS = "gymnasium.envs.mujoco.", "gymnasium_robotics.envs."
_X: Columns = (("infos/x_position", 0, 1),)
_XY: Columns = (*_X, ("infos/y_position", 0, 1))
_OBSERVED = "observations/observation"
_POINT: Columns = ((_OBSERVED, 0, 2),)
_ANT: Columns = (("observations/achieved_goal", 0, 2), (_OBSERVED, 0, 13))
_KITCHEN: Columns = ((_OBSERVED, 0, 9), (_OBSERVED, 18, 39))

RECORDED_ENVS = (
    RecordedEnv(f"{_GYMNASIUM}ant_v5", (*_XY, ("observations", 0, 13))),
    RecordedEnv(f"{_GYMNASIUM}half_cheetah_v5", (*_X, ("observations", 0, 8))),
    RecordedEnv(f"{_GYMNASIUM}hopper_v5", (*_X, ("observations", 0, 5))),
    RecordedEnv(f"{_GYMNASIUM}humanoid_v5", (*_XY, ("observations", 0, 22))),
    RecordedEnv(f"{_GYMNASIUM}humanoidstandup_v5", (*_XY, ("observations", 0, 22))),
    RecordedEnv(f"{_GYMNASIUM}inverted_pendulum_v5", (("observations", 0, 2),)),
    RecordedEnv(f"{_GYMNASIUM}swimmer_v5", (*_XY, ("observations", 0, 3))),
    RecordedEnv(f"{_GYMNASIUM}walker2d_v5", (*_X, ("observations", 0, 8))),
    RecordedEnv(f"{_ROBOTICS}maze.point_maze", _POINT, _put_maze, _goal),
    RecordedEnv(f"{_ROBOTICS}maze.ant_maze", _ANT, _put_maze, _goal),
    RecordedEnv(f"{_ROBOTICS}maze.", None, _put_maze, _goal),
    RecordedEnv(f"{_ROBOTICS}adroit_hand.", None, _put_hand, _hand_scenery),
    RecordedEnv(f"{_ROBOTICS}fetch.", None, _put_fetch, _goal),
    # by default its observations are off by up to 0.001 rad, and 0.00005 rad or m
    RecordedEnv(f"{_ROBOTICS}franka_kitchen", _KITCHEN, noise=("robot_noise_ratio", "object_noise_ratio")),
)
"""The first row whose prefix fits counts. The columns hold qpos to the bit, but for noise."""


def recorded_env(entry_point: str) -> RecordedEnv:
    """Return what is known of an environment."""
    return next((row for row in RECORDED_ENVS if entry_point.startswith(row.prefix)), RecordedEnv(entry_point))
