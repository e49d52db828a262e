from __future__ import annotations

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from fuzzing import damaged_bytes
from read_dataset import read

from zest_rl.cli import main
from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.views import Views
from zest_rl.rewards.relabel import (
    GOAL_FOLDER,
    SCORER_FILE,
    Relabeled,
    relabel_source,
    relabeled_id,
    rewards_from_scores,
    shuffled,
)
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.rewards.state_embeddings import STATES_PER_SHARD
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.sources.kitchen import kitchen_source

VIEWS = Views("micro", n_views=1, size=96, tolerance=0.05)
CONFIG = ScorerConfig("same-scene")
DRAWINGS = Path(__file__).parents[2] / "datasets" / "goals" / "micro"
SOURCE = "zest/kitchen-micro-tiny-v0"


def relabel_kitchen(config: ScorerConfig, **options: Any) -> Relabeled:
    return relabel_source(kitchen_source(SOURCE, VIEWS), config, **options)


@pytest.fixture(scope="module")
def places(collected_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A Minari root with the collected dataset, and a cache, for tests that disturb neither."""
    folder = tmp_path_factory.mktemp("relabel")
    shutil.copytree(collected_root, folder / "minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
        patch.setenv("ZEST_CACHE", str(folder / "cache"))
        yield folder


@pytest.fixture(scope="module")
def relabeled(places: Path) -> Relabeled:
    return relabel_kitchen(CONFIG, n_workers=1)


def arrays(dataset_id: str) -> dict[str, np.ndarray]:
    """Every array of a dataset by its path in the HDF5 file."""
    found = {}

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset):
            found[name] = node[()]

    with h5py.File(reader.dataset_path(dataset_id) / reader.DATA_FILE) as file:
        file.visititems(visit)
    return found


# --- rewards from scores ---


def test_the_reward_of_an_action_is_the_score_of_the_frame_after_it() -> None:
    scores = np.array([0.0, 0.25, 1.0, 0.5], np.float32)
    assert rewards_from_scores(scores).tolist() == [0.25, 1.0, 0.5]
    assert rewards_from_scores(scores, "level").tolist() == [0.25, 1.0, 0.5]


def test_difference_rewards_add_up_to_the_change_of_the_score() -> None:
    scores = np.array([0.5, 0.25, 1.0, 0.75], np.float32)
    rewards = rewards_from_scores(scores, "difference")
    assert rewards.tolist() == [-0.25, 0.75, -0.25]
    assert rewards.dtype == np.float32
    assert rewards.sum() == scores[-1] - scores[0]


def test_an_unknown_reward_is_refused_with_the_nearest_right_one() -> None:
    with pytest.raises(BadInput, match="unknown reward 'diference'; did you mean 'difference'"):
        rewards_from_scores(np.zeros(2, np.float32), "diference")  # type: ignore[arg-type]


def test_shuffled_scores_are_the_scores_of_other_episodes() -> None:
    scores = [np.full(3, i, np.float32) for i in range(20)]
    one, same, other = (shuffled(scores, seed) for seed in (0, 0, 1))
    assert sorted(score[0] for score in one) == list(range(20))
    for order in (one, other):
        assert all(score[0] != i for i, score in enumerate(order)), "none keeps its own"
    assert [score[0] for score in one] == [score[0] for score in same]
    assert len({tuple(score[0] for score in order) for order in (scores, one, other)}) == 3
    with pytest.raises(BadInput, match="equally long episodes only"):
        shuffled([np.zeros(3, np.float32), np.zeros(4, np.float32)], 0)


# --- the relabeled dataset ---


def test_rewards_are_the_scores_and_everything_else_stays_bit_for_bit(relabeled: Relabeled) -> None:
    before, after = arrays(SOURCE), arrays(relabeled.dataset_id)
    added = {f"episode_{i}/infos/zest/score" for i in range(4)}
    assert set(after) == set(before) | added
    for name, array in before.items():
        if name.endswith("/rewards"):
            score = after[name.replace("/rewards", "/infos/zest/score")]
            assert (array.shape, score.shape) == ((100,), (101,))
            np.testing.assert_array_equal(after[name], score[1:])
            assert (after[name] != array).any()
        else:
            np.testing.assert_array_equal(after[name], array)
    assert {"episode_0/infos/gt/reward", "episode_0/infos/gt/success", "episode_0/infos/state/qpos"} <= set(before)


def test_the_package_and_minari_read_the_same_rewards(relabeled: Relabeled) -> None:
    ours = read(relabeled.dataset_id, Dataset.episodes)
    theirs = list(minari.load_dataset(relabeled.dataset_id).iterate_episodes())
    for episode, scores, other in zip(ours, read(relabeled.dataset_id, Dataset.scores), theirs, strict=True):
        np.testing.assert_array_equal(episode.rewards, scores[1:])
        np.testing.assert_array_equal(episode.rewards, other.rewards)


def test_the_score_tells_the_episodes_that_open_the_microwave_from_the_one_that_does_not(relabeled: Relabeled) -> None:
    scores = [episode.rewards.sum() for episode in read(relabeled.dataset_id, Dataset.episodes)]
    successes = [truth.success for truth in read(relabeled.dataset_id, Dataset.truth)]
    assert sorted(successes) == [False, True, True, True]
    assert np.argmin(scores) == np.argmin(successes)


def test_the_metadata_tells_how_the_rewards_were_made(relabeled: Relabeled) -> None:
    metadata = read(relabeled.dataset_id, lambda ds: ds.metadata)
    assert metadata["dataset_id"] == relabeled.dataset_id
    assert metadata["description"].endswith("Rewards are scores (cos+delta, level) by efficientnet-lite0.")
    assert metadata["zest"]["collect"] == read(SOURCE, lambda ds: ds.metadata)["zest"]["collect"]
    facts = metadata["zest"]["relabel"]
    assert facts["source"] == SOURCE
    assert facts["source_sha256"] == read(SOURCE, Dataset.fingerprint)
    assert facts["reward"] == "level"
    config = {"views": asdict(VIEWS), **asdict(CONFIG), "backend": "onnxruntime"}
    assert config.pop("vectors") == "float32", "which is not recorded, as it was not before there was a choice"
    assert facts["scorer"]["config"] == config
    assert facts["scorer"] == json.loads(json.dumps(relabeled.scorer.record.to_json()))
    assert facts["n_still_frames"] == relabeled.n_still > 100
    assert {"torch", "mujoco", "timm", "zest-rl"} <= set(facts["provenance"]["versions"])


def test_the_scorer_beside_the_data_scores_them_as_they_were_scored(relabeled: Relabeled) -> None:
    scorer = StateScorer.load(relabeled.path / SCORER_FILE, n_workers=1)
    written = read(relabeled.dataset_id, Dataset.scores)
    for states, scores in zip(read(SOURCE, Dataset.states), written, strict=True):
        np.testing.assert_array_equal(scorer.score_episode(states), scores)


def test_a_card_lies_beside_the_data_and_readers_may_add_to_it(relabeled: Relabeled) -> None:
    card = relabeled.path / "README.md"
    assert relabeled.scorer.record.embedder_sha256 in card.read_text(encoding="utf-8")
    card.write_text(card.read_text(encoding="utf-8") + "Recorded on a Tuesday.\n", encoding="utf-8")
    assert read(relabeled.dataset_id, Dataset.scores)


def test_small_pictures_of_the_goal_lie_beside_the_data(relabeled: Relabeled) -> None:
    pictures = sorted(p.relative_to(relabeled.path) for p in (relabeled.path / GOAL_FOLDER).rglob("*.png"))
    assert pictures == [Path(GOAL_FOLDER, "goal", "0.png"), Path(GOAL_FOLDER, "init", "0.png")]


# --- the name ---


def test_the_name_says_where_the_dataset_comes_from_and_is_a_hash_of_how_it_was_scored(
    relabeled: Relabeled, places: Path
) -> None:
    assert relabeled_id("a-b/c.d-v12", "0123456789") == "a-b/c.d-zest-01234567-v12"
    shutil.copytree(DRAWINGS, places / "my goals")
    shutil.copytree(DRAWINGS, places / "same pictures, other name")
    variants: list[tuple[ScorerConfig, Any]] = [
        (CONFIG, "difference"),
        (replace(CONFIG, features="raw"), "level"),
        (replace(CONFIG, similarity="l2"), "level"),
        (replace(CONFIG, goal=str(places / "my goals")), "level"),
    ]
    others = [relabel_kitchen(config, reward=reward, n_workers=1) for config, reward in variants]
    names = {relabeled.dataset_id, *(other.dataset_id for other in others)}
    assert len(names) == 5
    assert all(reader.DATASET_ID.fullmatch(name) and name.startswith("zest/kitchen-micro-tiny-zest-") for name in names)
    assert sum(other.n_embedded for other in others) == 0, "the states were embedded already"
    for scores, episode in zip(
        read(relabeled.dataset_id, Dataset.scores), read(others[0].dataset_id, Dataset.episodes), strict=True
    ):
        np.testing.assert_array_equal(episode.rewards, np.diff(scores))

    renamed = relabel_kitchen(replace(CONFIG, goal=str(places / "same pictures, other name")), n_workers=1)
    assert renamed.dataset_id == others[-1].dataset_id
    assert renamed.already_there


def test_a_null_control_and_a_choice_of_goals_are_datasets_of_their_own(relabeled: Relabeled, places: Path) -> None:
    null = relabel_kitchen(CONFIG, shuffle=3, n_workers=1)
    rewards, nulls = (
        [e.rewards for e in read(name, Dataset.episodes)] for name in (relabeled.dataset_id, null.dataset_id)
    )
    assert sorted(map(bytes, nulls)) == sorted(map(bytes, rewards))
    assert not any(np.array_equal(reward, own) for reward, own in zip(nulls, rewards, strict=True))
    assert read(null.dataset_id, lambda ds: ds.metadata)["zest"]["relabel"]["shuffle"] == 3
    chosen = relabel_kitchen(replace(CONFIG, goal=str(DRAWINGS), goal_share=0.4), n_workers=1)
    kept = read(chosen.dataset_id, lambda ds: ds.metadata)["zest"]["relabel"]["kept_goals"]
    assert len(kept) == 1
    assert len(list((chosen.path / GOAL_FOLDER / "goal").iterdir())) == 1
    assert len({relabeled.dataset_id, null.dataset_id, chosen.dataset_id}) == 3
    again = relabel_kitchen(replace(CONFIG, goal=str(DRAWINGS), goal_share=0.4), n_workers=1)
    assert again.already_there
    np.testing.assert_array_equal(again.scorer.goals, chosen.scorer.goals)


def test_a_source_that_changes_while_it_is_relabeled_is_noticed_and_nothing_is_written(
    collected: str, relabeled: Relabeled
) -> None:
    source = kitchen_source(collected, VIEWS)
    with h5py.File(reader.dataset_path(collected) / reader.DATA_FILE, "r+") as file:
        file["episode_0/actions"][0, 0] += 0.25
    with pytest.raises(ZestError, match=r"main_data.hdf5 of dataset .* was changed since it was read"):
        relabel_source(source, CONFIG, n_workers=1)
    assert reader.list_datasets() == [collected]


def test_relabeling_again_does_nothing(relabeled: Relabeled) -> None:
    def times() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in relabeled.path.parent.rglob("*")}

    before = times()
    again = relabel_kitchen(CONFIG, n_workers=1)
    assert again.already_there
    assert (again.dataset_id, again.path, again.n_frames) == (relabeled.dataset_id, relabeled.path, 404)
    assert again.n_embedded == 0
    assert times() == before


def test_of_two_equal_calls_at_once_the_second_finds_the_work_done(collected: str) -> None:
    words = ["relabel", collected, "--views", "1", "--tolerance", "0.05", "--n-workers", "1", "--json"]
    commands = [
        subprocess.Popen(
            [sys.executable, "-c", ZEST, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    outputs = [command.communicate(timeout=120) for command in commands]
    assert [command.returncode for command in commands] == [0, 0]
    assert json.loads(outputs[0][0])["dataset"] == json.loads(outputs[1][0])["dataset"]
    assert sum("is there already" in log for _, log in outputs) == 1
    assert len([name for name in reader.list_datasets() if "-zest-" in name]) == 1


# --- cut runs ---

ZEST = "import sys; from zest_rl.cli import main; sys.exit(main())"
DIE_WHILE_WRITING = (
    f"import os; from zest_rl.rewards import relabel as r; r._write_scorer = lambda *_: os.kill(os.getpid(), 9); {ZEST}"
)


@pytest.mark.slow
def test_a_run_killed_while_embedding_and_killed_while_writing_ends_as_one_that_was_not(
    collected: str, collected_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    words = ["relabel", collected, "--views", "1", "--tolerance", "0.01", "--n-workers", "1", "--json"]

    def start(code: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def shards() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in (tmp_path / "cache").glob("embeddings/*/*.npz")}

    process = start(ZEST)
    while not shards() and process.poll() is None:
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    kept = shards()
    assert reader.list_datasets() == [collected]

    assert start(DIE_WHILE_WRITING).wait() == -signal.SIGKILL
    assert reader.list_datasets() == [collected]
    assert kept.items() < shards().items(), "what was embedded is not embedded again"
    assert [path for path in (tmp_path / "minari" / "zest").iterdir() if "zest-" in path.name], "it was cut half-way"

    result = json.loads(start(ZEST).communicate()[0])
    assert result["n_distinct_states_embedded"] == 0
    expected = arrays(result["dataset"])

    shutil.copytree(collected_root, tmp_path / "uninterrupted")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "uninterrupted"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "other cache"))
    assert main(words) == 0
    whole = json.loads(capsys.readouterr().out)
    assert (whole["dataset"], whole["n_still_frames"]) == (result["dataset"], result["n_still_frames"])
    assert whole["n_distinct_states_embedded"] > 2 * STATES_PER_SHARD
    for name, array in arrays(whole["dataset"]).items():
        np.testing.assert_array_equal(array, expected[name])
    names = [sorted(p.name for p in (tmp_path / r / "zest").iterdir()) for r in ("minari", "uninterrupted")]
    assert names[0] == names[1], "nothing of the cut runs is left"


# --- damaged caches ---


def test_a_damaged_cache_gives_the_same_rewards_without_a_word(
    relabeled: Relabeled,
    places: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(places, tmp_path / "places")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "places/minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "places/cache"))
    whole, rng = arrays(relabeled.dataset_id), random.Random(0)
    for path in sorted((tmp_path / "places/cache").rglob("*.npz")):
        path.write_bytes(damaged_bytes(path.read_bytes(), rng))
    shutil.rmtree(reader.dataset_path(relabeled.dataset_id))
    again = relabel_kitchen(CONFIG, n_workers=1)
    assert again.dataset_id == relabeled.dataset_id
    assert again.n_embedded > 0
    for name, array in arrays(again.dataset_id).items():
        np.testing.assert_array_equal(array, whole[name])
    assert capsys.readouterr() == ("", "")


def test_what_was_relabeled_before_is_found_without_rendering(
    relabeled: Relabeled, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Views, "shared_renderer", lambda views: pytest.fail("GL takes longer than all else"))
    again = relabel_kitchen(CONFIG, n_workers=1)
    assert (again.dataset_id, again.already_there) == (relabeled.dataset_id, True)


@pytest.mark.parametrize("kind", ["embeddings", "goals"])
def test_a_cache_of_other_numbers_is_refused_before_anything_is_written(
    kind: str, relabeled: Relabeled, places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(places, tmp_path / "places")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "places/minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "places/cache"))
    shutil.rmtree(reader.dataset_path(relabeled.dataset_id))
    before = reader.list_datasets()
    for path in (tmp_path / f"places/cache/{kind}").rglob("*.npz"):
        stored = read_arrays(path) or {}
        vectors = {name: array for name, array in stored.items() if name != "keys"}
        write_arrays(path, stored | {name: array[..., ::-1].copy() for name, array in vectors.items()})
    with pytest.raises(
        ZestError, match=rf"embeddings in the cache .*{kind}.* are not those that this machine computes"
    ):
        relabel_kitchen(CONFIG, n_workers=1)
    assert reader.list_datasets() == before


# --- no path from the ground truth ---


def replace_ground_truth_by_noise(dataset_id: str) -> None:
    rng = np.random.default_rng(0)
    folder = reader.dataset_path(dataset_id)
    with h5py.File(folder / reader.DATA_FILE, "r+") as file:
        for group in file.values():
            group["rewards"][...] = rng.normal(size=group["rewards"].shape)
            group["infos/gt/reward"][...] = rng.normal(size=group["infos/gt/reward"].shape)
            group["infos/gt/success"][...] = rng.integers(0, 2, size=group["infos/gt/success"].shape)
    metadata = json.loads((folder / reader.METADATA_FILE).read_text())
    metadata |= {"ref_min_score": -3.0, "ref_max_score": 5.0}
    (folder / reader.METADATA_FILE).write_text(json.dumps(metadata))
    (folder / reader.MANIFEST_FILE).unlink()


def test_nothing_flows_from_the_ground_truth_into_rewards_or_policies(
    collected_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def relabel_and_train(name: str, prepare: Callable[[str], None]) -> dict[str, Any]:
        shutil.copytree(collected_root, tmp_path / name)
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / name))
        monkeypatch.setenv("ZEST_CACHE", str(tmp_path / f"{name} cache"))
        prepare(SOURCE)
        truth = [gt.rewards for gt in read(SOURCE, Dataset.truth)]
        made = relabel_kitchen(CONFIG, n_workers=1).dataset_id
        for agent in ("bc", "dt", "rvs"):
            small = ["--n-updates", "10", "--hidden-size", "16", "--n-layers", "1", "--batch-size", "8"]
            run = ["--run-dir", str(tmp_path / f"{name} {agent}"), "--threads", "1", "--device", "cpu"]
            assert main(["train", agent, made, *small, *run]) == 0
        return {
            "id": made,
            "truth": truth,
            "scores": read(made, Dataset.scores),
            "episodes": read(made, Dataset.episodes),
        }

    real, noise = (
        relabel_and_train("real", lambda _: None),
        relabel_and_train("noise", replace_ground_truth_by_noise),
    )
    assert all((a != b).any() for a, b in zip(real["truth"], noise["truth"], strict=True))
    assert real["id"] == noise["id"]
    for i in range(4):
        np.testing.assert_array_equal(real["scores"][i], noise["scores"][i])
        np.testing.assert_array_equal(real["episodes"][i].rewards, noise["episodes"][i].rewards)
    for agent in ("bc", "dt", "rvs"):
        weights = [(tmp_path / f"{name} {agent}" / "model.safetensors").read_bytes() for name in ("real", "noise")]
        assert weights[0] == weights[1]
        metas = [json.loads((tmp_path / f"{name} {agent}" / "meta.json").read_text()) for name in ("real", "noise")]
        for key in ("return_quantiles", "return_scale", "rtg_schedule", "obs_mean"):
            assert metas[0][key] == metas[1][key]


# --- the command ---


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            ["zest/kitchen-micro-tinny-v0"],
            "there is no dataset 'zest/kitchen-micro-tinny-v0'.*did you mean 'zest/",
        ),
        (["../tiny-v0"], "there is no file or folder ../tiny-v0; give .* or a Minari id"),
        ([SOURCE, "--embedder", "efficientnet-lite"], "unknown embedder.*did you mean 'efficientnet-lite0'"),
        ([SOURCE, "--embedder", "timm:resnet10t@/none.pth"], "/none.pth does not exist"),
        ([SOURCE, "--goal", "drawing"], "unknown goal 'drawing': it is neither 'same-scene', 'toys', 'drawings'"),
        (
            [SOURCE, "--goal", "text:closed -> open"],
            "'efficientnet-lite0' reads pictures only; use one that reads",
        ),
        ([SOURCE, "--features", "deltas"], "deltas"),
        ([SOURCE, "--similarity", "cosine"], "cosine"),
        ([SOURCE, "--reward", "levels"], "levels"),
        ([SOURCE, "--precision", "fp16"], "fp16"),
        ([SOURCE, "--views", "0"], "number of views must be 1 to 1000, got 0"),
        ([SOURCE, "--views", "many"], "many"),
        ([SOURCE, "--tolerance", "-1"], "tolerance must be a finite number >= 0 .*got -1"),
        ([SOURCE, "--device", "gpu"], "unknown device 'gpu'.*valid: auto, cpu, cuda"),
        ([SOURCE, "--view", "2"], "--view"),
        ([], "dataset|DATASET"),
    ],
)
def test_bad_input_ends_with_code_2_names_what_is_wrong_and_writes_nothing(
    changes: list[str], message: str, places: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def files() -> set[str]:
        return {os.fspath(path) for path in places.rglob("*")}

    before = files()
    assert main(["relabel", *changes]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert " ".join(shown.err.split()).startswith("error: ")
    assert re.search(message, " ".join(shown.err.split())), shown.err
    assert files() == before
