"""What a relabeled copy of any dataset keeps, and what can be done with it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from read_dataset import read
from rollouts import (
    LENGTHS,
    Episode,
    Run,
    arrays,
    check_kept_but_the_rewards,
    rows,
    with_pictures,
    write_robomimic,
    write_rollouts,
)

from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.data.writer import write_scored
from zest_rl.errors import ZestError
from zest_rl.sources import open_source


def test_datasets_that_differ_by_their_rewards_alone_are_not_taken_for_one_another(
    maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    made = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        path = write_robomimic(tmp_path / folder / "lift.hdf5", maze)
        with h5py.File(path, "r+") as file:
            file["data/demo_1/rewards"][:] = 7 if folder == "b" else np.nan
        made.append(zest("relabel", path, "--goal", goal, "--n-workers", "1")["dataset"])
    assert made[0] != made[1]
    found = [arrays(name) for name in made]
    assert "episode_1/infos/source/reward" not in found[0], "none were recorded"
    np.testing.assert_array_equal(found[1]["episode_1/infos/source/reward"], [0, *[7] * LENGTHS[1]])


def test_a_reward_that_is_nan_does_not_lose_the_others_and_an_info_called_gt_is_no_ground_truth(
    maze: list[Episode], goal: Path, zest: Run
) -> None:
    dataset = write_rollouts(
        "maze/nan-v0",
        maze,
        with_pictures,
        infos=lambda episode: {"gt": {"depth": np.zeros(len(episode.frames))}},
        jpeg_encoding=False,
    )
    with h5py.File(reader.dataset_path(dataset) / reader.DATA_FILE, "r+") as file:
        file["episode_0/rewards"][1] = np.nan
    made = zest("relabel", dataset, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1")["dataset"]
    check_kept_but_the_rewards(dataset, made)


@pytest.mark.parametrize("name", ["observations/object", "infos/source/reward"])
def test_imported_arrays_that_did_not_reach_the_disk_are_noticed(
    name: str, maze: list[Episode], tmp_path: Path
) -> None:
    def lose(staging: Path) -> None:
        with h5py.File(staging / reader.DATA_FILE, "r+") as file:
            file[f"episode_1/{name}"][-1] += 1

    trajectories = open_source(str(write_robomimic(tmp_path / "lift.hdf5", maze))).trajectories
    scores = [np.zeros(length + 1, np.float32) for length in LENGTHS]
    rewards = [score[1:] for score in scores]
    with pytest.raises(ZestError, match=f"{name} of episode 1 of zest/lift-v0 was not written whole"):
        write_scored(trajectories, "zest/lift-v0", rewards, scores, description="", zest={}, extra=lose)
    assert reader.list_datasets() == []


def test_policies_are_trained_on_it_it_is_exported_and_inspected_and_not_evaluated(
    pictured: str, maze: list[Episode], goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    made = zest("relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1")["dataset"]
    small = ["--hidden-size", "16", "--n-layers", "1", "--n-updates", "4", "--log-every", "2", "--threads", "1"]
    for agent in ("bc", "dt"):
        trained = zest("train", agent, made, *small, "--run-dir", tmp_path / agent)
        assert trained["next"] == f"zest export {made}"
        code, error = refusal("evaluate", tmp_path / agent)
        assert code == 2
        assert "names no environment in which a policy could be evaluated; give --env" in error
    written = zest("export", made, "--output", tmp_path / "maze.npz")
    assert written["n_transitions"] == sum(LENGTHS)
    arrays_ = np.load(tmp_path / "maze.npz")
    flat = [np.concatenate([rows(e, "achieved_goal"), rows(e, "observation")], axis=1)[:-1] for e in maze]
    np.testing.assert_array_equal(arrays_["observations"], np.concatenate(flat).astype(np.float32))
    np.testing.assert_array_equal(arrays_["source_reward"], np.concatenate([e.rewards for e in maze]))
    np.testing.assert_array_equal(arrays_["rewards"], np.concatenate(read(made, Dataset.rewards)))
    inspected = zest("inspect", made, "--output", tmp_path / "page.html")
    figures = inspected["datasets"][made]["figures"]
    assert figures.keys() == {
        "value_order", "told_by_step", "straight_in_time", "saturated", "still", "fallen",
        "spearman", "kendall", "pairwise", "epic",  # by the rewards that the dataset came with
    }  # fmt: skip
    still = [score[1:] == 0 for score in read(made, Dataset.scores)]
    assert sum(map(np.sum, still)) == read(made, lambda ds: ds.metadata)["zest"]["relabel"]["n_still_frames"]
    assert figures["still"]["value"] == pytest.approx(np.mean([episode.mean() for episode in still]))
    page = (tmp_path / "page.html").read_text()
    assert made in page
    assert (page.count('class="strip"'), page.count("data:video/mp4")) == (2, 2), "its pictures are in the dataset"
