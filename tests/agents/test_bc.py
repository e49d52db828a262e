"""Behaviour cloning: what it clones, and what its policy promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from zest_rl.agents import bc, dt, load_policy
from zest_rl.agents.base import describe_data
from zest_rl.errors import BadInput, ZestError
from zest_rl.training.loop import TrainingConfig, fit
from zest_rl.types import Episode

SMALL = bc.BCConfig(hidden_size=32, n_layers=2, batch_size=64, learning_rate=3e-3, warmup_updates=10, dropout=0.0)


def linear_episodes(n: int = 6, gain: float = 0.5) -> list[Episode]:
    """The action is a gain times the observation."""
    rng = np.random.default_rng(0)
    episodes = []
    for i in range(n):
        obs = rng.uniform(-1, 1, (11, 2)).astype(np.float32)
        episodes.append(Episode(obs, gain * obs[:-1], np.full(10, i, dtype=np.float32), terminated=False))
    return episodes


def test_it_learns_the_action_of_the_data(tmp_path: Path) -> None:
    run = fit("bc", SMALL, linear_episodes(), tmp_path / "run", TrainingConfig(n_updates=400, threads=1))
    policy = load_policy(run)
    policy.begin(20)
    obs = np.random.default_rng(1).uniform(-0.9, 0.9, (20, 2)).astype(np.float32)
    actions = policy.act(obs)
    assert actions.shape == (20, 2)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, 0.5 * obs, atol=0.08)


def test_a_top_fraction_clones_only_the_episodes_with_the_largest_returns() -> None:
    episodes = linear_episodes(n=10)
    config = bc.BCConfig(top_fraction=0.25, batch_size=500)
    batch = bc.make_sampler(config, describe_data(episodes), episodes)(np.random.default_rng(0))
    kept = {tuple(action) for e in episodes[-3:] for action in e.actions.tolist()}  # a quarter of 10, rounded up
    assert {tuple(action) for action in batch["actions"].tolist()} == kept


def test_without_a_top_fraction_rewards_change_nothing() -> None:
    episodes = linear_episodes()
    other = [Episode(e.obs, e.actions, -7 * e.rewards, e.terminated) for e in episodes]
    first, second = (
        bc.make_sampler(SMALL, describe_data(data), data)(np.random.default_rng(0)) for data in (episodes, other)
    )
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_the_loss_is_the_mean_squared_error() -> None:
    facts = describe_data(linear_episodes())
    model = bc.build_model(SMALL, facts).eval()
    batch = {"obs": torch.randn(5, 2), "actions": torch.rand(5, 2)}
    with torch.no_grad():
        errors = [(model(o) - a).tolist() for o, a in zip(batch["obs"], batch["actions"], strict=True)]
        value = float(bc.loss(model, batch))
    assert value == pytest.approx(sum(x**2 + y**2 for x, y in errors) / 10, rel=1e-5)


def test_it_has_about_as_many_parameters_as_the_decision_transformer() -> None:
    rng = np.random.default_rng(0)
    obs, actions = rng.normal(size=(101, 59)), rng.uniform(-1, 1, (100, 9))
    kitchen = Episode(obs.astype(np.float32), actions.astype(np.float32), np.ones(100, np.float32), terminated=False)
    facts = describe_data([kitchen])
    n_bc, n_dt = (
        sum(p.numel() for p in model.parameters() if p.requires_grad)
        for model in (bc.build_model(bc.BCConfig(), facts), dt.build_model(dt.DTConfig(), facts))
    )
    assert n_bc == pytest.approx(n_dt, rel=0.15)
    config = dt.DTConfig()
    assert bc.BCConfig().batch_size == config.batch_size * config.context_len


def test_all_problems_of_a_config_are_named_at_once() -> None:
    with pytest.raises(BadInput) as error:
        bc.BCConfig(top_fraction=0, hidden_size=0, dropout=1.0, learning_rate=float("nan"), amp="half")  # type: ignore[arg-type]
    for field in ("top_fraction", "hidden_size", "dropout", "learning_rate", "amp"):
        assert f"{field} must be" in str(error.value)


def test_a_policy_refuses_observations_that_do_not_fit(tmp_path: Path) -> None:
    policy = load_policy(fit("bc", SMALL, linear_episodes(), tmp_path / "run", TrainingConfig(n_updates=1)))
    with pytest.raises(BadInput, match="call begin"):
        policy.act(np.zeros((3, 2), np.float32))
    policy.begin(3)
    with pytest.raises(BadInput, match=r"must have shape \(3, 2\), got \(2, 2\)"):
        policy.act(np.zeros((2, 2), np.float32))
    with pytest.raises(BadInput, match="finite"):
        policy.act(np.full((3, 2), np.nan, np.float32))


def test_weights_with_a_flipped_bit_are_not_loaded(tmp_path: Path) -> None:
    run = fit("bc", SMALL, linear_episodes(), tmp_path / "run", TrainingConfig(n_updates=1))
    path = run / "model.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(ZestError, match="is damaged"):
        load_policy(run)
