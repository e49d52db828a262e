"""Videos and folders of pictures of a moving bar, read as frames."""

from __future__ import annotations

import subprocess
from pathlib import Path

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from zest_rl.data import video
from zest_rl.data.video import frame_files, frame_times, iter_frames, read_frames
from zest_rl.errors import BadInput, ZestError

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
    Image.new("RGB", (8, 8)).save(tmp_path / "²1.png")
    assert frame_files(tmp_path)[-1].stem == "²1"


BOTH = (lambda path: read_frames(path, 4), lambda path: list(iter_frames(path)), frame_times)
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"a" * 64 + b"\nsize 123456\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no video", r"cannot be read as a video \([^()]{5,80}\); copy it"),
        (b"", "is empty"),
        (POINTER, "is a Git LFS pointer"),
    ],
)
def test_what_is_no_video_is_refused_by_name_in_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "odd.webm").write_bytes(content)
    for read in BOTH:
        with pytest.raises(BadInput, match=rf"odd\.webm {message}") as refused:
            read(tmp_path / "odd.webm")
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "playlist",
    ["ffconcat version 1.0\nfile {}\n", "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{}\n#EXT-X-ENDLIST\n"],
)
def test_a_playlist_under_the_name_of_a_video_does_not_lead_to_other_files(
    bar: list[np.ndarray], tmp_path: Path, playlist: str
) -> None:
    imageio.mimwrite(tmp_path / "secret.mp4", bar, fps=12)
    for name in ("list.mp4", "list.mkv"):
        (tmp_path / name).write_text(playlist.format(tmp_path / "secret.mp4"))
        for read in BOTH:
            with pytest.raises(BadInput, match=rf"{name} cannot be read as a video"):
                read(tmp_path / name)


@pytest.mark.parametrize(
    ("size", "message"), [("8000x4000", "exceeds specified max pixel count 16000000"), ("8000x40", "is too long")]
)
def test_a_video_of_absurd_size_is_refused(tmp_path: Path, size: str, message: str) -> None:
    words = ["-v", "error", "-f", "lavfi", "-i", f"color=size={size}:rate=1:duration=1", "-c:v", "mjpeg"]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words, tmp_path / "wide.mkv"], check=True)
    with pytest.raises(BadInput, match=message):
        list(iter_frames(tmp_path / "wide.mkv"))


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_video_is_shown_as_it_was_held(bar: list[np.ndarray], tmp_path: Path, quarters: int) -> None:
    imageio.mimwrite(tmp_path / "plain.mp4", [frame[:40] for frame in bar], fps=12, macro_block_size=2)
    words = ["-v", "error", "-display_rotation", str(90 * quarters), "-i", tmp_path / "plain.mp4", "-c", "copy"]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words, tmp_path / "held.mp4"], check=True)
    turned = [np.rot90(frame, quarters) for frame in iter_frames(tmp_path / "plain.mp4")]
    for frame, expected in zip(iter_frames(tmp_path / "held.mp4"), turned, strict=True):
        assert frame.shape == expected.shape
        assert np.abs(frame.astype(int) - expected).mean() < 2


def test_a_part_of_a_video_is_read_by_the_times_of_its_frames(bar: list[np.ndarray], tmp_path: Path) -> None:
    path = tmp_path / "file:bar 1.mp4"
    imageio.mimwrite(path, bar, fps=10, output_params=["-bf", "3", "-g", "12"])
    np.testing.assert_allclose(frame_times(path), np.arange(N) / 10, atol=1e-3)
    frames = list(iter_frames(path))
    np.testing.assert_array_equal(list(iter_frames(path, 0.45, 3)), frames[5:8])
    with pytest.raises(BadInput, match="it holds no frame after 9 s"):
        list(iter_frames(path, 9.0))


def test_an_ffmpeg_that_hangs_or_is_missing_is_told(
    bar: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    imageio.mimwrite(tmp_path / "bar.mp4", bar, fps=12)
    (tmp_path / "ffmpeg").write_text("#!/bin/sh\nexec sleep 60\n")
    (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.setattr(video, "PATIENCE", 0.2)
    for name, message in (
        ("ffmpeg", r"did not go on with .*bar\.mp4 for 0\.2 s"),
        ("none", "ffmpeg cannot be started"),
    ):
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / name))
        with pytest.raises(ZestError, match=message):
            frame_times(tmp_path / "bar.mp4")


def test_too_few_frames_are_refused(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "only.png")
    with pytest.raises(BadInput, match="does not exist"):
        read_frames(tmp_path / "nowhere.mp4", 4)
    with pytest.raises(BadInput, match="at least 2 frames"):
        read_frames(tmp_path, 1)
    with pytest.raises(BadInput, match="has 1 frames, at least 2 are needed"):
        read_frames(tmp_path, 4)
