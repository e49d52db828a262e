"""Exports: every observation, action, reward and end flag of a file equals the dataset's."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from zest_rl import cli, data
from zest_rl.errors import BadInput
from zest_rl.export import Rewards, export, transitions
from zest_rl.frames import Views
from zest_rl.relabel import relabel
from zest_rl.scorer import ScorerConfig


@pytest.fixture
def scored(collected: str) -> str:
    """The tiny dataset with same-scene scores."""
    return relabel(collected, ScorerConfig(Views("micro", n_views=1, size=96, tolerance=0.05), "same-scene")).dataset_id


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
    episodes, scores = data.read_episodes(scored), data.read_scores(scored)
    for episode, score, truth, found in zip(
        episodes, scores, data.read_ground_truth(scored), transitions(scored), strict=True
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


def test_rewards_take_the_shape_that_is_asked_for() -> None:
    rewards = [np.array([0.0, 1.0, 3.0], np.float32), np.array([2.0, -1.0], np.float32)]

    def of(*arguments: Any) -> list[list[float]]:
        return [values.tolist() for values in Rewards(*arguments).of(rewards, [0.0, 1.5])]

    assert of() == [[0, 1, 3], [2, -1]]
    assert of("difference") == [[0, 1, 2], [0.5, -3]]
    assert of("terminal") == [[0, 0, 3], [0, -1]]
    assert of("step", True) == [[0.25, 0.5, 1], [0.75, 0]]
    assert of("terminal", True) == [[0, 0, 1], [0, 0]]
    assert all(values.dtype == np.float32 for values in Rewards("terminal", True).of(rewards, [0.0, 0.0]))
    with pytest.raises(BadInput, match="unknown shape of rewards 'last'"):
        Rewards("last")  # type: ignore[arg-type]
    with pytest.raises(BadInput, match="all equal cannot be normalised"):
        Rewards("step", True).of([np.ones(3, np.float32)], [0.0])


def test_differences_are_those_of_relabeling(scored: str, collected: str) -> None:
    config = ScorerConfig(Views("micro", n_views=1, size=96, tolerance=0.05), "same-scene", features="raw")
    level = relabel(collected, config).dataset_id
    difference = relabel(collected, config, reward="difference").dataset_id
    for one, other in zip(transitions(level, Rewards("difference")), transitions(difference), strict=True):
        np.testing.assert_allclose(one["rewards"], other["rewards"], atol=1e-6)
    with pytest.raises(BadInput, match="are differences already"):
        transitions(difference, Rewards("difference"))


@pytest.mark.parametrize("to", ["npz", "d4rl", "robomimic"])
def test_an_episode_that_ended_by_itself_is_no_timeout(collected: str, to: str, tmp_path: Path) -> None:
    with h5py.File(data.dataset_path(collected) / "data" / "main_data.hdf5", "r+") as file:
        file["episode_1/terminations"][-1], file["episode_1/truncations"][-1] = True, False
    (data.dataset_path(collected) / data.MANIFEST_FILE).unlink()
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


def test_a_format_that_would_lose_the_rewards_is_refused(collected: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="leaves out the transition at a time limit"):
        export(collected, "d4rl", tmp_path / "x", Rewards("terminal"))
    assert not (tmp_path / "x").exists()


def test_a_dataset_without_scores_or_ground_truth_is_exported_too(collected: str, tmp_path: Path) -> None:
    assert "zest_score" not in transitions(collected)[0]
    with h5py.File(data.dataset_path(collected) / "data" / "main_data.hdf5", "r+") as file:
        for name in file:
            del file[name]["infos"]
    metadata = data.dataset_path(collected) / "data" / "metadata.json"
    known = json.loads(metadata.read_text())
    for key in ("ref_min_score", "ref_max_score", "zest"):
        known.pop(key, None)
    metadata.write_text(json.dumps(known))
    (data.dataset_path(collected) / data.MANIFEST_FILE).unlink()
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
    with pytest.raises(BadInput, match="unknown format 'rlds'"):
        export(collected, "rlds", tmp_path / "x")  # type: ignore[arg-type]
