"""MuJoCo models for rendering only, without parts that hide the object, or cost time and show nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import fast_simplification
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput


@dataclass(frozen=True)
class SceneConfig:
    """What of a model is shown, and from where; bodies by name, empty: by the rules of `zest_rl.simulation.bodies`."""

    robot: tuple[str, ...] = ()
    """Bodies that are hidden, with everything below them."""
    look_at: str | None = None
    """Body in the middle of the views."""
    show_robot: bool = False
    n_views: int = 8
    tolerance: float = 1e-3
    """Grid on which joint positions are rounded, in rad or m; 0: no rounding."""

    def __post_init__(self) -> None:
        if self.show_robot and self.robot:
            raise BadInput("--robot names bodies that are hidden, --show-robot hides none; give one of them")
        if not 0 <= self.tolerance < np.inf:
            raise BadInput(f"tolerance must be a finite number >= 0 (rad or m), got {self.tolerance}")


@dataclass(frozen=True, eq=False)
class Scene:
    """A render-only copy of a simulated model, from which parts such as the robot may be left out."""

    model: mujoco.MjModel
    """Never stepped."""
    n_qpos: int
    """Length of a state of the simulated model."""
    visible: slice
    """Entries of such a state that `model` has joints for, in their order; a frame depends on no others."""

    def with_joint(self, qpos: NDArray[np.float64], joint: str, position: float) -> NDArray[np.float64]:
        """Return a copy of a state (n_qpos,) with one of the scene's joints moved to `position` (rad or m).

        Joints that the model couples to it move too.
        """
        model, first = self.model, self.visible.start
        mover = model.joint(joint).id
        moved = qpos.copy()
        moved[first + model.jnt_qposadr[mover]] = position
        coupled = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_obj1id == mover)
        for equality in np.flatnonzero(coupled):  # mover = offset + slope · follower, both from their rest positions
            offset, slope = model.eq_data[equality, :2]
            address = model.jnt_qposadr[model.eq_obj2id[equality]]
            rest = model.qpos0[model.jnt_qposadr[mover]]
            moved[first + address] = model.qpos0[address] + (position - rest - offset) / slope
        return moved


def compile_for_drawing(spec: mujoco.MjSpec, size: int) -> mujoco.MjModel:
    """Compile a model for square frames of `size` pixels, without shadows and multisampling."""
    visual = spec.visual
    visual.global_.offwidth = visual.global_.offheight = size
    visual.quality.shadowsize = visual.quality.offsamples = 0
    visual.quality.numslices = 12
    return spec.compile()


def decimate(mesh: Any, stl: Path, fraction: float) -> None:
    """Replace the file of a spec's mesh, a binary STL, by about `fraction` of its faces."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = np.frombuffer(stl.read_bytes(), record, offset=84)["corners"]  # after a title of 80 bytes, uint32 count
    vertices, faces = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    vertices, faces = fast_simplification.simplify(vertices, faces.reshape(-1, 3), target_reduction=1 - fraction)
    mesh.file = ""
    mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()
