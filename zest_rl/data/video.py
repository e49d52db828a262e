"""Videos, as files or as folders of pictures → RGB frames."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.images import list_images, read_image
from zest_rl.errors import BadInput
from zest_rl.types import Frame

VIDEO_SUFFIXES = (".avi", ".mkv", ".mov", ".mp4", ".webm")


def iter_frames(path: Path) -> Iterator[Frame]:
    """Yield all stored frames of a video: (H, W, 3) uint8 RGB.

    Args:
        path: a video file that ffmpeg reads, or a folder of pictures, in the order of `frame_files`.

    Raises:
        BadInput: no video, or damaged.
    """
    if path.is_dir():
        yield from map(read_image, frame_files(path))
        return
    as_stored = ["-fps_mode", "passthrough"]  # else frames are repeated or dropped to a constant rate
    try:
        with imageio.get_reader(path, "ffmpeg", output_params=as_stored) as video:
            reader: Any = video
            for frame in reader.iter_data():
                yield np.asarray(frame, dtype=np.uint8)
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        reason = " ".join(str(error).split())[:200]
        raise BadInput(f"{path} cannot be read as a video ({reason}); copy it, or convert it to MP4") from error


def read_frames(path: Path, n_frames: int) -> list[Frame]:
    """Read evenly spaced frames of a video, including the first and the last.

    Args:
        path: see `iter_frames`.
        n_frames: how many; all of a shorter video.

    Returns:
        (H, W, 3) uint8 RGB each.

    Raises:
        BadInput: missing, no video, or fewer than 2 frames.
    """
    if n_frames < 2:
        raise BadInput(f"a clip needs at least 2 frames, its first and its last, got {n_frames}")
    if path.is_dir():
        pictures = frame_files(path)
        frames = [read_image(pictures[i]) for i in evenly_spaced(len(pictures), n_frames)]
    elif not path.is_file():
        raise BadInput(f"{path} is not a file; give a video or a folder of pictures")
    else:
        n = sum(1 for _ in iter_frames(path))  # what the file says of its length may not be what is decoded
        wanted = set(evenly_spaced(n, n_frames).tolist())
        frames = [frame for i, frame in enumerate(iter_frames(path)) if i in wanted]
    if len(frames) < 2:
        raise BadInput(f"{path} has {len(frames)} frames, at least 2 are needed; remove it")
    return frames


def frame_files(folder: Path) -> list[Path]:
    """Return the pictures in a folder in the order of the numbers in their names: frame2 before frame10.

    Raises:
        BadInput: there is none.
    """

    def numbers(path: Path) -> list[int | str]:
        return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]

    return sorted(list_images(folder), key=numbers)


def evenly_spaced(n: int, n_wanted: int) -> NDArray[np.intp]:
    """Return the indices of up to `n_wanted` of n frames, evenly spaced, including the first and the last."""
    return np.unique(np.linspace(0, n - 1, min(n, n_wanted)).round().astype(np.intp)) if n else np.zeros(0, np.intp)
