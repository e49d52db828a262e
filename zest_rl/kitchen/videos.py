"""How people see the kitchen: everything in one picture, the robot in view; no score uses it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from zest_rl.kitchen.scene import RenderConfig, shared_renderer
from zest_rl.simulation.rendering import Camera
from zest_rl.simulation.videos import Trajectory
from zest_rl.types import Frame

OVERVIEW = Camera(lookat=(-0.4, 0.3, 1.9), distance=2.4, azimuth=60.0, elevation=-25.0)
"""Robot, microwave, stove and cabinets in one picture."""
FPS = 12.5
"""Frames per second of the environment: a video runs in real time."""


@dataclass(frozen=True)
class KitchenOverview:
    """The `zest_rl.simulation.videos.Overview` of zest/Kitchen-v1."""

    size: int = 320
    """Side of the square frames, in even pixels."""
    fps: float = FPS

    def frames(self, states: Trajectory) -> Iterator[Frame]:
        """Draw the states of an episode, of which qpos is all."""
        renderer = shared_renderer(RenderConfig(size=self.size, robot=True), (OVERVIEW,))
        return (renderer.render(qpos)[0] for qpos in states["qpos"])
