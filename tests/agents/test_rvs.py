"""The return-conditioned MLP, and several networks of one algorithm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

from zest_rl.agents import bc, dt, load_policy, rvs
from zest_rl.agents.base import Policy, describe_data, returns_to_go
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.training.loop import TrainingConfig, fit
from zest_rl.types import Episode, FloatArray

SMALL = rvs.RvSConfig(hidden_size=32, n_layers=2, batch_size=64, learning_rate=3e-3, warmup_updates=10)
CONFIGS: dict[str, Any] = {
    "bc": bc.BCConfig(hidden_size=16, n_layers=1, batch_size=8),
    "dt": dt.DTConfig(hidden_size=16, n_layers=1, batch_size=4, context_len=3),
    "rvs": replace(SMALL, batch_size=8),
}


def two_behaviours(n: int = 20) -> list[Episode]:
    """Half of the episodes go right and are rewarded, half go left and are punished; observations tell nothing."""
    episodes = []
    for i in range(n):
        obs = np.random.default_rng(i).normal(size=(9, 3)).astype(np.float32)
        is_right = bool(i % 2)
        actions, rewards = np.full((8, 2), 0.6 if is_right else -0.6), np.full(8, 1.0 if is_right else -0.5)
        episodes.append(Episode(obs, actions.astype(np.float32), rewards.astype(np.float32), terminated=False))
    return episodes


def play(policy: Policy, target: float | None, reward: float = 0.0) -> FloatArray:
    """Actions (5, 8, 2) on observations that depend on the row and the step alone."""
    policy.begin(5, target)
    actions = []
    for step in range(8):
        actions.append(policy.act(np.random.default_rng(step).normal(size=(5, 3)).astype(np.float32)))
        policy.observe(np.full(5, reward, np.float32))
    return np.stack(actions, axis=1)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rvs") / "run"
    return fit("rvs", SMALL, two_behaviours(200), folder, TrainingConfig(n_updates=300, threads=1))


def test_asked_for_a_high_or_a_low_return_it_chooses_the_behaviour_that_earned_it(run: Path) -> None:
    policy = load_policy(run)
    assert policy.uses_return
    high, low = policy.meta["return_quantiles"][-1], policy.meta["return_quantiles"][0]
    right, left = play(policy, high, reward=1.0), play(policy, low, reward=-0.5)
    assert right.min() > 0 > left.max()
    assert (right.mean(), left.mean()) == pytest.approx((0.6, -0.6), abs=0.15)


def test_observed_rewards_are_taken_off_the_return_that_is_asked_for(run: Path) -> None:
    policy = load_policy(run)
    constant, falling = play(policy, 8.0, reward=0.0), play(policy, 8.0, reward=5.0)
    np.testing.assert_array_equal(constant[:, 0], falling[:, 0])
    assert np.abs(constant[:, 1] - falling[:, 1]).max() > 1e-3


def test_without_conditioning_neither_target_nor_rewards_change_anything(tmp_path: Path) -> None:
    config = replace(SMALL, condition_on_return=False)
    policy = load_policy(fit("rvs", config, two_behaviours(), tmp_path / "run", TrainingConfig(n_updates=5)))
    assert not policy.uses_return
    np.testing.assert_array_equal(play(policy, 8.0, reward=1.0), play(policy, None))


def test_it_learns_from_observation_action_and_return_to_go_of_one_step() -> None:
    episodes = two_behaviours()
    facts = describe_data(episodes)
    batch = rvs.make_sampler(SMALL, facts, episodes)(np.random.default_rng(0))
    rows = {
        (*facts.normalize(e.obs[t]).tolist(), float(np.float32(returns_to_go(e.rewards)[t] / np.float32(8.0)))): e
        for e in episodes
        for t in range(len(e))
    }
    for inputs, actions in zip(batch["inputs"].tolist(), batch["actions"].tolist(), strict=True):
        np.testing.assert_array_equal(rows[tuple(inputs)].actions[0], np.float32(actions))


def test_returns_that_are_all_zero_are_refused_only_when_they_condition_the_model() -> None:
    episodes = [Episode(e.obs, e.actions, np.zeros(8, np.float32), terminated=False) for e in two_behaviours()]
    facts = describe_data(episodes)
    with pytest.raises(BadInput, match="needs returns that are not all 0"):
        rvs.make_sampler(SMALL, facts, episodes)
    rvs.make_sampler(replace(SMALL, condition_on_return=False), facts, episodes)


def test_all_problems_of_a_config_are_named_at_once() -> None:
    with pytest.raises(BadInput) as error:
        rvs.RvSConfig(hidden_size=0, n_layers=0, dropout=1.0, batch_size=0, n_networks=0)
    for field in ("hidden_size", "n_layers", "dropout", "batch_size", "n_networks"):
        assert f"{field} must be" in str(error.value)


@pytest.mark.parametrize("agent", CONFIGS)
def test_several_networks_start_apart_and_their_mean_acts(agent: str, tmp_path: Path) -> None:
    config = replace(CONFIGS[agent], n_networks=3, amp="fp32")
    run = fit(agent, config, two_behaviours(), tmp_path / "run", TrainingConfig(n_updates=3, threads=1))
    together = load_policy(run)
    weights = safetensors.torch.load_file(run / "model.safetensors")
    single: list[FloatArray] = []
    for i in range(3):
        alone = tmp_path / str(i)
        alone.mkdir()
        own = {name.partition(".")[2]: value for name, value in weights.items() if name.startswith(f"{i}.")}
        data = safetensors.torch.save(own)
        (alone / "model.safetensors").write_bytes(data)
        meta = artifacts.read_json(run / "meta.json")
        meta["config"]["n_networks"], meta["model_sha256"] = 1, artifacts.hash_bytes(data)
        artifacts.write_json(alone / "meta.json", meta)
        single.append(play(load_policy(alone), 8.0)[:, 0])
    assert np.abs(single[0] - single[1]).max() > 1e-3
    np.testing.assert_allclose(play(together, 8.0)[:, 0], np.mean(single, axis=0), atol=1e-6)


@pytest.mark.parametrize("agent", CONFIGS)
def test_the_first_of_several_networks_is_the_one_that_is_trained_alone(agent: str, tmp_path: Path) -> None:
    config = replace(CONFIGS[agent], dropout=0.0, grad_clip=0.01)  # so small that it always clips

    def weights(name: str, n_networks: int) -> dict[str, torch.Tensor]:
        how = TrainingConfig(n_updates=5, threads=1)
        run = fit(agent, replace(config, n_networks=n_networks), two_behaviours(), tmp_path / name, how)
        return safetensors.torch.load_file(run / "model.safetensors")

    alone, together = weights("alone", 1), weights("together", 3)
    for name, tensor in alone.items():
        assert torch.equal(together[f"0.{name}"], tensor), name


@pytest.mark.parametrize("target", [np.inf, np.nan, None])
def test_a_policy_that_uses_no_returns_acts_the_same_whatever_is_asked_for_or_earned(
    target: float | None, tmp_path: Path
) -> None:
    config = replace(SMALL, condition_on_return=False)
    policy = load_policy(fit("rvs", config, two_behaviours(), tmp_path / "run", TrainingConfig(n_updates=3, threads=1)))
    np.testing.assert_array_equal(play(policy, target, reward=np.inf), play(policy, 8.0))
