"""Videos for people: right length, playable everywhere, and showing what happened."""

from __future__ import annotations

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from read_dataset import read

from zest_rl.data.reader import Dataset
from zest_rl.kitchen.scene import RenderConfig, open_renderer
from zest_rl.kitchen.videos import FPS, OVERVIEW, KitchenOverview
from zest_rl.simulation.videos import Video, ensure_videos, write_video

N_FRAMES = 8


@pytest.fixture
def states(collected: str) -> np.ndarray:
    """Every twelfth state of an episode in which the microwave opens."""
    return read(collected, Dataset.states)[0][::12][:N_FRAMES]


def test_a_video_is_h264_with_one_frame_per_state_and_shows_the_states(states: np.ndarray, tmp_path: Path) -> None:
    path = write_video(Video({"qpos": states}, tmp_path / "videos" / "best.mp4", KitchenOverview(160)))
    with imageio.get_reader(path) as reader:
        meta, frames = reader.get_meta_data(), np.stack([np.asarray(frame) for frame in reader.iter_data()])
    assert meta["codec"] == "h264"
    assert meta["fps"] == FPS == 12.5
    assert frames.shape == (N_FRAMES, 160, 160, 3)
    with open_renderer(RenderConfig(size=160, robot=True), (OVERVIEW,)) as renderer:
        rendered = np.stack([renderer.render(state)[0] for state in states])
    error = [[np.abs(shown - true.astype(float)).mean() for true in rendered] for shown in frames.astype(float)]
    np.testing.assert_array_equal(np.argmin(error, axis=1), np.arange(N_FRAMES))  # each frame is of its own state
    assert np.diag(error).max() < 6
    assert [file.name for file in path.parent.iterdir()] == ["best.mp4"], "nothing else is left behind"


def test_two_episodes_are_shown_side_by_side(states: np.ndarray, tmp_path: Path) -> None:
    first, second = ({"qpos": some} for some in (states[:3], states[::-1][:3]))
    path = write_video(Video(first, tmp_path / "pair.mp4", KitchenOverview(96), beside=second))
    frames = np.stack([np.asarray(frame) for frame in imageio.mimread(path)]).astype(float)
    assert frames.shape == (3, 96, 192, 3)
    with open_renderer(RenderConfig(size=96, robot=True), (OVERVIEW,)) as renderer:
        for side, episode in ((frames[:, :, :96], states), (frames[:, :, 96:], states[::-1])):
            for shown, state in zip(side, episode[:3], strict=True):
                assert np.abs(shown - renderer.render(state)[0].astype(float)).mean() < 8


def test_a_video_can_be_written_over_an_old_one(states: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"not a video")
    write_video(Video({"qpos": states[:2]}, path, KitchenOverview(64)))
    assert imageio.mimread(path)[0].shape == (64, 64, 3)


def test_videos_are_written_side_by_side_and_those_that_are_there_are_left(states: np.ndarray, tmp_path: Path) -> None:
    videos = [Video({"qpos": states[i : i + 2]}, tmp_path / f"{i}.mp4", KitchenOverview(64)) for i in (0, 1, 2, 1)]
    videos[0].path.write_bytes(b"made before")
    done: list[None] = []
    ensure_videos(videos, n_workers=2, on_done=lambda: done.append(None))
    assert len(done) == 2, "one is there, two have the same path"
    assert videos[0].path.read_bytes() == b"made before"
    assert [len(imageio.mimread(video.path)) for video in videos[1:]] == [2, 2, 2]
    assert {path.name for path in tmp_path.glob("*.mp4*")} == {"0.mp4", "1.mp4", "2.mp4"}
