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

from zest_rl.errors import BadInput, Notice
from zest_rl.sources import open_source
from zest_rl.sources.robomimic import open_robomimic


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


def replace(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.Group], None]:
    def spoil(demo: h5py.Group) -> None:
        values = change(demo[name][()])
        del demo[name]
        demo[name] = values

    return spoil


def add(name: str, values: Any) -> Callable[[h5py.Group], None]:
    return lambda demo: demo.__setitem__(name, values)


@pytest.mark.parametrize(
    ("spoil", "rule"),
    [
        (replace("actions", lambda a: np.where(a == a[1], np.nan, a)), "actions must be finite, but 1 of 6 rows"),
        (replace("obs/object", lambda a: a * np.nan), "object must be finite"),
        (replace("obs/object", lambda a: a[:-1]), "obs/object must have T = 6 rows, got shape (5, 2)"),
        (replace("obs/agentview_image", lambda a: a[:-1]), "obs/agentview_image must have T = 6 rows, got shape (5, "),
        (replace("next_obs/object", lambda a: a[:-1]), "next_obs/object must have T = 6 rows"),
        (
            replace("next_obs/object", lambda a: a[:, :1]),
            "next_obs/object must have the shape of /data/demo_1/obs/object",
        ),
        (
            replace("obs/object", lambda a: np.array([[b"a"] * 2] * 6)),
            "obs/object has none per step here, but 2 in data/demo_0",
        ),
        (replace("actions", lambda a: np.array([b"a"] * 6)), "actions must hold numbers, got values of type |S1"),
        (replace("actions", lambda a: a[:, :1]), "actions has 1 per step here, but 2 in data/demo_0"),
        (replace("rewards", lambda a: a[:-1]), "rewards must have T = 6 rows"),
        (replace("rewards", lambda a: np.stack([a, a], axis=1)), "rewards (6, 2)"),
        (replace("dones", lambda a: a[:-1]), "dones must have T = 6 rows"),
        (add("obs/extra", np.zeros((6, 14))), "obs/extra has 14 per step here, but none in data/demo_0"),
        (lambda demo: demo.__delitem__("obs/object"), "obs/object has none per step here, but 2 in data/demo_0"),
    ],
)
def test_a_demo_that_breaks_a_rule_is_named_before_anything_is_embedded(
    spoil: Callable[[h5py.Group], None], rule: str, maze: list[Episode], goal: Path,
    refusal: Callable[..., tuple[int, str]], tmp_path: Path,
) -> None:  # fmt: skip
    path = write_robomimic(tmp_path / "lift.hdf5", maze)
    with h5py.File(path, "r+") as file:
        spoil(file["data/demo_1"])
    code, error = refusal("relabel", path, "--goal", goal, "--n-workers", "1")
    assert (code, rule in error, "error: data/demo_1 of lift.hdf5: " in error) == (2, True, True), error
    assert "del h5py.File('lift.hdf5', 'r+')['data/demo_1']" in error
    assert not list((tmp_path / "minari").rglob("metadata.json"))
    assert not [path for path in (tmp_path / "cache" / "frames").rglob("*") if path.is_file()]


def test_takes_without_steps_are_left_out_and_told(maze: list[Episode], tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "lift.hdf5", maze)
    with h5py.File(path, "r+") as file:
        file.create_group("data/demo_7").attrs["num_samples"] = 0
        file["data/demo_8/actions"], file["data/demo_8/obs/object"] = np.zeros((0, 2)), np.zeros((0, 2))
        file.move("data/demo_0", "data/demo_9")
    with pytest.warns(Notice, match="left out, as they have no steps: data/demo_7, data/demo_8"):
        source = open_source(str(path))
    assert list(source.trajectories.n_steps) == [*LENGTHS[1:], LENGTHS[0]]


def test_rewards_may_stand_in_a_column(maze: list[Episode], tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "lift.hdf5", maze)
    plain = open_source(str(path)).trajectories.rewards_to_keep()
    with h5py.File(path, "r+") as file:
        for demo in file["data"].values():
            replace("rewards", lambda rewards: rewards[:, None])(demo)
    for rewards, expected in zip(open_source(str(path)).trajectories.rewards_to_keep(), plain, strict=True):
        np.testing.assert_array_equal(rewards, expected)


def test_demos_of_other_names_are_refused_without_a_command_that_would_scramble_them(tmp_path: Path) -> None:
    path = tmp_path / "lift.hdf5"
    with h5py.File(path, "w") as file:
        for i in range(12):  # of which traj_10 stands before traj_2
            file[f"data/traj_{i}/actions"], file[f"data/traj_{i}/obs/object"] = np.ones((i + 1, 2)), np.ones((i + 1, 2))
    with pytest.raises(BadInput, match=r"named data/demo_0, .*, got data/traj_0 in .* rename them in their order \(h5"):
        open_robomimic(path, ())
    with h5py.File(path, "r+") as file:
        for i in range(12):
            file["data"].move(f"traj_{i}", f"demo_{i}")
    assert list(open_robomimic(path, ())[0].n_steps) == [i + 1 for i in range(12)]


def test_a_dark_demo_has_the_pictures_of_the_first(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "lift.hdf5", "w") as file:
        for i, value in enumerate((200, 30)):
            for name, shape in (("actions", (3, 2)), ("obs/object", (3, 2)), ("obs/camera", (3, 16, 16, 3))):
                file[f"data/demo_{i}/{name}"] = np.full(shape, value if name == "obs/camera" else 0, np.float32)
    source = open_source(str(tmp_path / "lift.hdf5"))
    assert source.trajectories.fingerprint()
    assert [frames[0].max() for frames in (next(source.frames.read(i)) for i in range(2))] == [200, 30]


def test_a_name_with_two_dots_becomes_an_id(maze: list[Episode], tmp_path: Path) -> None:
    assert (
        open_source(str(write_robomimic(tmp_path / "two..dots.hdf5", maze))).trajectories.dataset_id
        == "zest/two-dots-v0"
    )


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
