"""`zest relabel` on LeRobot's folders."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import imageio.v2 as imageio
import minari
import numpy as np
import pytest
from lerobot_files import write_lerobot
from PIL import Image
from read_dataset import read
from rollouts import LENGTHS, Episode, Run, check_imported, rows, write_blind

from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.sources import open_source


def test_a_lerobot_folder_becomes_a_minari_dataset(
    maze: list[Episode], goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    root = write_lerobot(tmp_path / "pusht", maze)
    videos = sorted((root / "videos").rglob("*.mp4"))
    decoded = [list(imageio.mimread(video)) for video in videos]
    assert [len(frames) for frames in decoded] == [LENGTHS[0] + LENGTHS[1], LENGTHS[2]]
    of_episodes = [decoded[0][: LENGTHS[0]], decoded[0][LENGTHS[0] :], decoded[1]]
    source = open_source(str(root))
    for i, frames in enumerate(of_episodes):
        np.testing.assert_array_equal([views[0] for views in source.frames.read(i)], frames)
    made = zest("relabel", root, "--goal", goal, "--n-workers", "1")
    assert made["dataset"].startswith("zest/pusht-zest-")
    assert made["views"] == ["observation.images.top"]
    check_imported(made["dataset"], maze, [[*frames, frames[-1]] for frames in of_episodes], goal)
    for episode, found in zip(maze, minari.load_dataset(made["dataset"]), strict=True):
        state = rows(episode, "observation").astype(np.float32)
        np.testing.assert_array_equal(found.observations["observation.state"][:-1], state[:-1])
    for words, fps in (((), 10), (("--fps", "20"), 20)):
        back = zest("export", made["dataset"], "--to", "lerobot", "--output", tmp_path / f"back{fps}", *words)
        assert json.loads((Path(back["file"]) / "meta" / "info.json").read_text())["fps"] == fps
    videos[1].unlink()
    code, error = refusal("relabel", root, "--goal", goal)
    assert (code, "episode 2 lacks videos/observation.images.top/chunk-000/file-001.mp4" in error) == (2, True)


def test_a_part_of_a_lerobot_dataset_keeps_its_order_whatever_its_numbers(
    maze: list[Episode], goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    folders = write_lerobot(tmp_path / "whole", maze), write_lerobot(tmp_path / "part", maze, number=3, step=2)
    whole, part = (open_source(str(folder)) for folder in folders)
    assert part.trajectories.fingerprint() == whole.trajectories.fingerprint()
    for i in range(len(maze)):
        np.testing.assert_array_equal(list(part.frames.read(i)), list(whole.frames.read(i)))
    made = zest("relabel", tmp_path / "part", "--goal", goal, "--n-workers", "1")["dataset"]
    assert [len(rewards) for rewards in read(made, Dataset.rewards)] == list(LENGTHS)
    listed = tmp_path / "part" / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    shutil.copyfile(listed, listed.with_name("file-001.parquet"))
    code, error = refusal("relabel", tmp_path / "part", "--goal", goal)
    assert (code, "must list every episode once, got 6 rows" in error) == (2, True)


def test_an_older_lerobot_dataset_is_refused_with_what_converts_it(
    maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    code, error = refusal("relabel", write_lerobot(tmp_path / "old", maze, version="v2.1"), "--goal", goal)
    assert (code, "of version v2.1, v3.0 is read; convert it with" in error) == (2, True)


@pytest.mark.parametrize("lost", ["features", "fps"])
def test_a_lerobot_folder_whose_info_lacks_a_part_is_refused(
    lost: str, maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    path = write_lerobot(tmp_path / "pusht", maze) / "meta" / "info.json"
    path.write_text(json.dumps({name: value for name, value in json.loads(path.read_text()).items() if name != lost}))
    code, error = refusal("relabel", tmp_path / "pusht", "--goal", goal)
    assert (code, f"is not that of a LeRobot v3.0 dataset ({lost!r} in info.json)" in error) == (2, True)


def test_without_next_truncated_an_episode_of_lerobot_counts_as_cut(maze: list[Episode], tmp_path: Path) -> None:
    root = write_lerobot(tmp_path / "pusht", maze)
    trajectories: Any = open_source(str(root)).trajectories
    assert [episode.terminated for episode in trajectories.episodes()] == [True] * 3
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    del info["features"]["next.truncated"]
    path.write_text(json.dumps(info))
    trajectories = open_source(str(root)).trajectories
    assert [episode.terminated for episode in trajectories.episodes()] == [False] * 3


@pytest.mark.parametrize("form", ["robomimic", "lerobot"])
def test_ends_are_those_of_the_dataset_that_was_exported(
    form: str, maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    dataset = write_blind(maze)
    with h5py.File(reader.dataset_path(dataset) / reader.DATA_FILE, "r+") as file:
        file["episode_1/terminations"][-1], file["episode_1/truncations"][-1] = True, False
    for i, episode in enumerate(maze):
        for t, frame in enumerate(episode.frames):
            path = tmp_path / "films" / f"episode_{i}" / f"{t}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(frame).save(path)
    exported = zest("export", dataset, "--to", form, "--output", tmp_path / "exported.hdf5")["file"]
    made = zest("relabel", exported, "--goal", goal, "--frames", tmp_path / "films", "--n-workers", "1")["dataset"]
    assert [episode.terminated for episode in read(made, Dataset.episodes)] == [False, True, False]
