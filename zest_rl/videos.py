"""Recorded states → MP4 videos with the robot in view, for people to look at; no score is computed from them."""

from __future__ import annotations

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from numpy.typing import ArrayLike, NDArray

from zest_rl import artifacts
from zest_rl.rendering import Camera, RenderConfig, StateRenderer

SCENE = Camera(lookat=(-0.4, 0.3, 1.9), distance=2.4, azimuth=60.0, elevation=-25.0)
"""Robot, microwave, stove and cabinets in one picture."""
FPS = 12.5
"""Frames per second of the environment: a video runs in real time."""


def write_video(
    states: NDArray[np.float64], path: Path, *, beside: NDArray[np.float64] | None = None, size: int = 320
) -> Path:
    """Render an episode and write it as H.264.

    Args:
        states: (T+1, nq) simulator positions.
        path: where the MP4 is left, atomically.
        beside: (T+1, nq) of another episode, which is shown to the right.
        size: side of the square frames, in pixels; even.
    """
    episodes = [states] if beside is None else [states, beside]
    with StateRenderer(RenderConfig(size=size, robot=True), (SCENE,)) as renderer:
        frames: list[ArrayLike] = [
            np.hstack([renderer.render(qpos)[0] for qpos in step]) for step in zip(*episodes, strict=True)
        ]
    with artifacts.atomic_path(path) as temporary:
        mp4 = temporary.with_suffix(".mp4")
        try:
            imageio.mimwrite(mp4, frames, fps=FPS, codec="libx264", quality=7, macro_block_size=2)
            mp4.replace(temporary)
        finally:
            mp4.unlink(missing_ok=True)
    return path


def ensure_video(states: NDArray[np.float64], path: Path, *, beside: NDArray[np.float64] | None = None) -> Path:
    """Return `path`, after `write_video` if nothing is there yet."""
    return path if path.exists() else write_video(states, path, beside=beside)


def representative(returns: NDArray[np.float64]) -> dict[str, int]:
    """Indices of the best, the median and the worst episode by return; ties go to the earlier one."""
    order = np.argsort(-np.asarray(returns), kind="stable")
    return {"best": int(order[0]), "median": int(order[len(order) // 2]), "worst": int(order[-1])}
