"""Scripted experts that solve kitchen tasks from the simulator's state, and the noise that makes them imperfect.

An expert computes its action from the current state alone (no memory, no plan, no randomness), so it recovers from
noise put on its actions and may be asked at any state. A further task of the same kind is a row in `BAR_DRAGS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import zest_rl.load_order  # noqa: F401  # isort: skip
import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.envs import ACT_DIM, ARM_DIM, FRAME_SKIP, MAX_JOINT_SPEED, KitchenEnv
from zest_rl.errors import BadInput, nearest
from zest_rl.types import FloatArray

Vector = NDArray[np.float64]  # (3,) world coordinates, metres or a rotation vector in rad
Matrix = NDArray[np.float64]  # (3, 3) rotation; the columns are the axes

OPEN, CLOSED = 1.0, -1.0  # finger commands
DONE_PROGRESS = 1.02
"""Beyond this the expert stops moving: a little past the goal, so that the door cannot swing back below it."""


class Expert(Protocol):
    """Acts on the environment that it was made for."""

    def act(self) -> FloatArray:
        """Return the action (9,) float32 in [-1, 1] for the environment's current state, which is not changed."""
        ...


@dataclass(frozen=True)
class BarDrag:
    """Grasp a vertical bar and drag it along its hinge: the parameters of one task. Lengths in m, angles in rad."""

    site: str
    """Name of the MuJoCo site on the bar."""
    grip_offset: float = 0.0
    """Height of the grip above the site."""
    yaw: float = 0.0
    """Approach direction at joint position 0: 0 points along world +y, positive turns towards -x."""
    yaw_per_angle: float = 0.0
    """Yaw added per rad of the hinge, so that the gripper follows the door."""
    pitch: float = 0.0
    """Approach direction: positive points upwards."""
    lead: float = 0.5
    """How far ahead on the hinge's arc the gripper is drawn while dragging."""


BAR_DRAGS: dict[str, BarDrag] = {
    "micro": BarDrag("microhandle_site", yaw=0.2),
    "rdoor": BarDrag("hinge_site2", grip_offset=-0.1, pitch=0.3, yaw_per_angle=0.3),
}


def make_expert(task_name: str, env: gymnasium.Env[Any, Any]) -> Expert:
    """Return the expert of `task_name`, acting on `env`: a `KitchenEnv` of that task, wrapped or not.

    Raises:
        BadInput: the task has no expert (the message names those that have one), or `env` is not of that task.
    """
    if task_name not in BAR_DRAGS:
        raise BadInput(f"there is no expert for task {task_name!r}; {nearest(task_name, BAR_DRAGS)}")
    kitchen = env.unwrapped
    if not isinstance(kitchen, KitchenEnv) or kitchen.task.name != task_name:
        got = kitchen.task.name if isinstance(kitchen, KitchenEnv) else type(kitchen).__name__
        raise BadInput(f"the expert of {task_name!r} needs a KitchenEnv made with task={task_name!r}, got {got!r}")
    return _BarDragExpert(kitchen, BAR_DRAGS[task_name])


def add_uniform_noise(action: FloatArray, level: float, rng: np.random.Generator) -> FloatArray:
    """Return `action` + uniform noise in [-level, level] on each component, clipped to [-1, 1], float32.

    Raises:
        BadInput: `level` is negative or not finite.
    """
    if not 0 <= level < np.inf:
        raise BadInput(f"the noise level must be a finite number >= 0, got {level}")
    noise = level * rng.uniform(-1.0, 1.0, np.shape(action))
    return np.clip(action + noise, -1.0, 1.0).astype(np.float32)


class _BarDragExpert:
    """Approach the bar from the front, close on it, drag it; which of the three is read from the state."""

    # Lengths in m, angles in rad. "beside" is the tip's distance from the line of approach, "ahead" along it.
    BESIDE_FREE = 0.012  # back off beyond this, not to hit the bar sideways
    BACK_OFF_PER_BESIDE, BACK_OFF_PER_ANGLE, MAX_BACK_OFF = 4.0, 0.3, 0.13
    MISALIGNED = 0.15  # back off beyond this angle to the line of approach
    OPEN_WIDTH = 0.05  # between the fingers; below it they are closing
    START_CLOSING, KEEP_CLOSING = (0.015, 0.02), (0.025, 0.025)  # (ahead, beside) within which to close
    HELD_WIDTH, HELD_DISTANCE = 0.054, 0.04  # the bar is held: between the fingers, tip to bar
    DRAG_TRAVEL = 0.07  # per step

    def __init__(self, env: KitchenEnv, skill: BarDrag) -> None:
        self._env, self._skill = env, skill
        self._arm = _Arm(env)
        self._joint = env.model.joint(env.task.joint).id
        self._bar_site = env.model.site(skill.site).id

    def act(self) -> FloatArray:
        arm, env, skill = self._arm, self._env, self._skill
        if env.progress > DONE_PROGRESS:
            return arm.hold(CLOSED)
        bar = env.data.site_xpos[self._bar_site] + [0.0, 0.0, skill.grip_offset]
        angle = env.progress * env.task.goal
        rotation = _gripper_rotation(skill.yaw + skill.yaw_per_angle * angle, skill.pitch)
        approach = rotation[:, 2]
        tip, current = arm.pose()
        error = bar - tip
        ahead = float(error @ approach)
        aside = error - ahead * approach
        beside = float(np.linalg.norm(aside))
        width = float(env.data.qpos[ARM_DIM:ACT_DIM].sum())

        distance = np.linalg.norm(error * [1.0, 1.0, 0.5])  # the bar is vertical: height matters less
        if distance < self.HELD_DISTANCE and width < self.HELD_WIDTH:
            anchor, axis = env.data.xanchor[self._joint], env.data.xaxis[self._joint]
            target = _rotate_about(bar, anchor, axis, np.sign(env.task.goal) * skill.lead)
            return arm.move(target, rotation, CLOSED, self.DRAG_TRAVEL)
        max_ahead, max_beside = self.START_CLOSING if width > self.OPEN_WIDTH else self.KEEP_CLOSING
        if ahead < max_ahead and beside < max_beside:
            return arm.move(bar, rotation, CLOSED)
        misalignment = float(np.arccos(np.clip(current[:, 2] @ approach, -1.0, 1.0)))
        back_off = self.BACK_OFF_PER_BESIDE * (beside - self.BESIDE_FREE)
        back_off += self.BACK_OFF_PER_ANGLE * max(0.0, misalignment - self.MISALIGNED)
        return arm.move(bar - np.clip(back_off, 0.0, self.MAX_BACK_OFF) * approach, rotation, OPEN)


class _Arm:
    """Moves the gripper by damped least squares on the arm's Jacobian, within what the joints can do in one step."""

    TIP_OFFSET = 0.012  # m from the end-effector site along the gripper, the point that is steered
    POSITION_GAIN, ROTATION_GAIN = 0.8, 0.3  # share of the error to remove in one step
    MAX_TRAVEL, MAX_TURN = 0.08, 0.2  # m, rad per step
    ROTATION_WEIGHT = 0.15  # m per rad
    DAMPING = 0.05
    POSTURE_GAIN = 0.02  # share of the way back to the start posture, in the null space, per step
    LIMIT_MARGIN = 0.02  # rad
    MIN_STEP = 1e-4  # rad; keeps the bounds of a joint at its limit apart

    def __init__(self, env: KitchenEnv) -> None:
        model = env.model
        self._model, self._data = model, env.data
        self._site = model.site("end_effector").id
        self._body = int(model.site_bodyid[self._site])
        self._posture = env.start_qpos[:ARM_DIM]
        self._stiffness = model.actuator_gainprm[:ARM_DIM, 0].copy()
        self._low = np.maximum(model.jnt_range[:ARM_DIM, 0] + self.LIMIT_MARGIN, env.control_low[:ARM_DIM])
        self._high = np.minimum(model.jnt_range[:ARM_DIM, 1] - self.LIMIT_MARGIN, env.control_high[:ARM_DIM])
        # A servo with stiffness k and damping d approaches its target as 1 - exp(-k t / d).
        seconds = model.opt.timestep * FRAME_SKIP
        self._command_range = MAX_JOINT_SPEED * seconds  # rad that action 1 shifts the servo's target
        response = 1.0 - np.exp(-seconds * self._stiffness / model.dof_damping[:ARM_DIM])
        self._reach = response * self._command_range  # rad that a joint really moves for action 1

    def pose(self) -> tuple[Vector, Matrix]:
        """Return the steered point (3,) and the gripper's rotation (3, 3), whose z axis points out of the hand."""
        rotation = self._data.site_xmat[self._site].reshape(3, 3).copy()
        return self._data.site_xpos[self._site] + self.TIP_OFFSET * rotation[:, 2], rotation

    def hold(self, fingers: float) -> FloatArray:
        """Return the action that keeps the arm where it is."""
        return self._action(self._gravity(), fingers)

    def move(self, target: Vector, rotation: Matrix, fingers: float, max_travel: float = MAX_TRAVEL) -> FloatArray:
        """Return the action that brings the steered point and the gripper's rotation nearer to their targets."""
        tip, current = self.pose()
        travel = _limit_norm(self.POSITION_GAIN * (target - tip), max_travel)
        turn = _limit_norm(self.ROTATION_GAIN * (current @ _rotation_vector(current.T @ rotation)), self.MAX_TURN)
        jacobian_position, jacobian_rotation = np.zeros((2, 3, self._model.nv))
        mujoco.mj_jac(self._model, self._data, jacobian_position, jacobian_rotation, tip, self._body)
        jacobian = np.vstack([jacobian_position, self.ROTATION_WEIGHT * jacobian_rotation])[:, :ARM_DIM]
        task = np.concatenate([travel, self.ROTATION_WEIGHT * turn])

        gravity = self._gravity()
        qpos = self._data.qpos[:ARM_DIM]
        low = np.minimum(np.maximum((-1.0 - gravity) * self._reach, np.minimum(self._low - qpos, 0.0)), -self.MIN_STEP)
        high = np.maximum(np.minimum((1.0 - gravity) * self._reach, np.maximum(self._high - qpos, 0.0)), self.MIN_STEP)
        posture = self.POSTURE_GAIN * (self._posture - qpos)
        joint_step = bounded_least_squares(jacobian, task, posture, low, high, self.DAMPING)
        return self._action(joint_step / self._reach + gravity, fingers)

    def _gravity(self) -> NDArray[np.float64]:
        """Return the arm action (7,) whose servo torque balances gravity and Coriolis forces."""
        return np.asarray(self._data.qfrc_bias[:ARM_DIM] / self._stiffness / self._command_range)

    def _action(self, arm: NDArray[np.float64], fingers: float) -> FloatArray:
        command: FloatArray = np.append(arm, [fingers, fingers]).clip(-1.0, 1.0).astype(np.float32)
        return command


def bounded_least_squares(
    jacobian: NDArray[np.float64],
    task: NDArray[np.float64],
    preferred: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    damping: float,
) -> NDArray[np.float64]:
    """Return the step x (n,) that minimises ``|J x − task|² + damping² |x − preferred|²`` inside the bounds.

    The joint that exceeds its bound by the largest factor is fixed there and the others are solved again, until all are
    inside. That is not always the exact minimum, but it keeps the direction of the task where clipping would not.

    Args:
        jacobian: (m, n).
        task: (m,) wanted change of what the Jacobian maps to.
        preferred: (n,) step to take where the task leaves freedom.
        low: (n,) lower bounds, negative.
        high: (n,) upper bounds, positive.
        damping: in the units of `jacobian`, positive.
    """
    n_task, n_joints = jacobian.shape
    step = np.zeros(n_joints)
    free = np.ones(n_joints, dtype=bool)
    while free.any():
        part = jacobian[:, free]
        inverse = part.T @ np.linalg.inv(part @ part.T + damping**2 * np.eye(n_task))
        residual = task - jacobian[:, ~free] @ step[~free]
        step[free] = inverse @ (residual - part @ preferred[free]) + preferred[free]
        excess = np.where(free, np.maximum(step / low, step / high), 0.0)
        worst = int(np.argmax(excess))
        if excess[worst] <= 1.0:
            break
        step[worst] = np.clip(step[worst], low[worst], high[worst])
        free[worst] = False
    return step


def _gripper_rotation(yaw: float, pitch: float) -> Matrix:
    """Return the gripper's rotation for an approach direction (z), with x upwards and the fingers along y."""
    z = np.array([-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    y = np.cross(z, [0.0, 0.0, 1.0])
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _rotation_vector(rotation: Matrix) -> Vector:
    quaternion, vector = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, rotation.flatten())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector


def _rotate_about(point: Vector, anchor: Vector, axis: Vector, angle: float) -> Vector:
    quaternion, arm = np.zeros(4), np.zeros(3)
    mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
    mujoco.mju_rotVecQuat(arm, point - anchor, quaternion)
    return anchor + arm


def _limit_norm(vector: Vector, limit: float) -> Vector:
    return vector * min(1.0, limit / (float(np.linalg.norm(vector)) + 1e-9))
