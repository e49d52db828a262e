"""`zest curate --source` on recordings of robomimic and LeRobot, which stay as they are."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from lerobot_files import write_lerobot
from rollouts import Episode, Run, write_robomimic


def test_a_robomimic_file_gets_masks_beside_it(
    maze: list[Episode], goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    path = write_robomimic(tmp_path / "lift.hdf5", maze)
    scored = zest("relabel", path, "--goal", goal, "--n-workers", "1")["dataset"]
    before = path.read_bytes()
    made = zest("curate", scored, "--keep", "0.67", "--source", path, "--output", tmp_path / "table.csv")
    assert path.read_bytes() == before
    (dropped,) = made["dropped"]
    with h5py.File(path) as recording:
        actions = {name: demo["actions"][()] for name, demo in recording["data"].items()}
        attributes = set(recording["data"].attrs)
    with h5py.File(made["masks"], swmr=True, libver="latest") as file:  # as robomimic opens it
        masks = {mask: [name.decode() for name in members] for mask, members in file["mask"].items()}
        assert masks == {"kept": [f"demo_{i}" for i in range(3) if i != dropped], "dropped": [f"demo_{dropped}"]}
        assert set(file["data"].attrs) == attributes
        for name, values in actions.items():
            np.testing.assert_array_equal(file[f"data/{name}/actions"][()], values)
    assert made["episodes"][0]["name"] == f"demo_{dropped}"
    with h5py.File(path, "r+") as file:
        file["data/demo_0/actions"][0] *= 2
    code, error = refusal("curate", scored, "--keep", "0.67", "--source", path)
    assert (code, "holds other episodes than those that" in error) == (2, True)


def test_a_lerobot_folder_gets_the_command_that_deletes_its_episodes(
    maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    root = write_lerobot(tmp_path / "my cups", maze)
    scored = zest("relabel", root, "--goal", goal, "--n-workers", "1")["dataset"]
    made = zest("curate", scored, "--keep", "0.34", "--source", root, "--output", tmp_path / "table.csv")
    words = shlex.split(made["command"])
    flags = dict(zip(words[1::2], words[2::2], strict=True))
    assert words[0] == "lerobot-edit-dataset"
    assert json.loads(flags.pop("--operation.episode_indices")) == sorted(made["dropped"])
    assert flags == {
        "--repo_id": "local/my cups",
        "--root": str(root),
        "--new_repo_id": "local/my cups-curated",
        "--new_root": f"{root}-curated",
        "--operation.type": "delete_episodes",
    }
    assert made["masks"] is None
