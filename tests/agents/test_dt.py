"""The Decision Transformer: windows, padding, conditioning, and what its policy promises."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from transformers import DecisionTransformerConfig, DecisionTransformerModel

from zest_rl.agents import dt, load_policy
from zest_rl.agents.base import Policy, autocast, describe_data, ready_to_act, returns_to_go
from zest_rl.embedders import Precision
from zest_rl.errors import BadInput
from zest_rl.training.loop import TrainingConfig, fit
from zest_rl.types import Episode, FloatArray

SMALL = dt.DTConfig(
    context_len=4, hidden_size=32, n_layers=2, batch_size=32, learning_rate=2e-3, warmup_updates=10, dropout=0.0
)


def episode(length: int, seed: int = 0, action: float | None = None, reward: float = 1.0) -> Episode:
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(length + 1, 3)).astype(np.float32)
    actions = rng.uniform(-1, 1, (length, 2)) if action is None else np.full((length, 2), action)
    return Episode(obs, actions.astype(np.float32), np.full(length, reward, np.float32), terminated=False)


def two_behaviours() -> list[Episode]:
    """Half of the episodes go right and are rewarded, half go left and are not; observations tell nothing."""
    return [episode(8, seed=i, action=0.6 if i % 2 else -0.6, reward=1.0 if i % 2 else 0.1) for i in range(20)]


def play(policy: Policy, target: float | None, n: int = 5, steps: int = 8, reward: float = 0.0) -> FloatArray:
    """Actions (n, steps, act_dim) on observations that depend on the row and the step alone."""
    policy.begin(n, target)
    actions = []
    for step in range(steps):
        obs = np.stack([np.random.default_rng([row, step]).normal(size=3) for row in range(n)]).astype(np.float32)
        actions.append(policy.act(obs))
        policy.observe(np.full(n, reward, np.float32))
    return np.stack(actions, axis=1)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dt") / "run"
    return fit("dt", SMALL, two_behaviours(), folder, TrainingConfig(n_updates=200, threads=1))


def test_asked_for_a_high_or_a_low_return_it_chooses_the_behaviour_that_earned_it(run: Path) -> None:
    policy = load_policy(run)
    assert policy.uses_return
    high, low = policy.meta["return_quantiles"][-1], policy.meta["return_quantiles"][0]
    np.testing.assert_allclose(play(policy, high, reward=1.0), 0.6, atol=0.15)
    np.testing.assert_allclose(play(policy, low, reward=0.1), -0.6, atol=0.15)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize(("length", "n_heads"), [(1, 1), (4, 2)])
def test_it_acts_by_the_operations_of_transformers_to_the_bit(precision: Precision, length: int, n_heads: int) -> None:
    facts = describe_data(two_behaviours())
    model = dt.build_model(replace(SMALL, n_heads=n_heads), facts).eval()
    rng = np.random.default_rng(0)
    batch = {
        "obs": torch.from_numpy(rng.normal(size=(5, length, 3)).astype(np.float32)),
        "actions": torch.from_numpy(rng.uniform(-1, 1, (5, length, 2)).astype(np.float32)),
        "rtg": torch.from_numpy(rng.uniform(size=(5, length, 1)).astype(np.float32)),
        "timesteps": torch.arange(length).expand(5, length),
    }
    ready = ready_to_act(copy.deepcopy(model), precision)
    with torch.no_grad(), autocast(precision, torch.device("cpu")):
        expected = dt.predict_actions(model, batch | {"valid": torch.ones(5, length, dtype=torch.bool)})
        assert torch.equal(dt.acted(ready, batch), expected)


def test_without_conditioning_the_target_return_changes_nothing(tmp_path: Path) -> None:
    config = dt.DTConfig(condition_on_return=False, context_len=4, hidden_size=32, n_layers=1, batch_size=32)
    policy = load_policy(fit("dt", config, two_behaviours(), tmp_path / "run", TrainingConfig(n_updates=5)))
    assert not policy.uses_return
    np.testing.assert_array_equal(play(policy, 8.0, reward=1.0), play(policy, None))


def test_observed_rewards_are_taken_off_the_return_that_is_asked_for(run: Path) -> None:
    policy = load_policy(run)
    constant, falling = play(policy, 8.0, reward=0.0), play(policy, 8.0, reward=5.0)
    np.testing.assert_array_equal(constant[:, 0], falling[:, 0])
    assert np.abs(constant[:, 1] - falling[:, 1]).max() > 1e-3


def test_the_actions_of_one_episode_do_not_depend_on_the_others(run: Path) -> None:
    policy = load_policy(run)
    tolerance = 0.02 if policy.meta["precision"] == "bf16" else 1e-5
    np.testing.assert_allclose(play(policy, 8.0, n=1), play(policy, 8.0, n=7)[:1], atol=tolerance)


@pytest.mark.parametrize("timesteps", ["absolute", "relative"])
def test_acting_sees_what_training_sees(tmp_path: Path, timesteps: dt.Timesteps) -> None:
    """Step by step acting predicts what one pass over the same window predicts, at each of 7 steps with K = 4."""
    config = replace(SMALL, timesteps=timesteps)
    folder = fit("dt", config, two_behaviours(), tmp_path / "run", TrainingConfig(n_updates=20, threads=1))
    policy = load_policy(folder)
    actions = play(policy, 8.0, n=2, steps=7, reward=1.0)
    facts = describe_data(two_behaviours())
    obs = np.stack([[np.random.default_rng([row, step]).normal(size=3) for step in range(7)] for row in range(2)])
    model = dt.build_model(config, facts).eval()
    model.load_state_dict(safetensors.torch.load_file(folder / "model.safetensors"))
    for step in range(7):
        first = max(0, step - 3)
        window, n = slice(first, step + 1), step + 1 - first
        timestep = torch.arange(n) + (first if timesteps == "absolute" else 0)
        batch = {
            "obs": torch.from_numpy(facts.normalize(obs[:, window].astype(np.float32))),
            "actions": torch.from_numpy(actions[:, window]),
            "rtg": (8.0 - torch.arange(first, step + 1.0))[None, :, None].expand(2, n, 1) / facts.return_scale,
            "timesteps": timestep.expand(2, n),
            "valid": torch.ones(2, n, dtype=torch.bool),
        }
        with torch.no_grad():
            expected = dt.predict_actions(model, batch)[:, -1].numpy()
        np.testing.assert_allclose(
            actions[:, step], expected, atol=0.02 if policy.meta["precision"] == "bf16" else 1e-5
        )


def test_relative_timesteps_count_from_the_window_and_know_no_longest_episode(tmp_path: Path) -> None:
    config = replace(SMALL, timesteps="relative")
    episodes = [episode(n, seed=n) for n in (2, 9)]
    batch = dt.make_sampler(config, describe_data(episodes), episodes)(np.random.default_rng(0))
    for valid, timesteps in zip(batch["valid"], batch["timesteps"], strict=True):
        assert timesteps[valid].tolist() == list(range(int(valid.sum())))
        assert not timesteps[~valid].any()
    policy = load_policy(fit("dt", config, episodes, tmp_path / "run", TrainingConfig(n_updates=1, threads=1)))
    assert np.isfinite(play(policy, 1.0, steps=30)).all()


def test_what_stands_in_the_padding_changes_neither_the_loss_nor_its_gradient() -> None:
    episodes = [episode(2, seed=1), episode(7, seed=2)]
    facts = describe_data(episodes)
    batch = dt.make_sampler(SMALL, facts, episodes)(np.random.default_rng(0))
    padding = ~batch["valid"]
    assert padding.any()
    other = dict(batch)
    for name, rubbish in (("obs", 1e3), ("actions", -10.0), ("rtg", 77.0), ("timesteps", 0)):
        other[name] = batch[name].clone()
        other[name][padding] = rubbish
    torch.manual_seed(0)
    model = dt.build_model(SMALL, facts)
    results = []
    for content in (batch, other):
        model.zero_grad()
        value = dt.loss(model, content)
        value.backward()  # type: ignore[no-untyped-call]
        results.append((value.item(), [p.grad.clone() for p in model.parameters() if p.grad is not None]))
    assert results[0][0] == pytest.approx(results[1][0], rel=1e-6)
    for one, two in zip(results[0][1], results[1][1], strict=True):
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-6)


def test_windows_hold_consecutive_steps_of_one_episode_and_are_padded_on_the_left() -> None:
    episodes = [episode(n, seed=n) for n in (1, 3, 9)]
    facts = describe_data(episodes)
    batch = dt.make_sampler(dt.DTConfig(context_len=4, batch_size=300), facts, episodes)(np.random.default_rng(0))
    starts = set()
    for i in range(300):
        valid = batch["valid"][i].numpy()
        n = int(valid.sum())
        np.testing.assert_array_equal(valid, [False] * (4 - n) + [True] * n)
        steps = batch["timesteps"][i, 4 - n :].numpy()
        np.testing.assert_array_equal(steps, steps[0] + np.arange(n))
        source = next(e for e in episodes if np.any(np.all(e.actions == batch["actions"][i, -1].numpy(), axis=1)))
        assert n == min(4, len(source) - steps[0])
        np.testing.assert_array_equal(batch["actions"][i, 4 - n :], source.actions[steps])
        np.testing.assert_array_equal(batch["obs"][i, 4 - n :], facts.normalize(source.obs[steps]))
        scaled = returns_to_go(source.rewards)[steps] / facts.return_scale
        np.testing.assert_allclose(batch["rtg"][i, 4 - n :, 0], scaled, rtol=1e-6)
        starts.add((len(source), int(steps[0])))
    assert starts == {(len(e), t) for e in episodes for t in range(len(e))}


def test_return_to_go_is_the_sum_of_the_rewards_still_to_come() -> None:
    rewards = np.array([1.0, -2.0, 4.0], np.float32)
    np.testing.assert_array_equal(returns_to_go(rewards), [3.0, 2.0, 4.0, 0.0])


def test_cheap_dropout_keeps_the_right_share_and_the_mean() -> None:
    torch.manual_seed(0)
    layer = dt.CheapDropout(0.1).train()
    x = torch.ones(3, 7, 50_001)
    out = layer(x)
    assert float((out == 0).float().mean()) == pytest.approx(0.1, abs=1e-3)
    assert float(out.mean()) == pytest.approx(1.0, abs=2e-3)
    assert out.unique().tolist() == pytest.approx([0.0, 1 / 0.9])
    neighbours = ((out[..., 1:] == 0) & (out[..., :-1] == 0)).float().mean()
    assert float(neighbours) == pytest.approx(0.01, abs=5e-4)  # four masks from one random number are independent
    torch.testing.assert_close(layer.eval()(x), x)


def test_a_runs_weights_load_into_the_plain_transformers_model(run: Path) -> None:
    config = DecisionTransformerConfig(
        state_dim=3, act_dim=2, hidden_size=32, max_ep_len=8, n_positions=12, n_layer=2, bos_token_id=None,
        eos_token_id=None,
    )  # fmt: skip
    DecisionTransformerModel(config).load_state_dict(safetensors.torch.load_file(run / "model.safetensors"))
    assert len(safetensors.torch.load_file(run / "model.safetensors")) == len(
        DecisionTransformerModel(config).state_dict()
    )


def test_returns_that_are_all_zero_are_refused_only_when_they_condition_the_model() -> None:
    silent = [episode(5, reward=0.0)]
    facts = describe_data(silent)
    with pytest.raises(BadInput, match="not all 0"):
        dt.make_sampler(SMALL, facts, silent)
    batch = dt.make_sampler(dt.DTConfig(condition_on_return=False), facts, silent)(np.random.default_rng(0))
    assert not batch["rtg"].any()


def test_a_policy_says_what_it_cannot_do(run: Path) -> None:
    policy = load_policy(run)
    with pytest.raises(BadInput, match="call begin"):
        policy.act(np.zeros((1, 3), np.float32))
    with pytest.raises(BadInput, match="finite return, got None"):
        policy.begin(2)
    with pytest.raises(BadInput, match="horizon of at most 8"):
        play(policy, 1.0, steps=9)


def test_all_problems_of_a_config_are_named_at_once() -> None:
    with pytest.raises(BadInput, match=r"context_len must be 1 to 2048, got 0; n_heads must be a divisor"):
        dt.DTConfig(context_len=0, n_heads=3)
