"""Control of the robot's arm: moves a point of the gripper to a target, within the joints' limits per step."""

from __future__ import annotations

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.kitchen.env import ACT_DIM, ARM_DIM, FRAME_SKIP, MAX_JOINT_SPEED, KitchenEnv
from zest_rl.types import FloatArray

Vector = NDArray[np.float64]  # (3,) world coordinates, metres or a rotation vector in rad
Matrix = NDArray[np.float64]  # (3, 3) rotation; the columns are the axes

OPEN, CLOSED = 1.0, -1.0  # finger commands


class Arm:
    """Moves the gripper by damped least squares on the arm's Jacobian, within the joints' limits per step."""

    POSITION_GAIN, ROTATION_GAIN = 0.8, 0.3  # share of the error to remove in one step
    MAX_TRAVEL, MAX_TURN = 0.08, 0.2  # m, rad per step
    ROTATION_WEIGHT = 0.15  # m per rad
    DAMPING = 0.05
    POSTURE_GAIN = 0.02  # share of the way back to the start posture, in the null space, per step
    LIMIT_MARGIN = 0.02  # rad
    MIN_STEP = 1e-4  # rad; keeps the bounds of a joint at its limit apart

    def __init__(self, env: KitchenEnv, tip_offset: float) -> None:
        """Steer the point `tip_offset` m from the end-effector site along the gripper."""
        model = env.model
        self._tip_offset = tip_offset
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

    @property
    def fingers(self) -> float:
        """Distance between the two fingers, in m."""
        return float(self._data.qpos[ARM_DIM:ACT_DIM].sum())

    def pose(self) -> tuple[Vector, Matrix]:
        """Return the steered point (3,) and the gripper's rotation (3, 3), whose z axis points out of the hand."""
        rotation = self._data.site_xmat[self._site].reshape(3, 3).copy()
        return self._data.site_xpos[self._site] + self._tip_offset * rotation[:, 2], rotation

    def hold(self, fingers: float) -> FloatArray:
        """Return the action that keeps the arm where it is."""
        return self._action(self._gravity(), fingers)

    def move(self, target: Vector, rotation: Matrix, fingers: float, max_travel: float = MAX_TRAVEL) -> FloatArray:
        """Return the action that moves the steered point and the gripper's rotation towards their targets."""
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
    inside. That is not always the exact minimum but, unlike clipping, it keeps the direction of the task.

    Args:
        jacobian: (m, n).
        task: (m,) wanted change in the Jacobian's output space.
        preferred: (n,) step in the directions that the task leaves free.
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


def gripper_rotation(yaw: float, pitch: float) -> Matrix:
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


def rotate_about(point: Vector, anchor: Vector, axis: Vector, angle: float) -> Vector:
    """Return the point (3,) turned by `angle` rad about the line through `anchor` along `axis`."""
    quaternion, arm = np.zeros(4), np.zeros(3)
    mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
    mujoco.mju_rotVecQuat(arm, point - anchor, quaternion)
    return anchor + arm


def _limit_norm(vector: Vector, limit: float) -> Vector:
    return vector * min(1.0, limit / (float(np.linalg.norm(vector)) + 1e-9))


def angle_between(a: Vector, b: Vector) -> float:
    """Return the angle between two unit vectors (3,), in rad."""
    return float(np.arccos(np.clip(a @ b, -1.0, 1.0)))
