"""Videos and folders of pictures of a moving bar, read as frames."""

from __future__ import annotations

import subprocess
from pathlib import Path

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from zest_rl.data.video import frame_files, iter_frames, read_frames
from zest_rl.errors import BadInput

N = 12


@pytest.fixture(scope="module")
def bar() -> list[np.ndarray]:
    """N frames (64, 64, 3) in which a bright bar moves to the right."""
    frames = np.full((N, 64, 64, 3), 40, np.uint8)
    for i, frame in enumerate(frames):
        frame[:, 5 * i : 5 * i + 8] = (220, 180, 60)
    return list(frames)


def test_a_video_is_read_from_its_first_frame_to_its_last(bar: list[np.ndarray], tmp_path: Path) -> None:
    path = tmp_path / "bar.mp4"
    imageio.mimwrite(path, bar, fps=12, quality=9)
    frames = read_frames(path, N)
    error = [np.abs(a.astype(float) - b).mean() for a, b in zip(frames, bar, strict=True)]
    assert max(error) < 8, "video is lossy"
    few = read_frames(path, 3)
    for frame, index in zip(few, (0, round((N - 1) / 2), N - 1), strict=True):
        np.testing.assert_array_equal(frame, frames[index])
    assert len(read_frames(path, 99)) == N
    np.testing.assert_array_equal(list(iter_frames(path)), frames)


def test_a_folder_of_pictures_is_a_video_too(bar: list[np.ndarray], tmp_path: Path) -> None:
    for i, frame in enumerate(bar):
        Image.fromarray(frame).save(tmp_path / f"{i:03d}.png")
    np.testing.assert_array_equal(read_frames(tmp_path, N), bar)
    np.testing.assert_array_equal(list(iter_frames(tmp_path)), bar)


def test_a_video_of_changing_frame_rate_is_read_to_its_end(bar: list[np.ndarray], tmp_path: Path) -> None:
    slow, fast = tmp_path / "slow.mp4", tmp_path / "fast.mp4"
    imageio.mimwrite(slow, bar[: N // 2], fps=2, quality=9)
    imageio.mimwrite(fast, bar[N // 2 :], fps=30, quality=9)
    (tmp_path / "parts.txt").write_text("file slow.mp4\nfile fast.mp4\n")
    both = tmp_path / "both.mp4"
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    words = [ffmpeg, "-loglevel", "error", "-f", "concat", "-i", tmp_path / "parts.txt", "-c", "copy", both]
    subprocess.run(words, check=True)
    last = read_frames(both, 5)[-1].astype(float)
    errors = [np.abs(last - frame).mean() for frame in bar]
    assert int(np.argmin(errors)) == N - 1


def test_pictures_are_taken_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for i in range(12):
        Image.new("RGB", (8, 8), (20 * i, 0, 0)).save(tmp_path / f"frame{i}.png")
    assert [path.stem for path in frame_files(tmp_path)] == [f"frame{i}" for i in range(12)]
    assert [int(frame[0, 0, 0]) for frame in read_frames(tmp_path, 12)] == [20 * i for i in range(12)]


@pytest.mark.parametrize("content", [b"no video", b""])
def test_what_is_no_video_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "odd.webm").write_bytes(content)
    for read in (lambda path: read_frames(path, 4), lambda path: list(iter_frames(path))):
        with pytest.raises(BadInput, match=r"odd\.webm cannot be read as a video"):
            read(tmp_path / "odd.webm")


def test_too_few_frames_are_refused(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "only.png")
    with pytest.raises(BadInput, match="is not a file"):
        read_frames(tmp_path / "nowhere.mp4", 4)
    with pytest.raises(BadInput, match="at least 2 frames"):
        read_frames(tmp_path, 1)
    with pytest.raises(BadInput, match="has 1 frames, at least 2 are needed"):
        read_frames(tmp_path, 4)
