"""Scripted experts that solve the kitchen's tasks from the simulator's state, and the noise that makes them imperfect.

An expert computes its action from the current state alone (no memory, no plan, no randomness), so it recovers from
noise on its actions and can act from any state. There are two skills, dragging a bar and pushing a part; the left door
needs both. Each task is a row in `SKILLS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.arm import CLOSED, OPEN, Arm, Vector, angle_between, gripper_rotation, rotate_about
from zest_rl.kitchen.env import ARM_DIM, KitchenEnv
from zest_rl.types import FloatArray

DONE_PROGRESS = 1.02
"""Beyond this the expert stops moving: a little past the goal, so that the door cannot swing back below it."""


class Expert(Protocol):
    """Acts on the environment that it was made for."""

    def act(self) -> FloatArray:
        """Return the action (9,) float32 in [-1, 1] for the environment's current state, which is not changed."""


# Lengths in m, angles in rad. Yaw is an approach direction: 0 points along world +y, positive turns towards -x; pitch
# points upwards. The tip is the steered point, `tip_offset` from the end-effector site along the gripper.


@dataclass(frozen=True)
class BarDrag:
    """Grasp a vertical bar and drag it along its hinge."""

    site: str
    """Name of the MuJoCo site on the bar."""
    grip_offset: float = 0.0
    """Height of the grip above the site."""
    yaw: float = 0.0
    """At joint position 0."""
    yaw_per_angle: float = 0.0
    """Yaw added per rad of the hinge, so that the gripper follows the door."""
    pitch: float = 0.0
    lead: float = 0.5
    """How far ahead on the hinge's arc the gripper is drawn while dragging."""
    held_width: float = 0.054
    held_distance: float = 0.04
    """The bar is held if the fingers are at most `held_width` apart and the tip at most this far from the bar."""
    tip_offset: float = 0.012


@dataclass(frozen=True)
class Push:
    """Push a part along its joint with closed fingers; it moves towards world +x at joint position 0."""

    site: str
    """Name of the MuJoCo site on the part."""
    contact: tuple[float, float, float]
    """Where the tip touches, from the site, at joint position 0; it moves with the part."""
    pitch: float
    lead: float
    """How far ahead along the joint the tip is drawn while pushing, in m or rad."""
    clearance: float
    """Distance behind the contact at which the tip approaches."""
    tolerance: float
    """Push while the tip is no further than this from the line of pushing."""
    tip_offset: float


@dataclass(frozen=True)
class DragThenPush:
    """Drag a hinged door ajar by its bar, release it, reach round its free edge and push it open from inside."""

    drag: BarDrag
    ajar: float
    """Angle beyond which the door is pushed instead of dragged."""
    barely_ajar: float
    """Angle beyond which it is pushed if the hand is already behind it."""
    height: float
    """World height of the hand while pushing: below the bars."""
    width: float
    """From the hinge to the free edge."""
    push_at: float
    """From the hinge to where the hand pushes."""
    yaw: tuple[float, float]
    """Of the gripper while pushing: at joint position 0, and added per rad up to 1 rad."""
    pitch: float
    lead: float
    tip_offset: float


def _knob(site: str) -> Push:
    return Push(site, (-0.034, 0.0, 0.03), pitch=0.1, lead=0.8, clearance=0.03, tolerance=0.02, tip_offset=0.035)


SKILLS: dict[str, BarDrag | Push | DragThenPush] = {
    "knob2": _knob("knob2_site"),
    "knob3": _knob("knob3_site"),
    "ldoor": DragThenPush(
        BarDrag(
            "hinge_site1", grip_offset=-0.135, yaw=0.5, yaw_per_angle=-0.3, pitch=0.45, lead=0.3,
            held_width=0.064, held_distance=0.05, tip_offset=0.03,
        ),
        ajar=0.3, barely_ajar=0.12, height=2.43, width=0.377, push_at=0.345, yaw=(0.6, 0.4), pitch=0.35, lead=0.6,
        tip_offset=0.045,
    ),
    "rdoor": BarDrag("hinge_site2", grip_offset=-0.1, pitch=0.3, yaw_per_angle=0.3),
    "sdoor": Push(
        "slide_site", (-0.04, 0.0, -0.06), pitch=0.35, lead=0.12, clearance=0.04, tolerance=0.035, tip_offset=0.02
    ),
    "micro": BarDrag("microhandle_site", yaw=0.2),
}  # fmt: skip


@dataclass(frozen=True)
class Manner:
    """How an expert acts; by default without flaws."""

    stop_at: float = DONE_PROGRESS
    """Progress beyond which it holds still."""
    speed: float = 1.0
    """Share of its movement that it makes at each step, in (0, 1]."""
    grip_error: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Error of the position of the bar or the contact, in m along the world's axes."""

    def __post_init__(self) -> None:
        if not 0 < self.speed <= 1:
            raise BadInput(f"the expert's speed must be in (0, 1], got {self.speed}")
        if not np.isfinite([self.stop_at, *self.grip_error]).all():
            raise BadInput(f"stop_at and grip_error must be finite, got {self.stop_at} and {self.grip_error}")


def make_expert(task_name: str, env: gymnasium.Env[Any, Any], manner: Manner | None = None) -> Expert:
    """Return the expert of `task_name`, acting on `env`: a `KitchenEnv` of that task, wrapped or not.

    Args:
        task_name: a name in ``zest_rl.kitchen.tasks.TASKS``.
        env: the environment to act on.
        manner: default without flaws.

    Raises:
        BadInput: there is no such task (the message names the nearest), or `env` is of another one.
    """
    if task_name not in SKILLS:
        raise BadInput(f"there is no expert for task {task_name!r}; {nearest(task_name, SKILLS)}")
    return _ScriptedExpert(kitchen_of(task_name, env), SKILLS[task_name], manner or Manner())


def kitchen_of(task_name: str, env: gymnasium.Env[Any, Any]) -> KitchenEnv:
    """Return the kitchen inside an environment; raises `BadInput` where it is none of this task."""
    kitchen = env.unwrapped
    if not isinstance(kitchen, KitchenEnv) or kitchen.task.name != task_name:
        got = kitchen.task.name if isinstance(kitchen, KitchenEnv) else type(kitchen).__name__
        raise BadInput(f"the expert of {task_name!r} needs a KitchenEnv made with task={task_name!r}, got {got!r}")
    return kitchen


def add_uniform_noise(action: FloatArray, level: float, rng: np.random.Generator) -> FloatArray:
    """Return `action` + uniform noise in [-level, level] on each component, clipped to [-1, 1], float32.

    Raises:
        BadInput: `level` is negative or not finite.
    """
    if not 0 <= level < np.inf:
        raise BadInput(f"the noise level must be a finite number >= 0, got {level}")
    noise = level * rng.uniform(-1.0, 1.0, np.shape(action))
    return np.clip(action + noise, -1.0, 1.0).astype(np.float32)


class _ScriptedExpert:
    """Acts by the task's skill up to the progress in its manner, then holds still."""

    def __init__(self, env: KitchenEnv, skill: BarDrag | Push | DragThenPush, manner: Manner) -> None:
        self._env, self._manner, self._arm = env, manner, Arm(env, 0.0)
        kinds = {BarDrag: _BarDragger, Push: _Pusher, DragThenPush: _DoorOpener}
        self._skill = kinds[type(skill)](env, skill, np.array(manner.grip_error))

    def act(self) -> FloatArray:
        still = self._arm.hold(CLOSED)
        if self._env.progress > self._manner.stop_at:
            return still
        action: FloatArray = self._skill.act()
        if self._manner.speed < 1.0:
            arm = slice(ARM_DIM)
            action[arm] = still[arm] + np.float32(self._manner.speed) * (action[arm] - still[arm])
        return action


class Joint:
    """The task's joint: its position, and where points of the moving part are when it moves on."""

    def __init__(self, env: KitchenEnv) -> None:
        self._env = env
        self._id = env.model.joint(env.task.joint).id
        self._slides = env.model.jnt_type[self._id] == mujoco.mjtJoint.mjJNT_SLIDE
        self._sign = float(np.sign(env.task.goal))

    @property
    def position(self) -> float:
        """In m or rad."""
        return self._env.progress * self._env.task.goal

    @property
    def anchor(self) -> Vector:
        """A point on the axis (3,)."""
        return np.array(self._env.data.xanchor[self._id])

    def ahead(self, point: Vector, lead: float) -> Vector:
        """Return where `point` (3,) of the part is when the joint has moved by `lead` towards the goal."""
        axis = self._env.data.xaxis[self._id]
        if self._slides:
            return np.asarray(point + self._sign * lead * axis)
        return rotate_about(point, self.anchor, axis, self._sign * lead)

    def turned(self, vector: tuple[float, float, float]) -> Vector:
        """Return a direction (3,) fixed to the part that is `vector` at joint position 0."""
        if self._slides:
            return np.array(vector)
        return rotate_about(np.array(vector), np.zeros(3), self._env.data.xaxis[self._id], self.position)


class DoorPlane:
    """Places in a hinged door's own plane: `s` from the hinge along the door, `n` from the door to its inside, in m."""

    def __init__(self, joint: Joint, height: float) -> None:
        self._joint, self._height = joint, height

    def coordinates(self, point: Vector) -> tuple[float, float]:
        """Return (s, n) of a point (3,)."""
        along, inside = self._axes()
        offset = (point - self._joint.anchor)[:2]
        return float(offset @ along), float(offset @ inside)

    def place(self, s: float, n: float) -> Vector:
        """Return the point (3,) at (s, n), at the plane's height."""
        along, inside = self._axes()
        return np.append(self._joint.anchor[:2] + s * along + n * inside, self._height)

    def _axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the horizontal unit vectors (2,) along the door and to its inside."""
        angle = self._joint.position
        along = np.array([np.cos(angle), np.sin(angle)])
        return along, np.array([-along[1], along[0]])


class _BarDragger:
    """Approach the bar from the front, close on it, drag it; the state decides which of the three."""

    # "beside" is the tip's distance from the line of approach, "ahead" along it.
    BESIDE_FREE = 0.012  # back off beyond this, so as not to hit the bar sideways
    BACK_OFF_PER_BESIDE, BACK_OFF_PER_ANGLE, MAX_BACK_OFF = 4.0, 0.3, 0.13
    MISALIGNED = 0.15  # back off beyond this angle to the line of approach
    OPEN_WIDTH = 0.05  # between the fingers; below it they are closing
    START_CLOSING, KEEP_CLOSING = (0.015, 0.02), (0.025, 0.025)  # (ahead, beside) within which to close
    DRAG_TRAVEL = 0.07  # per step

    def __init__(self, env: KitchenEnv, skill: BarDrag, error: Vector) -> None:
        self._env, self._skill = env, skill
        self._arm, self._joint = Arm(env, skill.tip_offset), Joint(env)
        self._bar_site = env.model.site(skill.site).id
        self._to_grip = np.array([0.0, 0.0, skill.grip_offset]) + error

    def act(self) -> FloatArray:
        arm, skill = self._arm, self._skill
        bar = self._env.data.site_xpos[self._bar_site] + self._to_grip
        rotation = gripper_rotation(skill.yaw + skill.yaw_per_angle * self._joint.position, skill.pitch)
        approach = rotation[:, 2]
        tip, current = arm.pose()
        error = bar - tip
        ahead = float(error @ approach)
        beside = float(np.linalg.norm(error - ahead * approach))

        distance = np.linalg.norm(error * [1.0, 1.0, 0.5])  # the bar is vertical: height matters less
        if distance < skill.held_distance and arm.fingers < skill.held_width:
            return arm.move(self._joint.ahead(bar, skill.lead), rotation, CLOSED, self.DRAG_TRAVEL)
        max_ahead, max_beside = self.START_CLOSING if arm.fingers > self.OPEN_WIDTH else self.KEEP_CLOSING
        if ahead < max_ahead and beside < max_beside:
            return arm.move(bar, rotation, CLOSED)
        back_off = self.BACK_OFF_PER_BESIDE * (beside - self.BESIDE_FREE)
        back_off += self.BACK_OFF_PER_ANGLE * max(0.0, angle_between(current[:, 2], approach) - self.MISALIGNED)
        return arm.move(bar - np.clip(back_off, 0.0, self.MAX_BACK_OFF) * approach, rotation, OPEN)


class _Pusher:
    """Approach behind the contact, then push along the joint; the state decides which of the two."""

    ALONG = (-0.08, 0.03)  # how far behind and past the contact the tip may be while pushing
    BESIDE_FREE, BACK_OFF_PER_BESIDE, MAX_BACK_OFF = 0.01, 3.0, 0.08  # as for dragging

    def __init__(self, env: KitchenEnv, skill: Push, error: Vector) -> None:
        self._env, self._skill, self._error = env, skill, error
        self._arm, self._joint = Arm(env, skill.tip_offset), Joint(env)
        self._site = env.model.site(skill.site).id
        self._rotation = gripper_rotation(0.0, skill.pitch)

    def act(self) -> FloatArray:
        skill, approach = self._skill, self._rotation[:, 2]
        contact = self._env.data.site_xpos[self._site] + self._joint.turned(skill.contact) + self._error
        direction = self._joint.turned((1.0, 0.0, 0.0))
        tip, _ = self._arm.pose()
        along = float((tip - contact) @ direction)
        beside = np.linalg.norm(tip - contact - along * direction)
        if beside < skill.tolerance and self.ALONG[0] < along < self.ALONG[1]:
            return self._arm.move(self._joint.ahead(contact, skill.lead), self._rotation, CLOSED)
        behind = contact - skill.clearance * direction
        error = behind - tip
        off_line = np.linalg.norm(error - (error @ approach) * approach)
        back_off = np.clip(self.BACK_OFF_PER_BESIDE * (off_line - self.BESIDE_FREE), 0.0, self.MAX_BACK_OFF)
        return self._arm.move(behind - back_off * approach, self._rotation, CLOSED)


class _DoorOpener:
    """Drag the door ajar, then push it from inside; the state decides the step.

    Places are those of `DoorPlane`.
    """

    INSIDE, OUTER = 0.018, 0.08  # n beyond which the tip is behind the door; s past the free edge that is still near
    PUSH_N, ENTER_N = 0.035, 0.045  # n of the tip while pushing and while moving to where it pushes
    PAST_EDGE = 0.015  # s beyond the free edge up to which the tip may push
    ROUND_EDGE, ROUND_RANGE, ROUND_N = 0.045, 0.03, (-0.12, -0.03, 0.06)  # the way round the free edge
    AT_BAR, BELOW_BAR = 0.04, 0.18  # the tip is at the bar: horizontal distance, and depth below it
    RETREAT, RETREAT_ASIDE = 0.08, 0.03

    def __init__(self, env: KitchenEnv, skill: DragThenPush, error: Vector) -> None:
        self._env, self._skill = env, skill
        self._arm, self._joint = Arm(env, skill.tip_offset), Joint(env)
        self._bar_site = env.model.site(skill.drag.site).id
        self._dragger = _BarDragger(env, skill.drag, error)
        self._plane = DoorPlane(self._joint, skill.height)

    def act(self) -> FloatArray:
        opened = abs(self._joint.position)
        tip, _ = self._arm.pose()
        s, n = self._plane.coordinates(tip)
        edge = self._skill.width
        behind = (n > self.INSIDE and s < edge + self.OUTER) or (edge - 0.04 < s < edge + self.OUTER and n > -0.15)
        if opened > self._skill.ajar or (opened > self._skill.barely_ajar and behind):
            return self._push(tip, s, n)
        return self._dragger.act()

    def _push(self, tip: Vector, s: float, n: float) -> FloatArray:
        arm, skill = self._arm, self._skill
        yaw, yaw_per_angle = skill.yaw
        rotation = gripper_rotation(yaw + yaw_per_angle * min(1.0, abs(self._joint.position)), skill.pitch)
        if n > self.INSIDE and s < skill.width + self.PAST_EDGE:
            target = self._joint.ahead(self._plane.place(skill.push_at, self.PUSH_N), skill.lead)
            return arm.move(target, rotation, CLOSED)
        if n > self.INSIDE and s < skill.width + self.OUTER:
            return arm.move(self._plane.place(skill.push_at, self.ENTER_N), rotation, CLOSED)
        bar = self._env.data.site_xpos[self._bar_site]
        if np.linalg.norm((tip - bar)[:2]) < self.AT_BAR and tip[2] > bar[2] - self.BELOW_BAR and s < 0.35:
            _, current = arm.pose()
            back = tip - self.RETREAT * current[:, 2] + self.RETREAT_ASIDE * current[:, 1]
            return arm.move(back, current, OPEN)
        # round the free edge: the further the tip is from clearing it, the further in front of the door
        front, near, inside = self.ROUND_N
        need = np.clip((skill.width + self.ROUND_RANGE - s) / self.ROUND_RANGE, 0.0, 1.0)
        target_n = inside * (1.0 - need) + need * np.clip(n, front, near)
        return arm.move(self._plane.place(skill.width + self.ROUND_EDGE, target_n), rotation, CLOSED)
