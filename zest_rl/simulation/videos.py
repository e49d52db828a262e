"""Frames → MP4 videos that play in every browser."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import imageio.v2 as imageio

from zest_rl.runtime import artifacts
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
