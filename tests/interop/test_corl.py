"""CORL and whatever else reads D4RL's flat arrays, through the package d4rl itself.

CORL's scripts cannot be installed. They read in two ways (tinkoff-ai/CORL, algorithms/offline): td3_bc.py @ 2b19dd1,
iql.py, cql.py and others take ``d4rl.qlearning_dataset(env)`` as it is into their `ReplayBuffer`; dt.py @ 2c308c8 takes
``env.get_dataset()`` apart after each row with a terminal or a timeout.
"""

from __future__ import annotations

import copy
from pathlib import Path

import d4rl
import gym
import numpy as np
import pytest
import torch
from conftest import Recorded, flat
from d4rl.offline_env import OfflineEnv
from torch import nn


@pytest.fixture
def env(exports: Path, recorded: list[Recorded]) -> OfflineEnv:
    """d4rl's own base class, which reads the file, of an environment with our spaces."""
    env = OfflineEnv()
    env.observation_space = gym.spaces.Box(-np.inf, np.inf, recorded[0].obs.shape[1:])
    env.action_space = gym.spaces.Box(-1, 1, recorded[0].actions.shape[1:])
    return env


def test_d4rl_reads_the_dataset_s_arrays(env: OfflineEnv, exports: Path, recorded: list[Recorded]) -> None:
    arrays = env.get_dataset(h5path=str(exports / "d4rl"))
    own = {
        "observations": np.concatenate([one.obs[:-1] for one in recorded]),
        "next_observations": np.concatenate([one.obs[1:] for one in recorded]),
        "actions": flat(recorded, "actions"),
        "rewards": flat(recorded, "rewards"),
        "terminals": flat(recorded, "terminated"),
        "timeouts": flat(recorded, "truncated"),
        "zest_score": np.concatenate([one.scores[1:] for one in recorded]),
        "gt_reward": flat(recorded, "gt_rewards"),
        "gt_episode_success": np.concatenate([np.full(len(one), one.success) for one in recorded]),
        "episode": np.repeat(np.arange(len(recorded)), [len(one) for one in recorded]),
    }
    assert set(arrays) == set(own)
    for name, values in own.items():
        np.testing.assert_array_equal(arrays[name], values, err_msg=name)


def test_transitions_are_the_dataset_s_but_for_the_last_before_a_time_limit(
    env: OfflineEnv, exports: Path, recorded: list[Recorded]
) -> None:
    found = d4rl.qlearning_dataset(env, h5path=str(exports / "d4rl"))
    kept = np.concatenate([np.arange(len(one)) < len(one) - int(one.truncated[-1]) for one in recorded])
    for name, values in (
        ("observations", np.concatenate([one.obs[:-1] for one in recorded])),
        ("actions", flat(recorded, "actions")),
        ("rewards", flat(recorded, "rewards")),
        ("terminals", flat(recorded, "terminated")),
    ):
        np.testing.assert_array_equal(found[name], values[kept], err_msg=name)
    goes_on = ~found["terminals"]  # after a terminal row d4rl takes the next episode's start, which no target uses
    own = np.concatenate([one.obs[1:] for one in recorded])[kept]
    np.testing.assert_array_equal(found["next_observations"][goes_on], own[goes_on])


def test_rows_with_an_end_part_the_trajectories(env: OfflineEnv, exports: Path, recorded: list[Recorded]) -> None:
    arrays = env.get_dataset(h5path=str(exports / "d4rl"))
    ends = np.flatnonzero(arrays["terminals"] | arrays["timeouts"]) + 1
    assert ends[-1] == len(arrays["rewards"]), "rows after the last end would be lost"
    for name, field in (("actions", "actions"), ("rewards", "rewards")):
        parts = np.split(arrays[name], ends[:-1])
        for part, one in zip(parts, recorded, strict=True):
            np.testing.assert_array_equal(part, getattr(one, field))


def mlp(n_in: int, n_out: int, *last: nn.Module) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_in, 64), nn.ReLU(), nn.Linear(64, n_out), *last)


def test_td3_bc_trains(env: OfflineEnv, exports: Path) -> None:
    """Fujimoto and Gu (2021), eq. 3 to 5, with one critic instead of two and no noise on the target's action."""
    torch.manual_seed(0)
    found = d4rl.qlearning_dataset(env, h5path=str(exports / "d4rl"))
    data = {name: torch.as_tensor(values, dtype=torch.float32) for name, values in found.items()}
    mean, std = data["observations"].mean(0), data["observations"].std(0) + 1e-3
    obs, after = (data["observations"] - mean) / std, (data["next_observations"] - mean) / std
    actions = data["actions"]
    actor, critic = mlp(obs.shape[1], actions.shape[1], nn.Tanh()), mlp(obs.shape[1] + actions.shape[1], 1)
    actor_optimizer = torch.optim.Adam(actor.parameters(), lr=1e-3)
    critic_optimizer = torch.optim.Adam(critic.parameters(), lr=1e-3)
    actor_target, critic_target = copy.deepcopy(actor), copy.deepcopy(critic)
    history = []
    for _ in range(300):
        rows = torch.randint(len(obs), (64,))
        with torch.no_grad():
            following = critic_target(torch.cat([after[rows], actor_target(after[rows])], 1))[:, 0]
            target = data["rewards"][rows] + 0.99 * (1 - data["terminals"][rows]) * following
        critic_loss = nn.functional.mse_loss(critic(torch.cat([obs[rows], actions[rows]], 1))[:, 0], target)
        critic_optimizer.zero_grad()
        critic_loss.backward()
        critic_optimizer.step()
        chosen = actor(obs[rows])
        q = critic(torch.cat([obs[rows], chosen], 1))
        actor_loss = nn.functional.mse_loss(chosen, actions[rows]) - 2.5 * q.mean() / q.abs().mean().detach()
        actor_optimizer.zero_grad()
        actor_loss.backward()
        actor_optimizer.step()
        with torch.no_grad():
            for target_of, net in ((actor_target, actor), (critic_target, critic)):
                for slow, fast in zip(target_of.parameters(), net.parameters(), strict=True):
                    slow.lerp_(fast, 0.005)
        history.append([critic_loss.item(), actor_loss.item()])
    assert np.isfinite(history).all()
    first, last = np.mean(history[:30], axis=0), np.mean(history[-30:], axis=0)
    assert (last < first).all(), f"critic and actor: {first} → {last}"
