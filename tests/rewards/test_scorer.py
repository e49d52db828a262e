from __future__ import annotations

import json
import random
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import open_clip
import pytest
import safetensors.numpy
import torch
from fuzzing import damaged_json, faults, outcomes
from read_dataset import read

from zest_rl.data.reader import Dataset
from zest_rl.embedders import load_embedder
from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.env import KitchenEnv
from zest_rl.kitchen.tasks import TASKS
from zest_rl.kitchen.views import Views
from zest_rl.rewards.embeddings import shared_embedder
from zest_rl.rewards.scorer import Scorer, ScorerConfig
from zest_rl.rewards.scores import score_views
from zest_rl.rewards.state_scorer import StateScorer

VIEWS = Views("micro", n_views=2, size=96, tolerance=0.05)
CONFIG = ScorerConfig("same-scene")
DRAWINGS = Path(__file__).parents[2] / "datasets" / "goals" / "micro"
MICROWAVE = 22
"""Place of the microwave's joint in qpos."""


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """One cache for all tests here: they look at the same states."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ZEST_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def episodes(collected_root: Path) -> list[np.ndarray]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(collected_root))
        return read("zest/kitchen-micro-tiny-v0", Dataset.states)


@pytest.fixture(scope="module")
def scorer(episodes: list[np.ndarray]) -> StateScorer:
    return StateScorer.build(CONFIG, VIEWS, episodes[0][0], n_workers=1)


@pytest.fixture(scope="module")
def clip_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of a small network that reads sentences, as open_clip writes it."""
    torch.manual_seed(0)
    model = open_clip.create_model("ViT-S-32-alt")
    path = tmp_path_factory.mktemp("clip") / "epoch_1.pt"
    torch.save({"epoch": 1, "state_dict": model.state_dict()}, path)
    return path


def opening(n: int) -> np.ndarray:
    """(n, 30) states: the microwave opens from closed to the goal."""
    states = np.tile(KitchenEnv("micro").start_qpos, (n, 1))
    states[:, MICROWAVE] = np.linspace(0, TASKS["micro"].goal, n)
    return states


def build(states: np.ndarray, views: Views = VIEWS, **changes: Any) -> StateScorer:
    return StateScorer.build(replace(CONFIG, **changes), views, states[0], n_workers=1)


def score_all(scorer: StateScorer, episodes: list[np.ndarray]) -> tuple[list[np.ndarray], int]:
    return scorer.scorer.score_episodes(scorer.embeddings(episodes))


# --- what the scores are ---


def test_scores_are_those_of_each_frames_embeddings_and_still_frames_are_counted(
    scorer: StateScorer, episodes: list[np.ndarray]
) -> None:
    scores, n_still = score_all(scorer, episodes)
    assert [score.shape for score in scores] == [(101,)] * len(episodes)
    for score, states in zip(scores, episodes, strict=True):
        embeddings = scorer.embedder.embed_now(states)
        assert score.dtype == np.float32
        assert score[0] == 0
        np.testing.assert_allclose(score, score_views(embeddings, scorer.scorer.starts, scorer.scorer.goals), atol=1e-6)
    zero = sum(int((score[1:] == 0).sum()) for score in scores)
    assert n_still == zero > 100, "the failed episode alone rests for its 100 steps"


def test_a_goal_in_the_same_scene_has_one_pair_per_view_and_its_score_rises_as_the_microwave_opens() -> None:
    scorer = build(opening(1), views=replace(VIEWS, tolerance=1e-3))
    assert scorer.scorer.starts.shape == scorer.scorer.goals.shape == (2, 1, 1280)
    (scores,), _ = score_all(scorer, [opening(9)])
    assert scores[0] == 0
    assert (np.diff(scores) > 0).all()
    assert scores[-1] > 0.99


def test_each_episode_is_measured_from_its_own_first_frame(scorer: StateScorer) -> None:
    states = opening(5)
    (closed_first, open_first), _ = score_all(scorer, [states, states[::-1]])
    assert closed_first[-1] > 0.9
    assert open_first[-1] < -0.9


@pytest.mark.parametrize(("features", "similarity"), [("delta", "cos"), ("raw", "cos"), ("delta", "l2"), ("raw", "l2")])
def test_scoring_states_as_they_come_gives_the_scores_of_whole_episodes(
    episodes: list[np.ndarray], features: Any, similarity: Any
) -> None:
    scorer = build(episodes[0], features=features, similarity=similarity)
    expected, _ = score_all(scorer, episodes)
    first = np.stack([states[0] for states in episodes])
    for step in (0, 40, 100):
        online = scorer.score_now(first, np.stack([states[step] for states in episodes]))
        assert online.dtype == np.float32
        np.testing.assert_allclose(online, [score[step] for score in expected], atol=1e-6)


def test_episodes_that_start_differently_are_scored_together_as_they_are_alone(scorer: StateScorer) -> None:
    states = opening(4)
    first, current = states[[0, 2, 0, 3]], states[[1, 1, 3, 0]]
    together = scorer.score_now(first, current)
    alone = [scorer.score_now(first[i : i + 1], current[i : i + 1])[0] for i in range(4)]
    np.testing.assert_allclose(together, alone, atol=1e-6)
    assert together[2] > 0.9
    assert together[3] < -0.9


def test_pictures_of_elsewhere_are_shared_by_all_views(episodes: list[np.ndarray]) -> None:
    scorer = build(episodes[0], goal="drawings")
    assert scorer.scorer.starts.shape == scorer.scorer.goals.shape == (3, 1280)
    (scores,), _ = score_all(scorer, [episodes[0]])
    assert np.ptp(scores) > 0


def test_sentences_score_frames_with_a_network_that_reads_them(clip_file: Path) -> None:
    uri = f"open_clip:ViT-S-32-alt@{clip_file}"
    scorer = build(opening(1), goal="text:closed microwave | shut oven -> open microwave", embedder=uri)
    assert (scorer.scorer.starts.shape, scorer.scorer.goals.shape) == ((2, 256), (1, 256))
    texts = load_embedder(uri).embed_texts(["open microwave"])
    np.testing.assert_allclose(scorer.scorer.goals, texts, atol=1e-3)
    (scores,), _ = score_all(scorer, [opening(3)])
    assert scores[0] == 0
    assert (scores[1:] != 0).all()


def test_sentences_for_a_network_of_pictures_are_refused_and_one_that_reads_them_is_named() -> None:
    with pytest.raises(BadInput, match=r"is a sentence, but embedder 'efficientnet-lite0' .*open_clip:ViT-B-32/openai"):
        build(opening(1), goal="text:closed microwave -> open microwave")


def test_a_goal_is_embedded_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path))
    first = build(opening(1), goal="drawings").scorer
    (path,) = (tmp_path / "goals").glob("*.npz")
    written = path.stat().st_mtime_ns
    np.testing.assert_array_equal(build(opening(1), goal="drawings").scorer.goals, first.goals)
    assert path.stat().st_mtime_ns == written
    path.write_bytes(path.read_bytes()[:1000])
    np.testing.assert_array_equal(build(opening(1), goal="drawings").scorer.goals, first.goals)


def test_the_fingerprint_names_all_that_a_score_depends_on() -> None:
    start = opening(1)
    scorers = [
        build(start),
        build(start, goal="drawings"),
        build(start, goal="drawings", features="raw"),
        build(start, goal="drawings", similarity="l2"),
        build(start, goal="drawings", precision="bf16"),
        build(start, goal="drawings", views=replace(VIEWS, tolerance=0.1)),
    ]
    assert len({scorer.scorer.fingerprint() for scorer in scorers}) == len(scorers)
    assert build(start).scorer.fingerprint() == scorers[0].scorer.fingerprint()


# --- on disk ---


def test_a_saved_scorer_gives_the_same_bits_and_needs_no_goal(
    scorer: StateScorer, episodes: list[np.ndarray], tmp_path: Path
) -> None:
    scorer.scorer.save(tmp_path / "scorer.safetensors")
    loaded = StateScorer.load(tmp_path / "scorer.safetensors", n_workers=1)
    assert (loaded.scorer.config, loaded.scorer.views) == (CONFIG, VIEWS)
    assert loaded.scorer.goal is None
    assert loaded.scorer.record == scorer.scorer.record
    assert loaded.scorer.fingerprint() == scorer.scorer.fingerprint()
    for ours, theirs in zip(score_all(loaded, episodes)[0], score_all(scorer, episodes)[0], strict=True):
        np.testing.assert_array_equal(ours, theirs)
    loaded.scorer.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "scorer.safetensors").read_bytes()


@pytest.mark.parametrize(("backend", "used"), [("auto", "onnxruntime"), ("torch", "torch")])
def test_a_scorer_goes_on_with_the_backend_that_made_it(
    backend: Any, used: str, episodes: list[np.ndarray], tmp_path: Path
) -> None:
    config = replace(CONFIG, backend=backend)
    made = StateScorer.build(config, VIEWS, episodes[0][0], device="cpu", n_workers=1).scorer
    assert made.record.backend == used
    described = made.record.to_json()["config"]
    assert described.get("backend") == (None if used == "torch" else used), "records of torch are as they always were"
    made.save(tmp_path / "scorer.safetensors")
    loaded = Scorer.load(tmp_path / "scorer.safetensors", device="cpu")
    assert (loaded.config.backend, loaded.record) == (backend, made.record)


def test_a_scorer_goes_on_with_embeddings_of_the_type_that_made_it(episodes: list[np.ndarray], tmp_path: Path) -> None:
    halves, whole = (
        StateScorer.build(replace(CONFIG, vectors=vectors), VIEWS, episodes[0][0], device="cpu", n_workers=1)
        for vectors in ("float16", "float32")
    )
    np.testing.assert_array_equal(halves.scorer.goals, whole.scorer.goals.astype(np.float16).astype(np.float32))
    assert halves.scorer.fingerprint() != whole.scorer.fingerprint(), "which names the dataset"
    assert [each.scorer.record.to_json()["config"].get("vectors") for each in (halves, whole)] == ["float16", None]
    halves.scorer.save(tmp_path / "scorer.safetensors")
    loaded = StateScorer.load(tmp_path / "scorer.safetensors", device="cpu", n_workers=1)
    assert loaded.scorer.record == halves.scorer.record
    assert loaded.embedder.folder == halves.embedder.folder != whole.embedder.folder
    for first, second in zip(score_all(loaded, episodes)[0], score_all(halves, episodes)[0], strict=True):
        np.testing.assert_array_equal(first, second)


def test_a_scorer_of_other_weights_is_refused(tmp_path: Path) -> None:
    import timm

    weights = tmp_path / "weights.pth"

    def write(seed: int) -> None:
        torch.manual_seed(seed)
        torch.save(timm.create_model("resnet10t", pretrained=False).state_dict(), weights)
        shared_embedder.cache_clear()  # as in a later process

    write(0)
    build(opening(1), embedder=f"timm:resnet10t@{weights}").scorer.save(tmp_path / "scorer.safetensors")
    write(1)
    with pytest.raises(ZestError, match=r"was made with another embedder \(weights, precision, or versions differ\)"):
        Scorer.load(tmp_path / "scorer.safetensors")
    write(0)
    assert Scorer.load(tmp_path / "scorer.safetensors").goals.shape == (2, 1, 512)


def rewrite(path: Path, **changes: Any) -> None:
    """Change the description in a saved scorer, as a machine on which it means something else would."""
    arrays = safetensors.numpy.load_file(path)
    with safetensors.safe_open(path, framework="numpy") as file:
        described = json.loads(file.metadata()["scorer"])
    described["config"] = {**described["config"], **changes}
    safetensors.numpy.save_file(arrays, path, metadata={"scorer": json.dumps(described)})


def test_a_scorer_of_before_sees_by_the_views_it_was_made_with(tmp_path: Path) -> None:
    start = KitchenEnv("knob2").start_qpos
    before = Views("knob2", n_views=2, size=96, framing=1)
    scorer, path = build(start[None], before), tmp_path / "scorer.safetensors"
    scorer.scorer.save(path)
    rewrite(path, views={name: value for name, value in asdict(before).items() if name != "framing"})
    loaded = Scorer.load(path)
    assert loaded.views == before
    assert loaded.record == scorer.scorer.record
    assert len(before.cameras) == 2 != len(Views("knob2", n_views=2, size=96).cameras)


def test_a_scorer_of_another_precision_or_other_views_is_refused(scorer: StateScorer, tmp_path: Path) -> None:
    path = tmp_path / "scorer.safetensors"
    scorer.scorer.save(path)
    rewrite(path, precision="bf16")
    with pytest.raises(ZestError, match="made with another embedder") as caught:
        Scorer.load(path)
    assert not isinstance(caught.value, BadInput)
    scorer.scorer.save(path)
    rewrite(path, views=asdict(replace(VIEWS, size=64)))
    with pytest.raises(ZestError, match="made with another views"):
        Scorer.load(path)


def test_a_missing_or_damaged_scorer_is_an_error_that_says_what_to_do(scorer: StateScorer, tmp_path: Path) -> None:
    path = tmp_path / "scorer.safetensors"
    expected = r"scorer\.safetensors.*(relabel the dataset|copy or download it) again"
    with pytest.raises(ZestError, match=expected):
        Scorer.load(path)
    scorer.scorer.save(path)
    whole = path.read_bytes()
    for damaged in (b"", whole[:-1], whole[:40], b"\0" * len(whole), whole.replace(b'{\\"config', b"??????????")):
        assert damaged != whole
        path.write_bytes(damaged)
        with pytest.raises(ZestError, match=expected):
            Scorer.load(path)
    scorer.scorer.save(path)
    rewrite(path, colour="blue")
    with pytest.raises(ZestError, match=expected):
        Scorer.load(path)


def test_a_scorer_whose_goals_are_of_another_length_than_its_embeddings_is_refused(
    scorer: StateScorer, tmp_path: Path
) -> None:
    short = replace(scorer.scorer, starts=scorer.scorer.starts[..., :7], goals=scorer.scorer.goals[..., :7])
    short.save(tmp_path / "scorer.safetensors")
    with pytest.raises(
        BadInput, match=r"holds embeddings of 7 numbers, but its embedder efficientnet-lite0 makes 1280"
    ):
        Scorer.load(tmp_path / "scorer.safetensors")


@pytest.mark.parametrize("n_inputs", [100, pytest.param(3000, marks=pytest.mark.slow)])
def test_a_scorer_of_a_damaged_description_is_loaded_or_refused(
    n_inputs: int, scorer: StateScorer, tmp_path: Path
) -> None:
    path, rng = tmp_path / "scorer.safetensors", random.Random(0)
    scorer.scorer.save(path)
    arrays, described = safetensors.numpy.load_file(path), scorer.scorer.record.to_json()
    damaged = [damaged_json(described, rng) for _ in range(n_inputs)]
    damaged.append({**described, "config": {**described["config"], "precision": []}})

    def load(i: int) -> None:
        safetensors.numpy.save_file(arrays, path, metadata={"scorer": json.dumps(damaged[i])})
        Scorer.load(path)

    kinds, wrong = faults(outcomes(load, len(damaged)))
    assert not wrong, wrong[0].detail
    assert kinds["refused"] > n_inputs / 2


# --- goals without ground truth ---


def test_the_goals_that_the_episodes_end_nearest_to_are_kept(episodes: list[np.ndarray], tmp_path: Path) -> None:
    whole = build(episodes[0], goal=str(DRAWINGS), goal_share=0.5)
    n_goals = len(whole.scorer.goals)
    at_end = []
    for k in range(n_goals):
        alone = whole.with_goals(np.array([k]))
        at_end.append(np.mean([score[-1] for score in score_all(alone, episodes)[0]]))
    kept = whole.scorer.goals_near(whole.embeddings(episodes))
    scorer = whole.with_goals(kept)
    assert sorted(kept) == sorted(np.argsort(at_end)[-len(kept) :])
    assert len(kept) == round(n_goals / 2)
    np.testing.assert_array_equal(scorer.scorer.goals, whole.scorer.goals[kept])
    assert scorer.scorer.goal is not None
    assert len(scorer.scorer.goal.goals) == len(kept)
    scorer.scorer.save(tmp_path / "scorer.safetensors")
    loaded = StateScorer.load(tmp_path / "scorer.safetensors", n_workers=1)
    for one, other in zip(score_all(scorer, episodes)[0], score_all(loaded, episodes)[0], strict=True):
        np.testing.assert_array_equal(one, other)
    assert scorer.scorer.fingerprint() != build(episodes[0], goal=str(DRAWINGS)).scorer.fingerprint()


def test_one_goal_is_always_kept_and_a_share_of_none_is_refused(episodes: list[np.ndarray]) -> None:
    scorer = build(episodes[0], goal_share=0.01)
    assert list(scorer.scorer.goals_near(scorer.embeddings(episodes))) == [0]
    with pytest.raises(BadInput, match=r"goal_share must be in \(0, 1\], got 0"):
        replace(CONFIG, goal_share=0.0)
