"""The MuJoCo kitchen as a Gymnasium environment: one task, flat observation, ground truth kept apart in ``info``.

Model, start state and control are those of gymnasium-robotics' ``FrankaKitchen-v1``; only this module imports that
package. Differences, and why:

- no observation noise. There, control starts from the last *noisy* joint positions, so the same state and action
  can lead to different states; here the next state depends on state and action alone;
- the seed moves the arm's start (there it drives the noise only), and start values beyond a joint's range are clipped;
- objects start at rest. There the kettle starts tilted and in the air and falls by a millimetre in the first step, a
  change in every later frame that the robot did not cause;
- the reward is the progress of one joint, so that it is a level like the ZeST scores; nothing ends an episode early.

Importing this module registers ``zest/Kitchen-v1``; the version rises with every change of the dynamics or the starts,
so that data and policies of an earlier version are not mistaken for those of this one.
"""

from __future__ import annotations

from contextlib import redirect_stderr
from dataclasses import dataclass, replace
from functools import cache
from io import StringIO
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.tasks import SUCCESS_PROGRESS, Task, get_task
from zest_rl.types import FloatArray

with redirect_stderr(StringIO()):  # on import it prints news of its other environments
    from gymnasium_robotics.envs.franka_kitchen import KitchenEnv as FrankaKitchen

ENV_ID = "zest/Kitchen-v1"
HORIZON = 100
"""Steps per episode (8 s); the same for every task, so that a sum of levels does not reward length."""
ACT_DIM = 9
"""Seven arm joints, then two fingers."""
ARM_DIM = 7
OBS_DIM, N_QVEL = 59, 29
"""Numbers of an observation, and velocities of the whole kitchen."""
SETTLE_STEPS = 1000
"""Simulator steps (2 s) in which the objects come to rest before an episode."""
FRAME_SKIP = 40
"""Simulator steps of 2 ms per environment step: 12.5 Hz."""
MAX_JOINT_SPEED = 2.0
"""Commanded joint speed of action 1, in rad/s (m/s for the fingers)."""

_MUJOCO_FROM, _MUJOCO_BELOW = (3, 3, 7), (3, 12)


class KitchenEnv(gymnasium.Env[FloatArray, FloatArray]):
    """One kitchen task, 12.5 Hz, joint velocities in, joint states out.

    Observation: (59,) float32 = robot positions (9), robot velocities (9), object positions (21), object
    velocities (20), in the simulator's order; rad, m, rad/s, m/s; free of noise.

    Action: (9,) float32 in [-1, 1], values beyond are clipped; 1 commands `MAX_JOINT_SPEED`. The joints are position
    servos without gravity compensation: at zero action the arm sags.

    Reward: ``clip(progress, 0, 1)`` after the step. Never terminated; ``gymnasium.make`` truncates at `HORIZON`.

    ``info``, at reset and at each step, numbers only and owned by the caller: ``state/qpos`` (30,) and ``state/qvel``
    (29,) float64, ``gt/reward`` float32 (at reset: of the start), ``gt/success`` bool (progress at this step reaches
    ``SUCCESS_PROGRESS``).
    """

    model: mujoco.MjModel
    """Read-only: compiled once and shared by all instances of the process; copy it to change it."""
    data: mujoco.MjData
    """The current simulator state; each instance has its own."""

    def __init__(self, task: str = "micro", init_noise: float = 0.05) -> None:
        """Build the simulation; cheap after the first instance of a process.

        Args:
            task: a name in ``zest_rl.kitchen.tasks.TASKS``.
            init_noise: half-width of the uniform noise on each arm joint's start, in rad; >= 0.

        Raises:
            BadInput: the task is unknown or `init_noise` is negative or not finite.
            ZestError: the installed mujoco cannot run the kitchen.
        """
        if not 0 <= init_noise < np.inf:
            raise BadInput(f"init_noise must be a finite number of rad >= 0, got {init_noise}")
        self.task = get_task(task)
        self.init_noise = init_noise
        kitchen = _load_kitchen()
        self.model = kitchen.model
        self.data = mujoco.MjData(self.model)
        self.start_qpos = kitchen.start_qpos
        self.control_low, self.control_high = kitchen.control_low, kitchen.control_high
        self._step_seconds = self.model.opt.timestep * FRAME_SKIP
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.model.nq + self.model.nv,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (ACT_DIM,), np.float32)

    @property
    def progress(self) -> float:
        """Position of the task's joint as a fraction of its goal, not clipped: 0 at the start, 1 at the goal."""
        return float(progress_of(self.task, self.data.qpos))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Start an episode; equal seeds give bitwise equal episodes for equal actions. `options` has no effect."""
        super().reset(seed=seed, options=options)
        qpos = self.start_qpos.copy()
        qpos[:ARM_DIM] += self.np_random.uniform(-self.init_noise, self.init_noise, ARM_DIM)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = _clip_to_ranges(self.model, qpos)
        mujoco.mj_forward(self.model, self.data)
        return self._obs(), self._info()

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Advance by 80 ms.

        Raises:
            BadInput: the action is not 9 finite numbers.
        """
        velocity = np.asarray(action, dtype=np.float64)
        if velocity.shape != (ACT_DIM,) or not np.isfinite(velocity).all():
            raise BadInput(
                f"an action must be {ACT_DIM} finite numbers in [-1, 1], got shape {velocity.shape} with values "
                f"{velocity}; check the policy's output"
            )
        target = self.data.qpos[:ACT_DIM] + np.clip(velocity, -1.0, 1.0) * MAX_JOINT_SPEED * self._step_seconds
        self.data.ctrl[:] = np.clip(target, self.control_low, self.control_high)
        mujoco.mj_step(self.model, self.data, nstep=FRAME_SKIP)
        info = self._info()
        return self._obs(), float(info["gt"]["reward"]), False, False, info

    def _obs(self) -> FloatArray:
        qpos, qvel = self.data.qpos, self.data.qvel
        parts = (qpos[:ACT_DIM], qvel[:ACT_DIM], qpos[ACT_DIM:], qvel[ACT_DIM:])
        return np.concatenate(parts, dtype=np.float32)

    def _info(self) -> dict[str, Any]:
        progress = self.progress
        return {
            "state": {"qpos": self.data.qpos.copy(), "qvel": self.data.qvel.copy()},
            "gt": {"reward": np.float32(min(max(progress, 0.0), 1.0)), "success": progress >= SUCCESS_PROGRESS},
        }


def progress_of(task: Task, qpos: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ground truth of recorded states (…, nq), for evaluation: position of the task's joint over its goal, (…)."""
    return np.asarray(qpos[..., _address(task.joint)] / task.goal)


@cache
def _address(joint: str) -> int:
    """Index of a joint's position in qpos; looked up once, as every step asks for it."""
    model = _load_kitchen().model
    return int(model.jnt_qposadr[model.joint(joint).id])


@dataclass(frozen=True)
class _Kitchen:
    """Shared by all instances, and read-only."""

    model: mujoco.MjModel
    start_qpos: NDArray[np.float64]  # (nq,)
    control_low: NDArray[np.float64]  # (9,) bounds of the position targets
    control_high: NDArray[np.float64]


@cache
def _load_kitchen() -> _Kitchen:
    """Take model and constants from FrankaKitchen-v1; compiling the model costs 0.2 s."""
    check_mujoco(mujoco.__version__)
    robot = FrankaKitchen().robot_env
    low, high = robot.robot_pos_bound[:ACT_DIM].T.copy()
    kitchen = _Kitchen(robot.model, _at_rest(robot.model, robot.init_qpos), low, high)
    for array in (kitchen.start_qpos, low, high):
        array.setflags(write=False)
    return kitchen


def _at_rest(model: mujoco.MjModel, qpos: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a copy of `qpos` (nq,) with the objects at rest and the robot unmoved."""
    data = mujoco.MjData(model)
    data.qpos[:] = _clip_to_ranges(model, qpos)
    data.ctrl[:] = qpos[:ACT_DIM]
    mujoco.mj_step(model, data, nstep=SETTLE_STEPS)
    rest = qpos.copy()
    rest[ACT_DIM:] = data.qpos[ACT_DIM:]
    return rest


def check_mujoco(version: str) -> None:
    """Refuse versions of mujoco with which FrankaKitchen-v1 fails.

    Raises:
        ZestError: `version` is out of range; the message gives the command to install another.
    """
    if not _MUJOCO_FROM <= tuple(int(part) for part in version.split(".")[:3]) < _MUJOCO_BELOW:
        wanted = f"mujoco>={'.'.join(map(str, _MUJOCO_FROM))},<{'.'.join(map(str, _MUJOCO_BELOW))}"
        raise ZestError(f"the kitchen needs {wanted}, found mujoco {version}; run: pip install '{wanted}'")


def _clip_to_ranges(model: mujoco.MjModel, qpos: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a copy of `qpos` (nq,) with every limited joint inside its range."""
    clipped = qpos.copy()
    limited = np.flatnonzero(model.jnt_limited)
    address = model.jnt_qposadr[limited]
    clipped[address] = np.clip(qpos[address], *model.jnt_range[limited].T)
    return clipped


def env_spec(task: str, init_noise: float = 0.05) -> gymnasium.envs.registration.EnvSpec:
    """Return the EnvSpec of a task; its JSON rebuilds the environment anywhere."""
    spec = gymnasium.spec(ENV_ID)
    return replace(spec, kwargs={"task": task, "init_noise": init_noise})


gymnasium.register(id=ENV_ID, entry_point="zest_rl.envs:KitchenEnv", max_episode_steps=HORIZON)
