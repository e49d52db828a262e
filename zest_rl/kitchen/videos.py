"""Recorded kitchen states → MP4 videos with the robot in view, for people; no score uses them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zest_rl.kitchen.scene import RenderConfig, shared_renderer
from zest_rl.runtime.parallel import run_jobs
from zest_rl.simulation.rendering import Camera
from zest_rl.simulation.videos import write_mp4
from zest_rl.types import Frame

OVERVIEW = Camera(lookat=(-0.4, 0.3, 1.9), distance=2.4, azimuth=60.0, elevation=-25.0)
"""Robot, microwave, stove and cabinets in one picture."""
FPS = 12.5
"""Frames per second of the environment: a video runs in real time."""


States: TypeAlias = NDArray[np.float64] | Mapping[str, NDArray[np.float64]]
"""(T+1, nq) simulator positions; or, outside the kitchen, the parts of T+1 states by name."""


class Overview(Protocol):
    """How people see another environment than the kitchen."""

    @property
    def fps(self) -> float:
        """Frames per second: one per step."""

    def frames(self, states: States) -> Iterator[Frame]:
        """Draw the states of an episode."""


@dataclass(frozen=True, eq=False)
class Video:
    """An episode and the file of its video."""

    states: States
    path: Path
    beside: States | None = None
    """Of another episode, shown on the right."""
    overview: Overview | None = None
    """None: of the kitchen."""


Film = Callable[[Video], Path]
"""Returns the path of a video, which may be written later."""


def write_video(video: Video, size: int = 320) -> Path:
    """Render an episode and write it as H.264, atomically; `size` is the side of the square frames, in even pixels."""
    overview = _Kitchen(size) if video.overview is None else video.overview
    episodes = [overview.frames(states) for states in (video.states, video.beside) if states is not None]
    # each step is drawn before the next: they share a simulation
    write_mp4(video.path, (np.hstack(step) for step in zip(*episodes, strict=True)), overview.fps)
    return video.path


@dataclass(frozen=True)
class _Kitchen:
    size: int
    fps: float = FPS

    def frames(self, states: States) -> Iterator[Frame]:
        assert not isinstance(states, Mapping)
        renderer = shared_renderer(RenderConfig(size=self.size, robot=True), (OVERVIEW,))
        return (renderer.render(qpos)[0] for qpos in states)


def ensure_video(video: Video) -> Path:
    """Write the video if it does not exist, and return its path."""
    return video.path if video.path.exists() else write_video(video)


def missing(videos: Iterable[Video]) -> dict[Path, Video]:
    """Return the videos that do not exist, by their paths."""
    return {video.path: video for video in videos if not video.path.exists()}


def ensure_videos(
    videos: Iterable[Video], *, n_workers: int | None = None, on_done: Callable[[], None] = lambda: None
) -> None:
    """Write the `missing` videos, by default with one process per core; `on_done` is called after each.

    Raises:
        ZestError: a process died; finished videos are kept.
    """
    jobs = {str(path): video for path, video in missing(videos).items()}
    for _ in run_jobs(write_video, jobs, n_workers=n_workers, stage="drawing videos"):
        on_done()
