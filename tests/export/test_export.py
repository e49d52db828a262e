"""Exports: every observation, action, reward and end flag of a file equals the dataset's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pyarrow import parquet
from read_dataset import read

from zest_rl import cli
from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.export import export, transitions
from zest_rl.export.transitions import shape_rewards
from zest_rl.rewards.relabel import relabel_source
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.sources.base import Source


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
    exported = export(scored, to, tmp_path / "data.out")  # type: ignore[arg-type]
    path = exported.path
    if to == "npz":
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        about = json.loads(str(arrays.pop("about")))
    else:
        with h5py.File(path) as file:
            arrays, about = {name: values[()] for name, values in file.items()}, json.loads(file.attrs["about"])
    episodes = transitions(scored)
    assert set(arrays) == {*episodes[0], "episode"} == set(exported.arrays)
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
    exported = export(scored, "robomimic", tmp_path / "data.hdf5")
    episodes = transitions(scored)
    with h5py.File(exported.path) as file:
        assert all(name.replace("demo_I", "demo_3") in file for name in exported.arrays)
        assert "data/demo_I/obs/flat" in exported.arrays
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
    exported = export(scored, "d3rlpy", tmp_path / "data.h5")
    with h5py.File(exported.path) as file:
        assert {name.replace("_I", "_3") for name in exported.arrays} == {name for name in file if name.endswith("_3")}
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
    assert {f"{name}.memmap" for name in written.arrays} == {
        path.relative_to(written.path).as_posix() for path in written.path.rglob("*.memmap")
    }
    assert root["next"] == {"type": "TensorDict"}
    assert after["reward"] == {"device": "cpu", "shape": [400, 1], "dtype": "torch.float32", "is_nested": False}
    reward = np.fromfile(written.path / "next/reward.memmap", np.float32)
    np.testing.assert_array_equal(reward, np.concatenate([episode["rewards"] for episode in episodes]))
    obs = np.fromfile(written.path / "next/observation.memmap", np.float32).reshape(after["observation"]["shape"])
    np.testing.assert_array_equal(obs, np.concatenate([episode["next_observations"] for episode in episodes]))
    assert np.fromfile(written.path / "next/truncated.memmap", bool).sum() == 4
    assert written.n_bytes == sum(file.stat().st_size for file in written.path.rglob("*") if file.is_file())


def test_lerobot_folders_hold_a_row_per_frame_and_progress_beside_them(scored: str, tmp_path: Path) -> None:
    exported = export(scored, "lerobot", tmp_path / "data", fps=10)
    folder = exported.path
    rows = parquet.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()
    episodes = transitions(scored)
    assert rows["next.reward"] == [float(reward) for episode in episodes for reward in episode["rewards"]]
    assert rows["observation.state"][101] == episodes[1]["observations"][1].tolist()
    assert rows["next.observation.state"][99] == episodes[0]["next_observations"][-1].tolist()
    assert (rows["episode_index"][101], rows["frame_index"][101], rows["index"][101]) == (1, 1, 101)
    assert rows["timestamp"][101] == pytest.approx(0.1)
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["fps"], info["total_episodes"], info["total_frames"]) == (10, 4, 400)
    assert set(info["features"]) == set(rows) == set(exported.arrays)
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


def test_lerobot_s_visualizer_draws_the_scores_of_each_episode(scored: str, tmp_path: Path) -> None:
    """Its rule, `loadEpisodeProgressGroup` of lerobot-dataset-visualizer 38e581b, src/app/…/fetch-data.ts."""
    path = export(scored, "lerobot", tmp_path / "data").path / "sarm_progress.parquet"
    file = parquet.ParquetFile(path)
    codecs = {file.metadata.row_group(0).column(i).compression for i in range(file.metadata.num_columns)}
    assert codecs <= {"SNAPPY", "UNCOMPRESSED"}, "hyparquet decompresses nothing else"
    rows = file.read().to_pylist()
    column = next(name for name in ("progress_sparse", "progress_dense", "progress") if name in rows[0])
    own = [score[:-1] for score in read(scored, Dataset.scores)]
    low, high = min(map(np.min, own)), max(map(np.max, own))
    for episode, score in enumerate(own):
        shown = sorted((row["index"], row[column]) for row in rows if row["episode_index"] == episode)
        np.testing.assert_allclose([value for _, value in shown], (score - low) / (high - low), rtol=1e-6)


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


def test_differences_are_those_of_relabeling(source: Source) -> None:
    config = ScorerConfig("same-scene", features="raw")
    level = relabel_source(source, config).dataset_id
    difference = relabel_source(source, config, reward="difference").dataset_id
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
