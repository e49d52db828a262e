"""SAC, PPO and TRPO of stable-baselines3 and sb3-contrib, set up for a dataset."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sb3_contrib import TRPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import nn

from zest_rl.agents.configs import OnlineConfig, OnPolicyConfig, SACConfig, TRPOConfig
from zest_rl.agents.online import NormalizedReLU

EXPLORED = 1000
"""Random steps before SAC learns from scratch."""


class SymmetricReplay(ReplayBuffer):
    """New steps, beside which every batch holds as many recorded ones (RLPD)."""

    def __init__(self, *args: Any, recorded: ReplayBufferSamples, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._recorded = ReplayBufferSamples(*(tensor.to(self.device) for tensor in recorded[:5]))

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw half of a batch from each."""
        rows = np.random.randint(len(self._recorded.rewards), size=batch_size // 2)  # noqa: NPY002  (as in the base)
        new = super().sample(batch_size - len(rows), env)
        return ReplayBufferSamples(*(torch.cat([a[rows], b]) for a, b in zip(self._recorded[:5], new[:5], strict=True)))


def build(
    config: OnlineConfig, venv: VecEnv, recorded: ReplayBufferSamples | None, *, seed: int, device: torch.device
) -> BaseAlgorithm:
    """Return an untrained algorithm; `recorded` are the steps of the dataset, None: SAC replays new ones alone."""
    shared: dict[str, Any] = {
        "learning_rate": config.learning_rate,
        "gamma": config.gamma,
        "batch_size": config.batch_size,
        "seed": seed,
        "device": device,
    }
    networks = {"net_arch": [config.hidden_size] * config.n_layers, "activation_fn": NormalizedReLU}
    match config:
        case SACConfig():
            buffer = {} if recorded is None else {"recorded": recorded}
            model = SAC(
                "MlpPolicy",
                venv,
                buffer_size=config.n_steps + config.n_envs,
                learning_starts=EXPLORED if recorded is None else 0,
                gradient_steps=config.updates_per_step * config.n_envs,
                ent_coef="auto_0.01",
                target_entropy=-config.entropy * float(np.prod(venv.action_space.shape or 1)),
                replay_buffer_class=ReplayBuffer if recorded is None else SymmetricReplay,
                replay_buffer_kwargs=buffer,
                policy_kwargs=networks,
                **shared,
            )
            if recorded is not None:
                mean, log_std = model.actor.mu, model.actor.log_std
                assert isinstance(mean, nn.Linear)
                assert isinstance(log_std, nn.Linear)
                nn.init.orthogonal_(mean.weight, 0.01)  # a small correction at first, as PPO's and TRPO's
                nn.init.zeros_(log_std.weight)
                nn.init.constant_(log_std.bias, -1.0)
            return model
        case OnPolicyConfig():
            shared |= {
                "n_steps": config.rollout // config.n_envs,
                "policy_kwargs": {**networks, "log_std_init": config.log_std},
            }
            if isinstance(config, TRPOConfig):
                return TRPO("MlpPolicy", venv, target_kl=config.target_kl, **shared)
            return PPO("MlpPolicy", venv, **shared)
    raise AssertionError(config)


def mean_network(model: BaseAlgorithm) -> nn.Sequential:
    """Return the layers from the observation to the mean of the action's distribution, before it is squashed."""
    if isinstance(model, SAC):
        return nn.Sequential(*model.actor.latent_pi, model.actor.mu)
    policy: Any = model.policy
    return nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net)
