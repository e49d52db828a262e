"""Frames or recorded episodes → MP4 videos that play in every browser: for people, no score uses them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from zest_rl.runtime import artifacts
from zest_rl.runtime.parallel import run_jobs
from zest_rl.types import Frame


def write_mp4(path: Path, frames: Iterable[Frame], fps: float) -> None:
    """Write frames, each (H, W, 3) with even H and W, as H.264, atomically."""
    with artifacts.atomic_path(path) as temporary:
        mp4 = temporary.with_name(f"{temporary.name}.mp4")
        try:
            writer: Any = imageio.get_writer(mp4, fps=fps, codec="libx264", quality=7, macro_block_size=2)
            with closing(writer):  # a writer that is left open writes the file later
                for frame in frames:
                    writer.append_data(frame)
            mp4.replace(temporary)
        finally:
            mp4.unlink(missing_ok=True)


Trajectory = Mapping[str, NDArray[np.float64]]
"""The parts of T+1 states of a simulator by name, such as qpos (T+1, nq)."""


class Overview(Protocol):
    """How people see an environment. Sent to worker processes, so it is small and frozen."""

    @property
    def fps(self) -> float:
        """Frames per second: one per step."""

    def frames(self, states: Trajectory) -> Iterator[Frame]:
        """Draw the states of an episode, each as (H, W, 3) with even H and W."""


@dataclass(frozen=True, eq=False)
class Video:
    """An episode and the file of its video."""

    states: Trajectory
    path: Path
    overview: Overview
    beside: Trajectory | None = None
    """Of another episode, as long, shown on the right."""


Film = Callable[[Video], Path]
"""Returns the path of a video, which may be written later."""


def write_video(video: Video) -> Path:
    """Draw an episode and write it as H.264, atomically."""
    episodes = [video.overview.frames(states) for states in (video.states, video.beside) if states is not None]
    # each step is drawn before the next: they share a simulation
    write_mp4(video.path, (np.hstack(step) for step in zip(*episodes, strict=True)), video.overview.fps)
    return video.path


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
