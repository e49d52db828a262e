"""Exports: every observation, action, reward and end flag of a file equals the dataset's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import pytest
from gymnasium import spaces
from minari_files import Recorded, write_minari
from PIL import Image
from pyarrow import parquet
from read_dataset import read

import zest_rl.export
from zest_rl import cli
from zest_rl.data import reader
from zest_rl.data.observations import is_numbers
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, Notice, ZestError
from zest_rl.export import WRITERS, Format, export, transitions
from zest_rl.export.lerobot import DATA_FILE
from zest_rl.export.transitions import shape_rewards
from zest_rl.kitchen.views import Views
from zest_rl.rewards.relabel import relabel_source
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.runtime import artifacts
from zest_rl.sources.kitchen import kitchen_source

if TYPE_CHECKING:
    from conftest import Disk

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


VIEWS = Views("micro", n_views=1, size=96, tolerance=0.05)


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


@pytest.fixture
def scored(collected: str) -> str:
    """The tiny dataset with same-scene scores."""
    return relabel_source(kitchen_source(collected, VIEWS), ScorerConfig("same-scene")).dataset_id


def corl(arrays: Any) -> dict[str, np.ndarray]:
    """What CORL's and D4RL's loaders make of flat arrays: o_{t+1} is the next row, rows with a timeout are left out."""
    rows = [i for i in range(len(arrays["rewards"]) - 1) if not arrays["timeouts"][i]]
    return {
        "observations": np.array([arrays["observations"][i] for i in rows]),
        "next_observations": np.array([arrays["observations"][i + 1] for i in rows]),
        "actions": np.array([arrays["actions"][i] for i in rows]),
        "rewards": np.array([arrays["rewards"][i] for i in rows]),
        "terminals": np.array([bool(arrays["terminals"][i]) for i in rows]),
    }


def test_transitions_are_the_dataset_s_unshifted(scored: str) -> None:
    episodes, scores = read(scored, Dataset.episodes), read(scored, Dataset.scores)
    for episode, score, truth, found in zip(
        episodes, scores, read(scored, Dataset.truth), transitions(scored), strict=True
    ):
        for t in range(len(episode)):
            np.testing.assert_array_equal(found["observations"][t], episode.obs[t])
            np.testing.assert_array_equal(found["next_observations"][t], episode.obs[t + 1])
            np.testing.assert_array_equal(found["actions"][t], episode.actions[t])
            assert found["rewards"][t] == episode.rewards[t] == score[t + 1] == found["zest_score"][t]
            assert found["gt_reward"][t] == truth.rewards[t]
        assert found["timeouts"].tolist() == [False] * (len(episode) - 1) + [True]
        assert not found["terminals"].any()
        assert (found["gt_episode_success"] == truth.success).all()


@pytest.mark.parametrize("to", ["npz", "d4rl"])
def test_flat_files_hold_all_transitions_and_say_where_they_come_from(scored: str, to: str, tmp_path: Path) -> None:
    path = export(scored, to, tmp_path / "data.out").path  # type: ignore[arg-type]
    if to == "npz":
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        about = json.loads(str(arrays.pop("about")))
    else:
        with h5py.File(path) as file:
            arrays, about = {name: values[()] for name, values in file.items()}, json.loads(file.attrs["about"])
    episodes = transitions(scored)
    assert set(arrays) == {*episodes[0], "episode"}
    for i, episode in enumerate(episodes):
        for name, values in episode.items():
            np.testing.assert_array_equal(arrays[name][arrays["episode"] == i], values)
            assert arrays[name].dtype == values.dtype
    assert (about["dataset"], about["rewards"], about["ref_max_score"]) == (scored, "step", 70.0)
    assert about["zest"]["relabel"]["scorer"]["config"]["goal"] == "same-scene"
    flat = corl(arrays)
    own = {name: np.concatenate([episode[name][:-1] for episode in episodes]) for name in flat}
    for name, values in flat.items():
        np.testing.assert_array_equal(values, own[name], err_msg=name)


def test_robomimic_files_hold_one_group_per_episode(scored: str, tmp_path: Path) -> None:
    path = export(scored, "robomimic", tmp_path / "data.hdf5").path
    episodes = transitions(scored)
    with h5py.File(path) as file:
        assert file["data"].attrs["total"] == sum(len(episode["rewards"]) for episode in episodes)
        env = json.loads(file["data"].attrs["env_args"])
        assert (env["env_name"], env["env_kwargs"]["task"]) == ("zest/Kitchen-v1", "micro")
        for i, episode in enumerate(episodes):
            demo = file[f"data/demo_{i}"]
            assert demo.attrs["num_samples"] == len(episode["rewards"])
            for name, key in (
                ("obs/flat", "observations"), ("next_obs/flat", "next_observations"), ("actions", "actions"),
                ("rewards", "rewards"), ("gt_reward", "gt_reward"), ("zest_score", "zest_score"),
                ("timeouts", "timeouts"), ("terminals", "terminals"),
            ):  # fmt: skip
                np.testing.assert_array_equal(demo[name], episode[key])
            assert demo["dones"][()].tolist() == [0] * (len(episode["rewards"]) - 1) + [1]
        masks = {name: {one.decode() for one in file[f"mask/{name}"]} for name in ("train", "valid")}
        assert masks["train"] | masks["valid"] == {f"demo_{i}" for i in range(len(episodes))}
        assert len(masks["valid"]) == 1
        assert not masks["train"] & masks["valid"]


def test_d3rlpy_files_hold_what_its_loader_asks_for(scored: str, tmp_path: Path) -> None:
    path = export(scored, "d3rlpy", tmp_path / "data.h5").path
    with h5py.File(path) as file:
        assert file["columns"][()].tolist() == [b"observations", b"actions", b"rewards", b"terminated"]
        assert (file["num_episodes"][()], file["version"][()]) == (4, b"2.1")
        for i, episode in enumerate(transitions(scored)):
            np.testing.assert_array_equal(file[f"observations_{i}"], episode["observations"])
            np.testing.assert_array_equal(file[f"rewards_{i}"], episode["rewards"][:, None])
            np.testing.assert_array_equal(file[f"zest_score_{i}"], episode["zest_score"])
            assert not file[f"terminated_{i}"][()]


def test_torchrl_folders_hold_a_raw_file_per_entry(scored: str, tmp_path: Path) -> None:
    written = export(scored, "torchrl", tmp_path / "data")
    episodes = transitions(scored)
    root, after = (json.loads((written.path / name).read_text()) for name in ("meta.json", "next/meta.json"))
    assert root["shape"] == after["shape"] == [400]
    assert root["next"] == {"type": "TensorDict"}
    assert after["reward"] == {"device": "cpu", "shape": [400, 1], "dtype": "torch.float32", "is_nested": False}
    reward = np.fromfile(written.path / "next/reward.memmap", np.float32)
    np.testing.assert_array_equal(reward, np.concatenate([episode["rewards"] for episode in episodes]))
    obs = np.fromfile(written.path / "next/observation.memmap", np.float32).reshape(after["observation"]["shape"])
    np.testing.assert_array_equal(obs, np.concatenate([episode["next_observations"] for episode in episodes]))
    assert np.fromfile(written.path / "next/truncated.memmap", bool).sum() == 4
    assert written.n_bytes == sum(file.stat().st_size for file in written.path.rglob("*") if file.is_file())


def test_lerobot_folders_hold_a_row_per_frame_and_progress_beside_them(scored: str, tmp_path: Path) -> None:
    folder = export(scored, "lerobot", tmp_path / "data", fps=10).path
    rows = parquet.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()
    episodes = transitions(scored)
    assert rows["next.reward"] == [float(reward) for episode in episodes for reward in episode["rewards"]]
    assert rows["observation.state"][101] == episodes[1]["observations"][1].tolist()
    assert rows["next.observation.state"][99] == episodes[0]["next_observations"][-1].tolist()
    assert (rows["episode_index"][101], rows["frame_index"][101], rows["index"][101]) == (1, 1, 101)
    assert rows["timestamp"][101] == pytest.approx(0.1)
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["fps"], info["total_episodes"], info["total_frames"]) == (10, 4, 400)
    assert set(info["features"]) == set(rows)
    scores = np.concatenate([score[:-1] for score in read(scored, Dataset.scores)])
    progress = parquet.read_table(folder / "sarm_progress.parquet").to_pydict()
    np.testing.assert_array_equal(progress["zest_score"], scores)
    assert (min(progress["progress_sparse"]), max(progress["progress_sparse"])) == (0, 1)
    alone = export(scored, "lerobot-progress", tmp_path / "progress.parquet").path
    assert parquet.read_table(alone).to_pydict() == progress
    default = export(scored, "lerobot", tmp_path / "default").path
    assert json.loads((default / "meta/info.json").read_text())["fps"] == 12
    with pytest.raises(BadInput, match="fps must be at least 1, got 0"):
        export(scored, "lerobot", tmp_path / "other", fps=0)
    assert not (tmp_path / "other").exists()


def test_progress_needs_scores_and_takes_no_shape(collected: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="relabel it with `zest relabel`"):
        export(collected, "lerobot-progress", tmp_path / "x")
    with pytest.raises(BadInput, match="leave --shape and --normalise out"):
        export(collected, "lerobot-progress", tmp_path / "x", shape="difference")
    assert not (tmp_path / "x").exists()


def test_without_pyarrow_the_extra_is_named(collected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "without").mkdir()
    (tmp_path / "without/pyarrow.py").write_text("raise ImportError('not installed')")
    monkeypatch.syspath_prepend(str(tmp_path / "without"))
    with pytest.raises(ZestError, match=r"pip install 'zest-rl\[lerobot\]'"):
        export(collected, "lerobot", tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_exporting_needs_only_numpy_h5py_and_filelock(collected: str, tmp_path: Path) -> None:
    """So that it works beside a library whose pins exclude ours."""
    site = tmp_path / "site"
    site.mkdir()
    for package in Path(h5py.__file__).parents[1].iterdir():
        if package.name.split("-")[0].split(".")[0] in ("numpy", "h5py", "filelock"):
            (site / package.name).symlink_to(package)
    (site / "zest_rl").symlink_to(Path(reader.__file__).parents[1])
    code = (
        "import sys; from pathlib import Path; from zest_rl.export import export, to_d3rlpy, to_torchrl; "
        "formats = ('npz', 'd4rl', 'robomimic', 'd3rlpy', 'torchrl'); "
        "[export(sys.argv[1], to, Path(sys.argv[2]) / to) for to in formats]"
    )
    alone = os.environ | {"PYTHONPATH": str(site)}
    subprocess.run([sys.executable, "-S", "-c", code, collected, str(tmp_path)], env=alone, check=True)
    assert {"npz", "d4rl", "robomimic", "d3rlpy", "torchrl"} <= {path.name for path in tmp_path.iterdir()}


def test_rewards_take_the_shape_that_is_asked_for() -> None:
    rewards = [np.array([0.0, 1.0, 3.0], np.float32), np.array([2.0, -1.0], np.float32)]

    def of(*arguments: Any) -> list[list[float]]:
        return [values.tolist() for values in shape_rewards(rewards, [0.0, 1.5], *arguments)]

    assert of() == [[0, 1, 3], [2, -1]]
    assert of("difference") == [[0, 1, 2], [0.5, -3]]
    assert of("terminal") == [[0, 0, 3], [0, -1]]
    assert of("step", True) == [[0.25, 0.5, 1], [0.75, 0]]
    assert of("terminal", True) == [[0, 0, 1], [0, 0]]
    assert all(values.dtype == np.float32 for values in shape_rewards(rewards, [0.0, 0.0], "terminal", True))
    with pytest.raises(BadInput, match="unknown shape of rewards 'last'"):
        shape_rewards(rewards, [0.0, 0.0], "last")  # type: ignore[arg-type]
    with pytest.raises(BadInput, match="all equal cannot be normalised"):
        shape_rewards([np.ones(3, np.float32)], [0.0], normalise=True)


def test_differences_are_those_of_relabeling(scored: str, collected: str) -> None:
    config = ScorerConfig("same-scene", features="raw")
    level = relabel_source(kitchen_source(collected, VIEWS), config).dataset_id
    difference = relabel_source(kitchen_source(collected, VIEWS), config, reward="difference").dataset_id
    for one, other in zip(transitions(level, shape="difference"), transitions(difference), strict=True):
        np.testing.assert_allclose(one["rewards"], other["rewards"], atol=1e-6)
    with pytest.raises(BadInput, match="are differences already"):
        transitions(difference, shape="difference")


@pytest.mark.parametrize("to", ["npz", "d4rl", "robomimic"])
def test_an_episode_that_ended_by_itself_is_no_timeout(collected: str, to: str, tmp_path: Path) -> None:
    with h5py.File(reader.dataset_path(collected) / "data" / "main_data.hdf5", "r+") as file:
        file["episode_1/terminations"][-1], file["episode_1/truncations"][-1] = True, False
    (reader.dataset_path(collected) / reader.MANIFEST_FILE).unlink()
    path = export(collected, to, tmp_path / "data.out").path  # type: ignore[arg-type]
    ends = [(episode["terminals"][-1], episode["timeouts"][-1]) for episode in transitions(collected)]
    assert ends == [(False, True), (True, False), (False, True), (False, True)]
    if to == "robomimic":
        with h5py.File(path) as file:
            assert [file[f"data/demo_{i}/terminals"][-1] for i in range(4)] == [False, True, False, False]
        return
    with np.load(path) if to == "npz" else h5py.File(path) as file:
        assert file["terminals"][()].sum() == 1
        assert file["timeouts"][()].sum() == 3


@pytest.mark.parametrize("to", ["d4rl", "d3rlpy"])
def test_a_format_that_would_lose_the_rewards_is_refused(collected: str, to: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="leaves out the transition at a time limit"):
        export(collected, to, tmp_path / "x", shape="terminal")  # type: ignore[arg-type]
    assert not (tmp_path / "x").exists()


def test_a_dataset_without_scores_or_ground_truth_is_exported_too(collected: str, tmp_path: Path) -> None:
    assert "zest_score" not in transitions(collected)[0]
    with h5py.File(reader.dataset_path(collected) / "data" / "main_data.hdf5", "r+") as file:
        for name in file:
            del file[name]["infos"]
    metadata = reader.dataset_path(collected) / "data" / "metadata.json"
    known = json.loads(metadata.read_text())
    for key in ("ref_min_score", "ref_max_score", "zest"):
        known.pop(key, None)
    metadata.write_text(json.dumps(known))
    (reader.dataset_path(collected) / reader.MANIFEST_FILE).unlink()
    assert set(transitions(collected)[0]) == {
        "observations", "actions", "rewards", "next_observations", "terminals", "timeouts",
    }  # fmt: skip
    assert export(collected, "d4rl", tmp_path / "data.hdf5").n_transitions == 400


def test_the_verb_writes_beside_you_and_over_nothing(
    collected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zest: Callable[..., dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    result = zest("export", collected, "--to", "d4rl", "--shape", "difference", "--normalise")
    assert result["file"] == "kitchen-micro-tiny-v0.d4rl.hdf5"
    assert result["n_transitions"] == 400
    with h5py.File(result["file"]) as file:
        assert json.loads(file.attrs["about"])["rewards"] == "difference, normalised"
        assert (file["rewards"][()].min(), file["rewards"][()].max()) == (0, 1)
    assert cli.main(["export", collected, "--to", "d4rl"]) == 2
    assert "exists; delete it, or choose another --output" in capsys.readouterr().err
    assert zest("export", collected)["file"] == "kitchen-micro-tiny-v0.npz"
    assert zest("export", collected, "--to", "torchrl")["file"] == "kitchen-micro-tiny-v0.torchrl"
    with pytest.raises(BadInput, match="unknown format 'rlds'"):
        export(collected, "rlds", tmp_path / "x")  # type: ignore[arg-type]


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
    assert (told["n_episodes"], told["n_transitions"], told["arrays"]) == (3, 7, ["zest_score"])
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
    assert told["next"] == f"zest export {scored} --to npz"
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
    ("actions", "verb"),
    [(spaces.Box(-2, 2, (2,), np.float32), "export"), (spaces.Box(-1, 1, (2,), np.float32), "train")],
)
def test_relabel_names_training_where_actions_can_be_trained_on(
    root: Path, goal: Path, zest: Callable[..., dict[str, Any]], actions: spaces.Space[Any], verb: str
) -> None:
    name = write_samples("room/wide-v0", root, spaces.Dict(ROOM), actions)
    assert zest("relabel", name, "--goal", goal, "--n-workers", "1")["next"].startswith(f"zest {verb} ")


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


# --- full disks, cuts and competitors ---------------------------------------------------------------------------------


EXPORT_FAILED = r"the export could not be written: the (disk is full|writing process died \(SIG).*; nothing was left"


def write_without_checking_space(*args: Any) -> Any:
    """As the child process of an export, whose disk fills up after the space was checked."""
    artifacts.check_free_space = lambda folder, n_bytes: None
    return zest_rl.export._write(*args)


@pytest.mark.parametrize("to", WRITERS)
def test_a_disk_that_fills_up_while_exporting_is_an_error_of_this_process_and_leaves_nothing(
    to: Format, scored: str, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zest_rl.export, "_write", write_without_checking_space)
    disk.fill(4096)
    with pytest.raises(ZestError, match=EXPORT_FAILED):
        export(scored, to, disk.path / "out")
    assert {path.name for path in disk.path.iterdir()} == {"ballast", ".out.lock"}


@pytest.mark.slow
@pytest.mark.parametrize("to", ["d4rl", "robomimic", "d3rlpy"])
def test_whatever_room_is_left_an_hdf5_file_is_whole_or_not_there(
    to: Format, scored: str, disk: Disk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zest_rl.export, "_write", write_without_checking_space)
    whole = export(scored, to, tmp_path / "whole")
    n_written = 0
    for n_pages in range(0, whole.n_bytes // 4096 + 8, 2):
        disk.fill(4096 * n_pages)
        with suppress(ZestError):
            written = export(scored, to, disk.path / "out")
            assert written.n_bytes == whole.n_bytes
            written.path.unlink()
            n_written += 1
        (disk.path / "ballast").unlink()
    assert 1 <= n_written <= 8


def test_an_export_for_which_there_is_no_room_is_refused_beforehand(scored: str, disk: Disk) -> None:
    with pytest.raises(ZestError, match="not enough disk space"):
        export(scored, "d4rl", disk.path / "out")
    assert {path.name for path in disk.path.iterdir()} == {".out.lock"}


def exporting(dataset_id: str, to: str, path: Path) -> subprocess.Popen[str]:
    code = "import sys; from pathlib import Path; from zest_rl import cli; sys.exit(cli.main(sys.argv[1:]))"
    words = ["export", dataset_id, "--to", to, "--output", str(path)]
    return subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("to", ["npz", "torchrl"])
def test_of_two_exports_to_one_place_the_second_is_refused_and_harms_nothing(
    to: str, scored: str, tmp_path: Path
) -> None:
    both = [exporting(scored, to, tmp_path / "out") for _ in range(2)]
    messages = [process.communicate(timeout=120)[1] for process in both]
    assert sorted(process.returncode for process in both) == [0, 2]
    assert sum("exists; delete it, or choose another --output" in message for message in messages) == 1
    assert {path.name for path in tmp_path.glob("*out*")} == {"out", ".out.lock"}
