"""T-REX: the loss, what is held out, and the reward that a run holds."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from zest_rl.agents import load_policy, trex
from zest_rl.agents.base import describe_data, mlp
from zest_rl.errors import BadInput
from zest_rl.rewards.learned import LearnedReward
from zest_rl.runtime import artifacts
from zest_rl.training.loop import TrainingConfig, fit
from zest_rl.types import Episode, FloatArray

SMALL = trex.TREXConfig(snippet_len=8, n_layers=1, hidden_size=16, weight_decay=0.01, warmup_updates=10)


def walks(n: int = 30, *, seed: int = 0, shuffle: bool = False) -> list[Episode]:
    """Random walks in three dimensions, rewarded by how far they are along the second one."""
    rng = np.random.default_rng(seed)
    obs = rng.normal(0, 0.3, (n, 21, 3)).cumsum(axis=1).astype(np.float32)
    rewards = obs[:, 1:, 1]
    donors = rng.permutation(n) if shuffle else range(n)
    actions = np.zeros((20, 2), np.float32)
    return [Episode(obs[i], actions, rewards[donor], terminated=False) for i, donor in enumerate(donors)]


def train(run_dir: Path, episodes: list[Episode], config: trex.TREXConfig = SMALL, n_updates: int = 200) -> Path:
    return fit("trex", config, episodes, run_dir, TrainingConfig(n_updates=n_updates, device="cpu", threads=1))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("trex") / "run", walks())


def agreement(reward: LearnedReward, episodes: list[Episode]) -> float:
    """Share of the pairs of new walks that the reward ranks by how far they went."""
    learned = np.array([reward.of_obs(e.obs[1:]).sum() for e in episodes])
    true = np.array([e.obs[1:, 1].sum() for e in episodes])
    first, second = np.triu_indices(len(episodes), 1)
    return float(((learned[first] - learned[second]) * (true[first] - true[second]) > 0).mean())


@given(st.integers(1, 5), st.integers(1, 6), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_the_loss_is_that_of_a_naive_loop(n_pairs: int, length: int, width: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    model = mlp(width, 8, 2, 1, 0.0)
    batch = {name: torch.randn(n_pairs, length, width, generator=generator) for name in ("worse", "better")}
    total = 0.0
    for worse, better in zip(batch["worse"], batch["better"], strict=True):
        returns = [sum(model(obs).item() for obs in part) for part in (worse, better)]
        total -= math.log(math.exp(returns[1]) / (math.exp(returns[0]) + math.exp(returns[1])))
    assert trex.loss(model, batch).item() == pytest.approx(total / n_pairs, rel=1e-4, abs=1e-6)


def test_the_reward_finds_what_the_ranking_goes_by(run: Path) -> None:
    assert agreement(LearnedReward.load(run), walks(seed=1)) > 0.9


def test_the_reward_of_shuffled_rankings_is_at_chance(tmp_path: Path) -> None:
    rewards = [
        LearnedReward.load(train(tmp_path / f"{seed}", walks(seed=seed, shuffle=True), n_updates=60))
        for seed in range(4)
    ]
    found = [agreement(reward, walks(60, seed=9)) for reward in rewards]
    assert abs(np.mean(found) - 0.5) < 0.25, found
    held_out = [reward.meta["held_out"]["held_out_accuracy"] for reward in rewards]
    assert np.mean(held_out) < 0.75, held_out


def test_a_reward_is_what_the_trained_networks_say(run: Path) -> None:
    reward, obs = LearnedReward.load(run), walks(1, seed=2)[0].obs
    facts, generator = describe_data(walks()), torch.random.get_rng_state()
    model = trex.AGENT.networks(SMALL, facts)
    torch.random.set_rng_state(generator)
    from safetensors.torch import load_file

    model.load_state_dict(load_file(run / "model.safetensors"))
    assert isinstance(model, nn.ModuleList)
    with torch.no_grad():
        each = np.stack([network(torch.from_numpy(facts.normalize(obs)))[:, 0].numpy() for network in model])
    np.testing.assert_allclose(reward.by_network(obs), each, atol=1e-5)
    np.testing.assert_allclose(reward.of_obs(obs), each.mean(axis=0), atol=1e-5)
    assert reward.of_obs(obs).dtype == np.float32


def test_the_kept_weights_are_those_of_the_smallest_loss_on_held_out_trajectories(run: Path) -> None:
    meta = artifacts.read_json(run / "meta.json")
    rows = [line.split(",") for line in (run / "metrics.csv").read_text().splitlines()]
    column = rows[0].index("held_out_loss")
    best = min(rows[1:], key=lambda row: float(row[column]))
    assert meta["held_out"]["update"] == int(best[0])
    assert meta["held_out"]["held_out_loss"] == float(best[column])
    trained, held_out = trex.split(SMALL, walks())
    assert (len(trained), len(held_out)) == (24, 6)
    ranks = sorted(e.rewards.sum() for e in walks())
    assert [ranks.index(r) for r in sorted(e.rewards.sum() for e in held_out)] == [2, 7, 12, 17, 22, 27]


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        (walks(1), r"at least 2 trajectories that rank differently, but the 1 of this dataset have the same return"),
        ([*walks(1), *walks(1)], r"but the 2 of this dataset have the same return; relabel it with a goal"),
        (walks(3), r"to train on and 2 to hold out, but got 1 and 2 of 3 returns in all; collect more"),
    ],
)
def test_trajectories_that_cannot_be_ranked_are_refused(episodes: list[Episode], message: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=message):
        train(tmp_path / "run", episodes)


def test_what_is_no_reward_or_no_input_of_it_is_refused(run: Path, tmp_path: Path) -> None:
    reward, obs = LearnedReward.load(run), walks(1)[0].obs
    with pytest.raises(BadInput, match=r"trained on obs of 3 numbers, got shape \(21, 2\); it is of another"):
        reward.of_obs(obs[:, :2])
    with pytest.raises(BadInput, match="must be finite, got NaN"):
        reward.of_obs(np.full_like(obs, np.nan))
    with pytest.raises(BadInput, match="of observations, not of embeddings"):
        reward.of_embeddings(obs[:, None])
    with pytest.raises(BadInput, match="holds a reward, not a policy"):
        load_policy(run)
    with pytest.raises(BadInput, match="holds no learned reward; give the folder of a finished `zest train trex`"):
        LearnedReward.load(tmp_path)


def test_a_config_out_of_range_is_refused() -> None:
    wrong: dict[str, Any] = {"inputs": "pixels", "held_out": 1.0, "snippet_len": 0}
    with pytest.raises(BadInput, match=r"inputs must be one of obs, embeddings.*snippet_len must be.*held_out must be"):
        trex.TREXConfig(**wrong)


def test_a_trajectory_shorter_than_a_part_is_compared_whole(tmp_path: Path) -> None:
    def cut(episode: Episode) -> Episode:
        short: FloatArray = episode.obs[:6]
        return Episode(short, episode.actions[:5], episode.rewards[:5], terminated=False)

    episodes = walks(8)
    sample = trex.make_sampler(SMALL, describe_data(episodes), [cut(episodes[0]), *episodes[1:]])
    assert sample(np.random.default_rng(0))["worse"].shape == (16, 5, 3)
