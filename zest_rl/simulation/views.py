"""Where frames come from: recorded simulator state, rendered from a ring of views; equal states are one frame.

With the robot hidden a frame depends on the objects' joints alone. States are rounded to a grid of `tolerance` and the
*rounded* state is rendered, so a frame is a function of its key, whichever episode met it first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput
from zest_rl.kitchen.tasks import Task, get_task
from zest_rl.runtime import artifacts
from zest_rl.simulation.rendering import (
    Camera,
    RenderConfig,
    StateRenderer,
    relevant_qpos,
    ring,
    shared_renderer,
)


@dataclass(frozen=True)
class Views:
    """What is rendered of a state: which task is looked at, from how many sides, how finely states are told apart."""

    task: str
    n_views: int = 8
    size: int = 224
    """Side of the square frames, in pixels."""
    robot: bool = False
    """Show the robot (the paper removes it from view)."""
    tolerance: float = 1e-3
    """Grid on which joint positions are rounded, in rad or m; 0 tells all different states apart."""

    def __post_init__(self) -> None:
        get_task(self.task)
        if not 0 <= self.tolerance < np.inf:
            raise BadInput(f"tolerance must be a finite number >= 0 (rad or m), got {self.tolerance}")

    @property
    def render_config(self) -> RenderConfig:
        """How each view is rendered."""
        return RenderConfig(size=self.size, robot=self.robot)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The ring of views."""
        return ring(get_task(self.task), self.n_views)

    def fingerprint(self) -> str:
        """Hash of everything that a frame depends on besides the state."""
        cameras = [[*c.lookat, c.distance, c.azimuth, c.elevation] for c in self.cameras]
        return artifacts.hash_json([self.render_config.fingerprint(), cameras, self.tolerance])

    def renderer(self) -> StateRenderer:
        """Open a renderer of these views; close it after use."""
        return StateRenderer(self.render_config, self.cameras)

    def shared_renderer(self) -> StateRenderer:
        """Return this process's renderer of these views; never close it."""
        return shared_renderer(self.render_config, self.cameras)


def canonical_states(qpos: NDArray[np.float64], views: Views) -> NDArray[np.float64]:
    """Round states to the grid and clear what no frame depends on: (N, nq) → (N, nq); equal rows, equal frames."""
    columns = relevant_qpos(views.render_config)
    states = np.zeros_like(qpos, dtype=np.float64)
    states[:, columns] = qpos[:, columns]
    if views.tolerance > 0:
        states = np.round(states / views.tolerance) * views.tolerance
    return states + 0.0  # −0.0 and 0.0 are one state


def distinct_states(qpos: NDArray[np.float64], views: Views) -> NDArray[np.float64]:
    """Canonical states, each once, in the order in which they first appear: (N, nq) → (U, nq)."""
    states, first = np.unique(canonical_states(qpos, views), axis=0, return_index=True)
    in_order: NDArray[np.float64] = states[np.argsort(first)]
    return in_order


def state_keys(states: NDArray[np.float64]) -> list[bytes]:
    """One key per row of canonical states."""
    return [row.tobytes() for row in np.ascontiguousarray(states)]


def scene_pair(
    renderer: StateRenderer, qpos: NDArray[np.float64], task: Task
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Render the scene before and after the task: (nq,) start state → two arrays (V, H, W, 3)."""
    goal = renderer.with_joint(qpos, task.joint, task.goal)
    return renderer.render(qpos), renderer.render(goal)
