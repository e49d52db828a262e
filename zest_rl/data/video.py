"""Videos, as files or as folders of pictures → RGB frames."""

from __future__ import annotations

import os
import re
import select
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.images import list_images, read_image
from zest_rl.data.picture_size import MAX_PIXELS, check_size
from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime.files import check_file
from zest_rl.types import Frame

VIDEO_SUFFIXES = (".avi", ".mkv", ".mov", ".mp4", ".webm")
_CONTAINERS = "mov,matroska,webm,avi,mpegts,mpeg,ogg,flv,asf"
"""Never playlists, which make ffmpeg read other files."""
PATIENCE = 600
"""Seconds without anything from ffmpeg after which it counts as hanging."""
_HEADER = re.compile(rb"P6\n(\d+) (\d+)\n255\n")


def iter_frames(path: Path, start: float = 0.0, n_frames: int | None = None) -> Iterator[Frame]:
    """Yield the stored frames of a video: (H, W, 3) uint8 RGB, upright where the file says how it was held.

    Args:
        path: a video file that ffmpeg reads, or a folder of pictures, in the order of `frame_files`.
        start: seconds; the first frame of a file is the one that is not before this.
        n_frames: at most so many of a file; None: all.

    Raises:
        BadInput: no video, damaged, or too large (`check_size`).
        ZestError: there is no ffmpeg, or it hangs.
    """
    if path.is_dir():
        yield from map(read_image, frame_files(path))
        return
    limit = [] if n_frames is None else ["-frames:v", str(n_frames)]
    words = ["-fps_mode", "passthrough", *limit, "-pix_fmt", "rgb24", "-c:v", "ppm", "-f", "image2pipe"]
    # passthrough: else frames are repeated or dropped to a constant rate; PPM: each frame tells its size
    n = 0
    with _ffmpeg(path, ["-ss", f"{start:.6f}"] if start else [], words) as pipe:
        while header := _read(pipe, 11, path):
            while (size := _HEADER.fullmatch(header)) is None and len(header) < 32:
                header += _read(pipe, 1, path)
            if size is None:
                break
            width, height = int(size[1]), int(size[2])
            check_size(width, height, str(path))
            pixels = _read(pipe, 3 * width * height, path)
            if len(pixels) < 3 * width * height:
                break
            yield np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
            n += 1
    if n == 0:
        raise BadInput(f"{path} cannot be read as a video (it holds no frame after {start:.6g} s); copy it again")


def frame_times(path: Path) -> NDArray[np.float64]:
    """Return when each frame of a video file is shown: (n,) seconds, as ffmpeg gives them; nothing is decoded.

    Raises:
        BadInput: no video, or damaged.
        ZestError: there is no ffmpeg, or it hangs.
    """
    listing = bytearray()
    with _ffmpeg(path, [], ["-an", "-sn", "-dn", "-c", "copy", "-f", "framecrc"]) as pipe:
        while part := _read(pipe, 65536, path):
            listing += part
    unit = re.search(rb"^#tb 0: (\d+)/(\d+)$", listing, re.MULTILINE)
    shown = re.findall(rb"^0,[^,]*,\s*(-?\d+),", listing, re.MULTILINE)
    if unit is None or not shown:
        raise BadInput(f"{path} cannot be read as a video (it holds no frame); copy it again")
    return np.sort(np.array(shown, np.float64)) * int(unit[1]) / int(unit[2])


@contextmanager
def _ffmpeg(path: Path, before: list[str], after: list[str]) -> Iterator[IO[bytes]]:
    """Run ffmpeg on a file with options `before` and `after` its name, and yield what it writes.

    Raises:
        BadInput: ffmpeg failed; the message has the first line that it said.
        ZestError: there is no ffmpeg.
    """
    import imageio_ffmpeg

    check_file(path)
    reading = ["-protocol_whitelist", "file", "-format_whitelist", _CONTAINERS, "-max_pixels", str(MAX_PIXELS)]
    with tempfile.TemporaryFile() as log:
        try:
            words = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-v", "error", *reading, *before]
            process = subprocess.Popen(
                [*words, "-i", f"file:{path}", *after, "pipe:1"],
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, bufsize=0,
            )  # fmt: skip
        except (OSError, RuntimeError) as error:
            raise ZestError(f"ffmpeg cannot be started ({error}); pip install imageio-ffmpeg") from error
        assert process.stdout is not None
        try:
            with process.stdout as pipe:
                yield pipe
                code = process.wait()
        finally:
            process.kill()
            process.wait()
        if code:
            log.seek(0)
            said = re.sub(r"\[[^]]* @ 0x[0-9a-f]+\] ", "", log.readline(1000).decode(errors="replace")).strip()
            reason = said.replace(f"file:{path}", path.name) or f"ffmpeg ended with {code}"
            raise BadInput(f"{path} cannot be read as a video ({reason[:200]}); copy it, or convert it to MP4")


def _read(pipe: IO[bytes], n: int, path: Path) -> bytes:
    """Read n bytes, fewer at the end."""
    parts = bytearray()
    while len(parts) < n:
        if not select.select([pipe], [], [], PATIENCE)[0]:
            raise ZestError(f"ffmpeg did not go on with {path} for {PATIENCE} s; copy it, or convert it to MP4")
        part = os.read(pipe.fileno(), n - len(parts))
        if not part:
            break
        parts += part
    return bytes(parts)


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
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]

    return sorted(list_images(folder), key=numbers)


def evenly_spaced(n: int, n_wanted: int) -> NDArray[np.intp]:
    """Return the indices of up to `n_wanted` of n frames, evenly spaced, including the first and the last."""
    return np.unique(np.linspace(0, n - 1, min(n, n_wanted)).round().astype(np.intp)) if n else np.zeros(0, np.intp)
