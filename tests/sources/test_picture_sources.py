"""`zest relabel` on pictures among the observations of Minari datasets."""

from __future__ import annotations

import json
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest
from PIL import Image
from read_dataset import read
from rollouts import (
    LENGTHS,
    SIDE,
    Episode,
    Run,
    arrays,
    check_kept_but_the_rewards,
    expected_scores,
    rows,
    write_rollouts,
)

from zest_rl import cli
from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.sources import open_source
from zest_rl.sources.pictures import Pictures


def test_the_named_camera_is_scored_by_the_definition(
    pictured: str, maze: list[Episode], goal: Path, zest: Run
) -> None:
    result = zest("relabel", pictured, "--goal", goal, "--frames", "observations/cameras/top", "--n-workers", "1")
    assert result["dataset"].startswith("maze/pictured-zest-")
    assert result["views"] == ["observations/cameras/top"]
    assert (result["n_frames"], result["n_episodes_embedded"]) == (sum(LENGTHS) + len(LENGTHS), len(LENGTHS))
    check_kept_but_the_rewards(pictured, result["dataset"])
    for episode, scores in zip(maze, read(result["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([episode.frames], goal), atol=1e-4)
    assert read(result["dataset"], Dataset.scores)[1][-1] > 0.99, "start and goal are pictures of this very episode"


def test_several_cameras_are_views_that_are_averaged(pictured: str, maze: list[Episode], goal: Path, zest: Run) -> None:
    result = zest("relabel", pictured, "--goal", goal, "--frames", "cameras/top", "cameras/turned")
    turned = [[frame[::-1] for frame in episode.frames] for episode in maze]
    for episode, other, scores in zip(maze, turned, read(result["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([episode.frames, other], goal), atol=1e-4)


def test_several_cameras_without_a_choice_are_an_error_that_lists_them(
    pictured: str, goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    code, message = refusal("relabel", pictured, "--goal", goal)
    assert code == 2
    assert "several entries with pictures: observations/cameras/top, observations/cameras/turned" in message


def test_the_only_camera_is_found_by_itself_also_as_jpeg_in_a_flat_observation(
    maze: list[Episode], goal: Path, zest: Run
) -> None:
    flat = write_rollouts("maze/flat-v0", maze, lambda e: np.stack(e.frames))
    result = zest("relabel", flat, "--goal", goal, "--n-workers", "1")
    assert result["views"] == ["observations"]
    check_kept_but_the_rewards(flat, result["dataset"])
    for episode, scores in zip(minari.load_dataset(flat), read(result["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([list(episode.observations)], goal), atol=1e-4)


def test_which_frames_were_chosen_is_told_before_they_are_embedded(
    maze: list[Episode], goal: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = write_rollouts("maze/flat-v0", maze, lambda e: np.stack(e.frames))
    assert cli.main(["relabel", flat, "--goal", str(goal), "--n-workers", "1"]) == 0
    err = capsys.readouterr().err
    assert 0 <= err.find("frames: observations\n") < err.index("embedding frames: 100/100")


def test_rewards_need_not_be_recorded(pictured: str, goal: Path, zest: Run, tmp_path: Path) -> None:
    words = ["--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    with h5py.File(reader.dataset_path(pictured) / reader.DATA_FILE, "r+") as file:
        for episode in file.values():
            del episode["rewards"]
    made = zest("relabel", pictured, *words)["dataset"]
    for scores, found in zip(read(made, Dataset.scores), minari.load_dataset(made), strict=True):
        np.testing.assert_array_equal(found.rewards, scores[1:])
        assert "source" not in found.infos
    zest("export", made, "--output", tmp_path / "maze.npz")
    assert "source_reward" not in np.load(tmp_path / "maze.npz")


def test_episodes_that_minari_could_not_read_are_refused_before_any_work(
    pictured: str, goal: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    with h5py.File(reader.dataset_path(pictured) / reader.DATA_FILE, "r+") as file:
        del file["episode_1"]
    code, error = refusal("relabel", pictured, "--goal", goal, "--frames", "cameras/top")
    assert (code, "must hold episode_0, … episode_1, as Minari needs it" in error) == (2, True)
    assert not (tmp_path / "cache" / "frames").exists()


def test_the_metadata_tells_where_the_frames_came_from(pictured: str, goal: Path, zest: Run) -> None:
    made = zest("relabel", pictured, "--goal", goal, "--frames", "cameras/top")["dataset"]
    facts = read(made, lambda ds: ds.metadata)["zest"]["relabel"]
    assert facts["source"] == pictured
    assert facts["source_sha256"] == read(pictured, Dataset.fingerprint)
    assert facts["frames"]["views"] == ["observations/cameras/top"]
    assert facts["scorer"]["config"]["goal"] == str(goal)
    assert {"goal_sha256", "embedder_sha256"} <= facts["scorer"].keys()
    assert (reader.dataset_path(made) / "zest_goal" / "goal" / "0.png").is_file()


def test_a_run_goes_on_at_the_episode_where_it_was_cut_and_ends_as_one_that_was_not(
    pictured: str, goal: Path, zest: Run, tmp_path: Path
) -> None:
    words = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    whole = zest(*words)
    expected = arrays(whole["dataset"])
    shutil.rmtree(whole["path"])
    cached = sorted((tmp_path / "cache" / "frames").rglob("*.npz"))
    assert len(cached) == len(LENGTHS)
    cached[0].unlink()
    again = zest(*words)
    assert (again["dataset"], again["n_episodes_embedded"]) == (whole["dataset"], 1)
    for name, array in arrays(again["dataset"]).items():
        np.testing.assert_array_equal(array, expected[name])
    assert zest(*words)["n_episodes_embedded"] == 0


def test_a_ray_cluster_of_its_own_makes_the_same_rewards(pictured: str, goal: Path, zest: Run, tmp_path: Path) -> None:
    words = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top"]
    here = zest(*words, "--n-workers", "1")
    expected = arrays(here["dataset"])
    shutil.rmtree(here["path"])
    shutil.rmtree(tmp_path / "cache" / "frames")
    on_ray = zest(*words, "--engine", "ray", "--n-workers", "2")
    assert (on_ray["dataset"], on_ray["n_episodes_embedded"]) == (here["dataset"], len(LENGTHS))
    for name, array in arrays(on_ray["dataset"]).items():
        np.testing.assert_array_equal(array, expected[name])


def test_damaged_embeddings_are_noticed_and_made_again(pictured: str, goal: Path, zest: Run, tmp_path: Path) -> None:
    words = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    made = zest(*words)
    expected = arrays(made["dataset"])
    shutil.rmtree(made["path"])
    next((tmp_path / "cache" / "frames").rglob("*.npz")).write_bytes(b"cut")
    assert zest(*words)["n_episodes_embedded"] == 1
    for name, array in arrays(made["dataset"]).items():
        np.testing.assert_array_equal(array, expected[name])


def test_an_episode_of_pictures_is_never_in_memory_whole(tmp_path: Path) -> None:
    n, shape = 1000, (120, 160, 3)
    with h5py.File(tmp_path / "long.hdf5", "w") as file:
        file.create_dataset("episode_0/observations", (n, *shape), np.uint8, chunks=(10, *shape), compression="gzip")
    frames = Pictures(tmp_path / "long.hdf5", ("episode_0",), ("observations",))
    tracemalloc.start()
    assert sum(1 for _ in frames.read(0)) == n
    frames.digest(0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < n * np.prod(shape) / 4


def test_the_same_floats_of_another_range_are_other_pictures(tmp_path: Path) -> None:
    digests = []
    for bright in (200, 1):
        with h5py.File(tmp_path / f"{bright}.hdf5", "w") as file:
            for i, value in enumerate((bright, 1)):
                file[f"episode_{i}/observations"] = np.full((2, 16, 16, 3), value, np.float32)
        digests.append(Pictures(tmp_path / f"{bright}.hdf5", ("episode_0", "episode_1"), ("observations",)).digest(1))
    assert digests[0] != digests[1]


def test_every_way_of_scoring_works_on_pictures(pictured: str, goal: Path, zest: Run) -> None:
    base = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    level = zest(*base)["dataset"]
    difference = zest(*base, "--reward", "difference")["dataset"]
    raw = zest(*base, "--features", "raw", "--similarity", "l2")["dataset"]
    for scores, rewards in zip(read(level, Dataset.scores), read(difference, Dataset.rewards), strict=True):
        np.testing.assert_array_equal(rewards, np.diff(scores))
    assert all((rewards <= 0).all() for rewards in read(raw, Dataset.rewards))
    many = goal.parent / "many"
    shutil.copytree(goal, many, dirs_exist_ok=True)
    Image.fromarray(np.zeros((SIDE, SIDE, 3), np.uint8)).save(many / "goal" / "1.png")
    chosen = zest(*base, "--goal", many, "--goal-share", "0.5")["dataset"]
    assert len(read(chosen, lambda ds: ds.metadata)["zest"]["relabel"]["kept_goals"]) == 1
    assert len({level, difference, raw, chosen}) == 4


def test_episodes_of_one_length_can_be_shuffled(maze: list[Episode], goal: Path, zest: Run) -> None:
    same = [episode for episode in maze if len(episode.actions) == LENGTHS[0]]
    flat = write_rollouts("maze/same-v0", same, lambda e: np.stack(e.frames))
    real, null = (zest("relabel", flat, "--goal", goal, *more)["dataset"] for more in ((), ("--shuffle", "0")))
    one, other = read(real, Dataset.rewards)
    np.testing.assert_array_equal(read(null, Dataset.rewards), [other, one])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "cameras/top"], "frames from elsewhere need a goal of their own, got 'same-scene'"),
        (["--goal", "drawings"], "several entries with pictures"),
        (["--frames", "cameras/top", "--goal", "drawings"], "need a goal of their own, got 'drawings'"),
        (["--frames", "cameras/top", "--goal", "text:a -> b"], "reads pictures only; use one that reads text"),
        (
            ["--frames", "cameras/wrist"],
            "has no pictures at 'cameras/wrist', and there is no such folder; entries with pictures: observations/cam",
        ),
        (["--frames", "cameras/top", "--views", "3"], "--views belong to the ring of views round an object"),
    ],
)
def test_bad_input_names_what_is_wrong_and_writes_nothing(
    pictured: str, words: list[str], message: str, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    code, error = refusal("relabel", pictured, *words)
    assert code == 2
    assert message in " ".join(error.split())
    assert reader.list_datasets() == [pictured]


def test_numbers_alone_are_no_frames(maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]) -> None:
    blind = write_rollouts("maze/blind-v0", maze, lambda e: rows(e, "observation"))
    code, error = refusal("relabel", blind, "--goal", goal)
    assert (code, "shows no frames" in error) == (2, True)


def test_a_wrapper_of_another_package_in_the_env_spec_does_not_matter_to_pictures(pictured: str) -> None:
    path = reader.dataset_path(pictured) / reader.METADATA_FILE
    wrapper = {"name": "Monitor", "entry_point": "of_another_package.monitor:Monitor", "kwargs": None}
    spec = {"id": "HumanoidStandup-v5", "entry_point": "gymnasium.envs.mujoco.humanoidstandup_v5:HumanoidStandupEnv"}
    metadata = json.loads(path.read_text()) | {"env_spec": json.dumps(spec | {"additional_wrappers": [wrapper]})}
    path.write_text(json.dumps(metadata))
    assert open_source(pictured, frames=["cameras/top"]).frames.views == ("observations/cameras/top",)


def test_pictures_that_are_not_read_are_named_where_there_are_no_others(
    maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    deep = write_rollouts("maze/deep-v0", maze, lambda e: {"depth": np.stack(e.frames)[..., 0].astype(np.float32) * 9})
    code, error = refusal("relabel", deep, "--goal", goal)
    assert (
        code,
        "not read as pictures: observations/depth (float32 (64, 64) per step, but not in [0, 1]" in error,
    ) == (2, True)
