"""A learned reward from end to end: train, relabel, inspect, train a policy on it, evaluate; and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from read_dataset import read
from tiny_dataset import COLLECTED, SHORT_HORIZON, collect_some

import zest_rl
from zest_rl.data.reader import Dataset, dataset_path
from zest_rl.evaluation.rollout import run_episodes
from zest_rl.rewards.by_learned import relabel_by_run
from zest_rl.rewards.learned import LearnedReward
from zest_rl.runtime import artifacts

SMALL: dict[str, Any] = {"hidden_size": 8, "n_updates": 20, "device": "cpu", "threads": 1}


def shorten(run: Path) -> Path:
    """Let evaluations of a run last `SHORT_HORIZON` steps."""
    meta = artifacts.read_json(run / "meta.json")
    meta["dataset"]["env_spec"] = json.dumps(
        json.loads(meta["dataset"]["env_spec"]) | {"max_episode_steps": SHORT_HORIZON}
    )
    artifacts.write_json(run / "meta.json", meta)
    return run


@pytest.fixture
def scored(trained: Path) -> str:
    """Id of the relabeled dataset."""
    return str(artifacts.read_json(trained / "bc-0" / "meta.json")["dataset"]["id"])


def test_a_reward_of_observations_makes_a_dataset_whose_policies_are_evaluated_with_it(
    scored: str, tmp_path: Path, zest: Callable[..., dict[str, Any]], refusal: Callable[..., tuple[int, str]]
) -> None:
    run = tmp_path / "trex"
    flags = ("--n-updates", "20", "--hidden-size", "8", "--threads", "1", "--device", "cpu", "--run-dir", run)
    told = zest("train", "trex", scored, *flags)
    assert 0 <= told["held_out_accuracy"] <= 1
    assert told["next"] == f"zest relabel {scored} --reward {run}"
    code, message = refusal("evaluate", run)
    assert (code, "holds a reward, not a policy" in message) == (2, True)

    made = zest("relabel", COLLECTED, "--reward", run)["dataset"]
    reward = LearnedReward.load(run)
    for episode, rewards, scores in zip(
        read(COLLECTED, Dataset.episodes), read(made, Dataset.rewards), read(made, Dataset.scores), strict=True
    ):
        np.testing.assert_array_equal(rewards, reward.of_obs(episode.obs)[1:], "r_t is that of o_{t+1}")
        np.testing.assert_array_equal(scores[1:], rewards)
    assert zest_rl.relabel(scored, reward=run).dataset_id == made, "whatever the rewards of the dataset were"
    with zest_rl.open_dataset(made) as ds:
        record = ds.record.relabel
        assert record is not None
        assert record.learned is not None
    assert (record.source, record.learned["ranked"], record.learned["inputs"]) == (COLLECTED, scored, "obs")
    assert "learned by T-REX" in (dataset_path(made) / "README.md").read_text()
    assert zest("inspect", made, "--output", tmp_path / "i.html")["verdicts"].keys() == {made}

    small = {"n_layers": 1, "warmup_updates": 0, "run_dir": tmp_path / "rvs", **SMALL}
    policy_run = shorten(zest_rl.train("rvs", made, **small))
    (told_return,) = (e.zest_return for e in zest_rl.evaluate(policy_run, n_episodes=1, n_workers=1).episodes)
    policy = zest_rl.load_policy(policy_run)
    target = policy.meta["return_quantiles"][-1]
    trace = run_episodes(policy, range(1_000_000, 1_000_001), target_return=target, reward=reward)
    assert told_return == pytest.approx(trace["score"][0, 1:].sum(), rel=1e-5)


def test_a_reward_of_embeddings_relabels_and_its_policies_ask_for_another_return_to_go(
    scored: str, tmp_path: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    run = zest_rl.train("trex", scored, inputs="embeddings", run_dir=tmp_path / "trex", **SMALL)
    made = relabel_by_run(scored, run, n_workers=1).dataset_id
    assert LearnedReward.load(run).meta["obs_dim"] == 1280
    with zest_rl.open_dataset(made) as ds:
        assert np.ptp([rewards.sum() for rewards in ds.rewards()]) > 0
    small = {"n_layers": 1, "warmup_updates": 0, "run_dir": tmp_path / "rvs", **SMALL}
    policy_run = shorten(zest_rl.train("rvs", made, **small))
    code, message = refusal("evaluate", policy_run, "--n-episodes", "1")
    assert (code, "learned of embeddings" in message, "--rtg constant" in message) == (2, True, True)
    assert zest_rl.evaluate(policy_run, n_episodes=1, n_workers=1, rtg="constant").episodes


def test_a_reward_of_another_task_or_of_no_scores_or_a_folder_that_is_none_is_refused(
    trained: Path, scored: str, tmp_path: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    run = zest_rl.train("trex", scored, run_dir=tmp_path / "trex", **SMALL)
    collect_some("zest/kitchen-sdoor-tiny-v0", "sdoor", 1)
    code, message = refusal("relabel", "zest/kitchen-sdoor-tiny-v0", "--reward", run)
    assert code == 2
    assert f"this reward is of task micro of zest/Kitchen-v1, where {scored} was recorded" in message
    assert "is of task sdoor of zest/Kitchen-v1; give one that `zest train trex` learned there" in message
    of_truth = zest_rl.train("trex", COLLECTED, run_dir=tmp_path / "truth", **SMALL)
    code, message = refusal("relabel", COLLECTED, "--reward", of_truth)
    assert (code, "not ranked by ZeST scores; run `zest relabel`" in message) == (2, True)
    code, message = refusal("relabel", COLLECTED, "--reward", trained / "bc-0")
    assert (code, "holds a policy (bc), no reward" in message) == (2, True)
    code, message = refusal("relabel", COLLECTED, "--reward", "diference")
    assert (code, "did you mean 'difference'?" in message) == (2, True)
