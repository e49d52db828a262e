"""Exports of observations and actions of any space: what is taken, flattened, left out and told."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from gymnasium import spaces
from minari_files import Recorded, write_minari
from PIL import Image
from pyarrow import parquet
from read_dataset import read

from zest_rl.data.observations import is_numbers
from zest_rl.data.reader import Dataset, open_dataset
from zest_rl.errors import BadInput, Notice
from zest_rl.export import export, transitions
from zest_rl.export.lerobot import DATA_FILE

SIDE = 16
ROOM = {
    "camera": spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8),
    "grid": spaces.Box(-50, 50, (10, 10), np.float32),
    "joints": spaces.Box(-1, 1, (3,), np.float32),
}


def write_samples(
    dataset_id: str,
    root: Path,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    lengths: tuple[int, ...] = (4, 6),
    infos: Callable[[int], dict[str, Any]] = lambda n_steps: {},
) -> str:
    """Leave a dataset of samples of its spaces."""
    observation_space.seed(0)
    action_space.seed(0)
    root.mkdir(exist_ok=True)
    episodes = []
    for length in lengths:
        observed = [observation_space.sample() for _ in range(length + 1)]
        parts = (
            {name: np.stack([one[name] for one in observed]) for name in observed[0]}
            if isinstance(observed[0], dict)
            else np.stack(observed)
        )
        actions = np.stack([action_space.sample() for _ in range(length)])
        episodes.append(Recorded(parts, actions, np.arange(length) / 8.0, infos(length)))
    return write_minari(dataset_id, episodes, observation_space, action_space)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A Minari root and a cache of this test's own."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    return tmp_path / "minari"


@pytest.fixture
def goal(tmp_path: Path) -> Path:
    """A start and a goal as pictures of noise."""
    for i, part in enumerate(("init", "goal")):
        (tmp_path / "goal" / part).mkdir(parents=True)
        noise = np.random.default_rng(i).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "goal" / part / "0.png")
    return tmp_path / "goal"


def test_numbers_in_the_form_of_pictures_are_exported_and_what_is_left_out_is_told(
    root: Path, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    name = write_samples("room/some-v0", root, spaces.Dict(ROOM), spaces.Box(-1, 1, (2,), np.float32))
    told = zest("export", name, "--output", tmp_path / "data.npz")
    assert told["left_out"] == ["observations/camera"]
    with h5py.File(root / name / "data/main_data.hdf5") as file, np.load(tmp_path / "data.npz") as found:
        stored = [file[f"episode_{i}/observations"] for i in range(2)]
        own = [np.concatenate([one["grid"][:-1].reshape(-1, 100), one["joints"][:-1]], axis=1) for one in stored]
        np.testing.assert_array_equal(found["observations"], np.concatenate(own))
        assert json.loads(str(found["about"]))["left_out"] == ["observations/camera"]


def test_progress_of_pictures_alone_is_exported_and_told_of_by_inspect(
    root: Path, goal: Path, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    name = write_samples("room/seen-v0", root, ROOM["camera"], spaces.Box(-1, 1, (2,), np.float32), (2, 3, 2))
    scored = zest("relabel", name, "--goal", goal, "--n-workers", "1")
    told = zest("export", scored["dataset"], "--to", "lerobot-progress", "--output", tmp_path / "progress.parquet")
    assert (told["n_episodes"], told["n_transitions"], sorted(told["arrays"])) == (
        3, 7, ["episode_index", "frame_index", "index", "progress_sparse", "zest_score"],
    )  # fmt: skip
    rows = parquet.read_table(told["file"]).to_pydict()
    scores = [score[:-1] for score in read(scored["dataset"], Dataset.scores)]
    np.testing.assert_array_equal(rows["zest_score"], np.concatenate(scores))
    assert scored["next"] == f"zest inspect {scored['dataset']}"
    assert scored["dataset"] in zest(*scored["next"].split()[1:], "--output", tmp_path / "page.html")["datasets"]
    with pytest.raises(BadInput, match="holds pictures only; a policy here needs numbers"):
        export(scored["dataset"], "npz", tmp_path / "x")


def test_discrete_actions_stay_whole_numbers_for_those_that_take_them(
    root: Path, goal: Path, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    name = write_samples("room/buttons-v0", root, spaces.Dict(ROOM), spaces.Discrete(4))
    told = zest("relabel", name, "--goal", goal, "--n-workers", "1")
    scored = told["dataset"]
    with open_dataset(scored) as ds:
        assert not ds.suits_agents
    with h5py.File(root / name / "data/main_data.hdf5") as file:
        own = [file[f"episode_{i}/actions"][()] for i in range(2)]
    for to in ("npz", "d4rl"):
        path = export(scored, to, tmp_path / to).path  # type: ignore[arg-type]
        with np.load(path) if to == "npz" else h5py.File(path) as found:
            np.testing.assert_array_equal(found["actions"][()], np.concatenate(own))
            assert found["actions"].dtype == np.int64
    with h5py.File(export(scored, "d3rlpy", tmp_path / "d3rlpy").path) as found:
        for i, actions in enumerate(own):
            np.testing.assert_array_equal(found[f"actions_{i}"], actions[:, None])
    folder = export(scored, "torchrl", tmp_path / "torchrl").path
    assert json.loads((folder / "meta.json").read_text())["action"]["shape"] == [10]
    np.testing.assert_array_equal(np.fromfile(folder / "action.memmap", np.int64), np.concatenate(own))
    for to in ("robomimic", "lerobot"):
        with pytest.raises(BadInput, match="takes continuous actions, got whole numbers; export to npz"):
            export(scored, to, tmp_path / to)  # type: ignore[arg-type]
        assert not (tmp_path / to).exists()
    assert export(scored, "lerobot-progress", tmp_path / "progress").n_transitions == 10
    with pytest.raises(BadInput, match="its actions are discrete, a policy here acts by continuous ones"):
        read(scored, Dataset.episodes)


def test_several_whole_numbers_per_action_are_not_taken_for_one(root: Path, tmp_path: Path) -> None:
    name = write_samples("room/switches-v0", root, spaces.Dict(ROOM), spaces.MultiDiscrete([2, 3]))
    with np.load(export(name, "npz", tmp_path / "data.npz").path) as found:
        assert (found["actions"].shape, found["actions"].dtype) == ((10, 2), np.int64)
    with pytest.raises(BadInput, match="d3rlpy takes one whole number per action, got 2"):
        export(name, "d3rlpy", tmp_path / "x")
    assert not (tmp_path / "x").exists()
    for i, space in enumerate((spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2))):
        with pytest.raises(BadInput, match="its actions are discrete"):
            read(write_samples(f"room/bits{i}-v0", root, spaces.Dict(ROOM), space), Dataset.episodes)


@pytest.mark.parametrize(
    ("actions", "suits"), [(spaces.Box(-2, 2, (2,), np.float32), False), (spaces.Box(-1, 1, (2,), np.float32), True)]
)
def test_agents_learn_where_actions_are_from_minus_one_to_one(
    root: Path, actions: spaces.Space[Any], suits: bool
) -> None:
    with open_dataset(write_samples("room/wide-v0", root, spaces.Dict(ROOM), actions)) as ds:
        assert ds.suits_agents == suits


def test_infos_are_not_measured_by_the_space_of_the_observations(root: Path) -> None:
    def infos(n_steps: int) -> dict[str, Any]:
        return {"heat": np.full((n_steps + 1, 10, 10), 50.0)}

    shares, actions = spaces.Box(0, 1, (16, 16), np.float32), spaces.Box(-1, 1, (2,), np.float32)
    name = write_samples("room/heat-v0", root, shares, actions, infos=infos)
    with h5py.File(root / name / "data/main_data.hdf5") as file:
        assert is_numbers(file["episode_0/infos/heat"])
        assert not is_numbers(file["episode_0/observations"])


def test_pixels_are_never_exported_as_numbers_without_a_word(root: Path, tmp_path: Path) -> None:
    sides = {"depth": np.uint16, "labels": np.int32, "far": np.float32}
    space = spaces.Dict(
        {"joints": ROOM["joints"]} | {n: spaces.Box(0, 99, (9, 9), dtype) for n, dtype in sides.items()}
    )
    name = write_samples("room/deep-v0", root, space, spaces.Box(-1, 1, (2,), np.float32))
    with pytest.warns(Notice) as told:
        exported = export(name, "npz", tmp_path / "data.npz")
    assert [str(notice.message).split(": ")[0] for notice in told] == [
        "observations/depth is left out",
        "observations/far counts as 81 numbers per step",
        "observations/labels counts as 81 numbers per step",
    ]
    assert exported.left_out == ("observations/depth",)
    with np.load(exported.path) as found:
        assert found["observations"].shape == (10, 3 + 2 * 81)


@pytest.mark.parametrize(
    ("space", "n"), [(spaces.Box(-9, 9, (3, 4), np.float32), 12), (spaces.Discrete(5), 1), (ROOM["grid"], 100)]
)
def test_bare_observations_of_any_form_are_flattened(root: Path, space: spaces.Space[Any], n: int) -> None:
    name = write_samples("room/bare-v0", root, space, spaces.Box(-1, 1, (2,), np.float32))
    with h5py.File(root / name / "data/main_data.hdf5") as file:
        for i, episode in enumerate(read(name, Dataset.episodes)):
            stored = file[f"episode_{i}/observations"][()]
            np.testing.assert_array_equal(episode.obs, stored.reshape(-1, n).astype(np.float32))


@pytest.mark.parametrize("to", ["npz", "d4rl", "robomimic", "d3rlpy", "torchrl", "lerobot"])
def test_actions_of_several_dimensions_are_flattened(root: Path, tmp_path: Path, to: str) -> None:
    name = write_samples("room/arms-v0", root, spaces.Dict(ROOM), spaces.Box(-1, 1, (2, 3), np.float32))
    assert export(name, to, tmp_path / "data").n_transitions == 10  # type: ignore[arg-type]
    with h5py.File(root / name / "data/main_data.hdf5") as file:
        for i, episode in enumerate(transitions(name)):
            np.testing.assert_array_equal(episode["actions"], file[f"episode_{i}/actions"][()].reshape(-1, 6))


@pytest.mark.parametrize("info", ["success", "is_success"])
def test_success_of_the_source_stands_beside_the_scores(
    root: Path, goal: Path, tmp_path: Path, zest: Callable[..., dict[str, Any]], info: str
) -> None:
    def infos(n_steps: int) -> dict[str, Any]:
        return {info: np.arange(n_steps + 1) == n_steps - 1}

    name = write_samples("room/done-v0", root, spaces.Dict(ROOM), spaces.Box(-1, 1, (2,), np.float32), infos=infos)
    scored = zest("relabel", name, "--goal", goal, "--n-workers", "1")["dataset"]
    with np.load(export(scored, "npz", tmp_path / "data.npz").path) as found:
        assert np.flatnonzero(found["success"]).tolist() == [2, 8]
        assert found["success"].dtype == bool
        assert {"zest_score", "source_reward"} <= set(found)
    folder = export(scored, "lerobot", tmp_path / "lerobot").path
    assert np.flatnonzero(parquet.read_table(folder / DATA_FILE).to_pydict()["next.success"]).tolist() == [2, 8]
    assert np.fromfile(export(scored, "torchrl", tmp_path / "t").path / "next/success.memmap", bool).sum() == 2
    again = zest("relabel", folder, "--goal", goal, "--frames", clips(tmp_path), "--n-workers", "1")["dataset"]
    assert np.flatnonzero(np.concatenate([one["success"] for one in transitions(again)])).tolist() == [2, 8]


def clips(folder: Path) -> Path:
    """Leave a picture of each step of two episodes."""
    for i, n_steps in enumerate((4, 6)):
        (folder / f"films/episode_{i}").mkdir(parents=True)
        for t in range(n_steps):
            Image.new("RGB", (SIDE, SIDE), (20 * t, 9, 9)).save(folder / f"films/episode_{i}/{t}.png")
    return folder / "films"


def test_a_single_episode_is_one_to_train_robomimic_on(root: Path, tmp_path: Path) -> None:
    name = write_samples("room/one-v0", root, spaces.Dict(ROOM), spaces.Box(-1, 1, (2,), np.float32), (4,))
    with h5py.File(export(name, "robomimic", tmp_path / "data.hdf5").path) as file:
        masks = {mask: members[()].tolist() for mask, members in file["mask"].items()}
    assert masks == {"train": [b"demo_0"], "valid": []}
