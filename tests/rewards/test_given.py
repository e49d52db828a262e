"""Rewards given as numbers: what the copy holds, and that nothing mistakes them for the environment's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from read_dataset import read

import zest_rl
from zest_rl.agents.rvs import RvSConfig
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate
from zest_rl.report.methods import methods_of_runs
from zest_rl.rewards.given import with_rewards
from zest_rl.runtime import artifacts
from zest_rl.training.loop import TrainingConfig
from zest_rl.training.runs import train


def rising(dataset_id: str) -> list[np.ndarray]:
    return [np.linspace(0, i + 1, n) for i, n in enumerate(read(dataset_id, Dataset.n_steps))]


def test_the_copy_has_the_given_rewards_and_all_else_of_its_source(collected: str) -> None:
    given = with_rewards(collected, rising(collected), "learned")
    assert given.startswith("zest/kitchen-micro-tiny-learned-")
    for ours, source in zip(read(given, Dataset.rewards), rising(collected), strict=True):
        np.testing.assert_allclose(ours, source, rtol=1e-6)
    for ours, theirs in zip(read(given, Dataset.truth), read(collected, Dataset.truth), strict=True):
        np.testing.assert_array_equal(ours.rewards, theirs.rewards)
    assert read(given, Dataset.fingerprint) == read(collected, Dataset.fingerprint)
    assert with_rewards(collected, rising(collected), "learned") == given, "equal rewards are the same dataset"
    assert zest_rl.with_rewards(given, rising(collected), "learned") == given, "whose rewards are replaced, is the same"


def test_scores_do_not_outlive_the_rewards_that_they_were(trained: Path) -> None:
    relabeled = artifacts.read_json(trained / "dt-0" / "meta.json")["dataset"]["id"]
    given = with_rewards(relabeled, rising(relabeled))
    with zest_rl.open_dataset(given) as ds:
        assert ds.record.relabel is None
        assert not any("infos/zest" in group for group in ds.groups.values())


def test_a_policy_is_never_told_the_true_rewards_in_place_of_the_given_ones(collected: str, tmp_path: Path) -> None:
    given = with_rewards(collected, rising(collected), "learned")
    small = RvSConfig(hidden_size=8, n_layers=1)
    run = train("rvs", given, small, TrainingConfig(n_updates=2, device="cpu"), run_dir=tmp_path / "run")
    with pytest.raises(BadInput, match=r"rewards \(learned\) were given as numbers.*--rtg schedule or constant"):
        evaluate(run, EvaluationConfig(n_episodes=1))
    evaluate(run, EvaluationConfig(n_episodes=1, rtg="schedule"), n_workers=1)
    assert [method.name for method in methods_of_runs([run])] == ["RVS on learned"]
    assert "learned, given as numbers for zest/kitchen-micro-tiny-v0" in (run / "README.md").read_text()


def test_rewards_that_do_not_fit_are_refused_with_the_episode(collected: str) -> None:
    rewards = rising(collected)
    with pytest.raises(BadInput, match=r"shape \(100,\) for episode 2, got \(101,\); of T \+ 1 scores"):
        with_rewards(collected, [*rewards[:2], np.zeros(101), rewards[3]])
    with pytest.raises(BadInput, match=r"for episode 3, got None"):
        with_rewards(collected, rewards[:3])
    with pytest.raises(BadInput, match=r"NaN or infinity in episodes \[3\]"):
        with_rewards(collected, [*rewards[:3], np.full(100, np.nan)])
    with pytest.raises(BadInput, match="one word"):
        with_rewards(collected, rewards, "my rewards")
