"""Kitchen states → frames, rendered from a ring of views around the part that the task moves.

With the robot hidden a frame depends on the objects' joints alone, so many states share a frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput
from zest_rl.kitchen.scene import (
    FRAMING,
    N_QPOS,
    RenderConfig,
    open_renderer,
    relevant_qpos,
    shared_renderer,
    task_cameras,
)
from zest_rl.kitchen.tasks import Task, get_task
from zest_rl.runtime import artifacts
from zest_rl.runtime.records import from_json
from zest_rl.simulation.rendering import Camera, StateRenderer
from zest_rl.simulation.views import each_once, on_grid


@dataclass(frozen=True)
class Views:
    """How a state is rendered: views around the object of a task, and the grid on which states are rounded."""

    task: str
    n_views: int = 8
    """Of the whole ring, of which those are left out from which the scene hides the object."""
    size: int = 224
    """Side of the square frames, in pixels."""
    robot: bool = False
    """Show the robot (the paper removes it from view)."""
    tolerance: float = 1e-3
    """Grid on which joint positions are rounded, in rad or m; 0: no rounding."""
    framing: int = FRAMING
    """Version of the tasks' cameras, see `task_cameras`; records of before name none, which is 1."""

    def __post_init__(self) -> None:
        _ = self.render_config, self.cameras  # each checks itself
        if not 0 <= self.tolerance < np.inf:
            raise BadInput(f"tolerance must be a finite number >= 0 (rad or m), got {self.tolerance}")

    @classmethod
    def from_record(cls, values: Mapping[str, Any]) -> Self:
        """Read views as a dataset's metadata and a scorer's file hold them; raises as `from_json`."""
        return from_json(cls, {"framing": 1, **values})

    @property
    def render_config(self) -> RenderConfig:
        """How each view is rendered."""
        return RenderConfig(size=self.size, robot=self.robot)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The ring of views."""
        return task_cameras(get_task(self.task), self.n_views, self.framing)

    @property
    def n_drawn(self) -> int:
        """Number of cameras, without those that are left out."""
        return len(self.cameras)

    def fingerprint(self) -> str:
        """Hash of everything that a frame depends on besides the state."""
        cameras = [[*c.lookat, c.distance, c.azimuth, c.elevation] for c in self.cameras]
        return artifacts.hash_json([self.render_config.fingerprint(), cameras, self.tolerance])

    @property
    def width(self) -> int:
        """Numbers in a state."""
        return N_QPOS

    def read(self, env: Any, first: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """Return the state of a `KitchenEnv`: (nq,)."""
        return np.array(env.data.qpos)

    def canonical(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Round states to the grid and zero what no frame depends on: (N, nq) → (N, nq)."""
        return canonical_states(states, self)

    def render(self, state: NDArray[np.float64]) -> list[NDArray[np.uint8]]:
        """Draw a state: V frames (H, W, 3)."""
        return list(self.shared_renderer().render(state))

    def renderer(self) -> StateRenderer:
        """Open a renderer of these views; close it after use."""
        return open_renderer(self.render_config, self.cameras)

    def shared_renderer(self) -> StateRenderer:
        """Return this process's renderer of these views; never close it."""
        return shared_renderer(self.render_config, self.cameras)


def canonical_states(qpos: NDArray[np.float64], views: Views) -> NDArray[np.float64]:
    """Round states to the grid and zero what no frame depends on: (N, nq) → (N, nq); equal rows have equal frames."""
    return on_grid(qpos, relevant_qpos(views.render_config), views.tolerance)


def distinct_states(qpos: NDArray[np.float64], views: Views) -> NDArray[np.float64]:
    """Canonical states, each once, in the order in which they first appear: (N, nq) → (U, nq)."""
    return each_once(canonical_states(qpos, views))


def scene_pair(
    renderer: StateRenderer, qpos: NDArray[np.float64], task: Task
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Render the scene before and after the task: (nq,) start state → two arrays (V, H, W, 3)."""
    goal = renderer.scene.with_joint(qpos, task.joint, task.goal)
    return renderer.render(qpos), renderer.render(goal)
