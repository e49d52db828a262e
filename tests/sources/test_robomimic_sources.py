"""robomimic's files, in the layout of their format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from rollouts import LENGTHS, Episode, Run, check_imported, rows, write_robomimic

from zest_rl.sources import open_source


def test_a_robomimic_file_becomes_a_minari_dataset(maze: list[Episode], goal: Path, zest: Run, tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "Lift ph.hdf5", maze)
    made = zest("relabel", path, "--goal", goal, "--n-workers", "1")
    assert made["dataset"].startswith("zest/Lift-ph-zest-")
    assert made["dataset"].endswith("-v0")
    check_imported(made["dataset"], maze, [episode.frames for episode in maze], goal)
    for episode, found in zip(maze, minari.load_dataset(made["dataset"]), strict=True):
        assert found.observations.keys() == {"object", "robot0_eef_pos"}
        wanted = rows(episode, "observation").astype(np.float32)
        np.testing.assert_array_equal(found.observations["robot0_eef_pos"], wanted)


def test_a_robomimic_file_without_next_obs_repeats_the_last_frame_and_observation(
    maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    made = zest("relabel", write_robomimic(tmp_path / "short.hdf5", maze, with_next=False), "--goal", goal)["dataset"]
    check_imported(made, maze, [[*episode.frames[:-1], episode.frames[-2]] for episode in maze], goal)
    for found in minari.load_dataset(made):
        np.testing.assert_array_equal(found.observations["object"][-1], found.observations["object"][-2])


def test_the_last_frame_repeats_where_next_obs_lacks_the_camera(maze: list[Episode], tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "lift.hdf5", maze)
    with h5py.File(path, "r+") as file:
        del file["data/demo_1/next_obs/agentview_image"]
    frames = open_source(str(path)).frames
    assert [len(list(frames.read(i))) for i in range(len(maze))] == list(LENGTHS)


@pytest.mark.parametrize("dataset", ["/data/missing.hdf5", "~/missing", "./missing", "demos/missing.hdf5"])
def test_a_path_where_nothing_is_is_named_as_such(
    dataset: str, goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    code, error = refusal("relabel", dataset, "--goal", goal)
    assert (code, f"there is no file or folder {dataset}" in error) == (2, True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda path: path.write_bytes(b"no HDF5"), "cannot be read as HDF5"),
        (lambda path: h5py.File(path, "w").close(), "must hold data/demo_0, … with actions and obs/"),
        (lambda path: h5py.File(path, "w").create_group("data/demo_x").file.close(), "named data/demo_0, data/demo_1"),
        (lambda path: path.mkdir(), "is a folder, but no LeRobot dataset"),
    ],
)
def test_other_files_are_refused(
    content: Callable[[Path], Any], message: str, goal: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    content(tmp_path / "some.hdf5")
    code, error = refusal("relabel", tmp_path / "some.hdf5", "--goal", goal)
    assert (code, message in error) == (2, True)
