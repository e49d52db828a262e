"""Environments of other packages: where their datasets record the state, and how it is restored for rendering.

One row of `RECORDED_ENVS` is one environment; without a row only the recorded ``qpos`` is restored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.simulation.recorder import DATA_FIELDS, MODEL_FIELDS

Doubles = NDArray[np.float64]
Columns = tuple[tuple[str, int, int | None], ...]
"""Paths within an episode and the columns that make up qpos, in order: from the first number up to, but without, the
second; None: to the end."""
State = Mapping[str, Doubles]
"""``qpos`` (nq,), and everything else in the scene by the last part of its path."""


@dataclass(frozen=True)
class RecordedEnv:
    """How the states of an environment, or of similar ones, are recorded."""

    prefix: str
    """Start of the entry points."""
    qpos: Columns | None = None
    """Columns of the observations that hold qpos; None: they do not hold it exactly."""
    put: Callable[[Any, State], None] | None = None
    """Restores a state in the environment; None: a frame depends on qpos alone."""
    scenery: Callable[[Any], tuple[str, ...]] = lambda env: ()
    """Environment → paths of what `put` needs besides qpos; ``{folder}`` is the group in which qpos is recorded."""
    moves_bodies: bool = False
    """Whether `put` places bodies without a joint, rather than marks alone."""
    noise: tuple[str, ...] = ()
    """Arguments of the environment that add noise to its observations unless they are 0."""

    def observed_qpos(self, kwargs: Mapping[str, Any]) -> Columns | None:
        """Return the columns of qpos in the observations of an environment made with `kwargs`."""
        if self.qpos is None or kwargs.get("exclude_current_positions_from_observation", True):
            return self.qpos
        return (("observations", 0, sum((end or 0) - first for _, first, end in self.qpos)),)

    def put_state(self, env: Any, state: State) -> None:
        """Restore a recorded state in the environment, without computing positions in the world."""
        if self.put is not None and all(path.rpartition("/")[2] in state for path in self.scenery(env)):
            self.put(env, state)
            return
        for owner, names in ((env.model, MODEL_FIELDS), (env.data, DATA_FIELDS)):
            for name in set(names) & set(state):
                getattr(owner, name).flat = state[name]


def running_state(env: Any, names: Sequence[str]) -> dict[str, Doubles]:
    """Return the state of an environment (without its wrappers) by the names under which datasets record it.

    What it does not have is left out.
    """
    own: Mapping[str, Any] = env.get_env_state() if hasattr(env, "get_env_state") else {}
    found: dict[str, Any] = {}
    for name in names:
        if name in MODEL_FIELDS and hasattr(env, "model"):
            found[name] = getattr(env.model, name)
        elif name in DATA_FIELDS and hasattr(env, "data"):
            found[name] = getattr(env.data, name)
        elif name in own:
            found[name] = own[name]
        elif name == "desired_goal" and hasattr(env, "goal"):
            found[name] = env.goal
    return {name: np.array(value, np.float64).ravel() for name, value in found.items()}


def _put_hand(env: Any, state: State) -> None:
    recorded = {name: state[name] for name in env._state_space.spaces if name != "qvel"}
    env.set_env_state({**recorded, "qvel": np.zeros(env.model.nv)})


def _hand_scenery(env: Any) -> tuple[str, ...]:
    return tuple(f"{{folder}}/{name}" for name in env._state_space.spaces if name not in ("qpos", "qvel"))


def _put_maze(env: Any, state: State) -> None:
    env.data.qpos[:] = state["qpos"]
    env.goal = state["desired_goal"]
    env.update_target_site_pos()


def _put_fetch(env: Any, state: State) -> None:
    env.data.qpos[:] = state["qpos"]
    mujoco.mj_forward(env.model, env.data)
    env._utils.reset_mocap2body_xpos(env.model, env.data)  # draws the faint lines that lead the gripper
    env.goal = state["desired_goal"]
    env._render_callback()  # which env.render() calls: it moves the target to the goal


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
    RecordedEnv(f"{_ROBOTICS}adroit_hand.", None, _put_hand, _hand_scenery, moves_bodies=True),
    RecordedEnv(f"{_ROBOTICS}fetch.", None, _put_fetch, _goal),
    # by default its observations are off by up to 0.001 rad, and 0.00005 rad or m
    RecordedEnv(f"{_ROBOTICS}franka_kitchen", _KITCHEN, noise=("robot_noise_ratio", "object_noise_ratio")),
)
"""The first row whose prefix matches counts. Apart from noise, the columns hold qpos exactly."""


def recorded_env(entry_point: str, env: Any) -> RecordedEnv:
    """Return the row of an environment, or what that of its class says of states; else a default one.

    What a row says of observations is of the registered environment alone: wrappers or a subclass may change them.
    """
    registered = next((row for row in RECORDED_ENVS if entry_point.startswith(row.prefix)), None)
    if registered is not None:
        return registered
    bases = [f"{base.__module__}:{base.__qualname__}" for base in type(env).__mro__]
    rows = (replace(row, qpos=None) for name in bases for row in RECORDED_ENVS if name.startswith(row.prefix))
    return next(rows, RecordedEnv(entry_point))
