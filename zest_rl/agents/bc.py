"""Behaviour cloning: an MLP from the observation to the action, mean squared error.

The baseline of Chen et al. 2021 (https://arxiv.org/abs/2106.01345; ``gym/decision_transformer/models/mlp_bc.py`` of
https://github.com/kzl/decision-transformer at 5605e40): linear, ReLU and dropout, three hidden layers, tanh.
Deviations from it:
  - one observation instead of the last K: a plain Markov policy;
  - hidden size 512, which gives about as many parameters as `dt.DTConfig` has (0.56 and 0.63 million for the kitchen);
  - 1280 transitions per update, as many as the Decision Transformer's 64 windows of 20;
  - learning rate, warm-up, averaged weights and observation normaliser are those of `dt`.
``top_fraction`` below 1 is the "%BC" of that paper: only the episodes with the largest returns are cloned (a share of
the episodes here, of the time steps there). The normaliser is still measured on all episodes, so that it is the same
for every fraction and every agent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from zest_rl.agents.base import (
    Agent,
    Batch,
    DataFacts,
    Policy,
    Sampler,
    autocast,
    check_obs,
    mean_action,
    mlp,
)
from zest_rl.agents.configs import BCConfig as BCConfig
from zest_rl.types import Episode, FloatArray

# ----------------------------------------------------------------------------------------------------------- model


def build_model(config: BCConfig, facts: DataFacts) -> nn.Module:
    """Return the MLP: [batch, obs_dim] → [batch, act_dim] in [-1, 1]."""
    return mlp(facts.obs_dim, config.hidden_size, config.n_layers, facts.act_dim, config.dropout)


def predict_actions(model: nn.Module, obs: Tensor) -> Tensor:
    """Return the actions [batch, act_dim] float32 for normalised obs [batch, obs_dim]."""
    predicted: Tensor = model(obs)
    return predicted.float()


# ----------------------------------------------------------------------------------------------------------- batch


def make_sampler(config: BCConfig, facts: DataFacts, episodes: Sequence[Episode]) -> Sampler:
    """Return a function that draws transitions uniformly from the steps of the kept episodes."""
    if config.top_fraction < 1:
        n_kept = math.ceil(config.top_fraction * len(episodes))
        returns = np.array([e.rewards.sum(dtype=np.float64) for e in episodes])
        episodes = [episodes[i] for i in np.argsort(-returns, kind="stable")[:n_kept]]
    obs = torch.from_numpy(facts.normalize(np.concatenate([e.obs[:-1] for e in episodes])))
    actions = torch.from_numpy(np.concatenate([e.actions for e in episodes]))

    def sample(rng: np.random.Generator) -> Batch:
        index = torch.from_numpy(rng.integers(len(obs), size=config.batch_size))
        return {
            "obs": obs[index],  # [batch, obs_dim]
            "actions": actions[index],  # [batch, act_dim]
        }

    return sample


# ------------------------------------------------------------------------------------------------------------ loss


def loss(model: nn.Module, batch: Batch) -> Tensor:
    """Return the squared error, averaged over the batch and the action's dimensions."""
    return (predict_actions(model, batch["obs"]) - batch["actions"]).square().mean()


# ------------------------------------------------------------------------------------------------------------- act


class BCPolicy:
    """Acts by the MLP; it has no memory and uses no return."""

    agent = "bc"
    uses_return = False

    def __init__(self, model: nn.Module, facts: DataFacts, meta: dict[str, Any], device: torch.device):
        self.meta = meta
        self._model, self._facts, self._device = model, facts, device
        self._autocast = autocast(meta["precision"], device)
        self._n_episodes = 0

    def begin(self, n_episodes: int, target_return: float | None = None) -> None:
        """Start N episodes; the target return is not used."""
        self._n_episodes = n_episodes

    @torch.no_grad()
    def act(self, obs: FloatArray) -> FloatArray:
        """Return actions (N, act_dim) float32 in [-1, 1] for obs (N, obs_dim) float32."""
        check_obs(obs, self._n_episodes, self._facts.obs_dim)
        normalized = torch.from_numpy(self._facts.normalize(obs)).to(self._device)
        with self._autocast:
            actions = mean_action(predict_actions, self._model, normalized)
        return actions.cpu().numpy()

    def observe(self, rewards: FloatArray) -> None:
        """Ignore the rewards."""

    def end(self) -> dict[str, NDArray[Any]]:
        """Return nothing; there are no resources to release."""
        return {}


def make_policy(
    model: nn.Module, config: BCConfig, facts: DataFacts, meta: dict[str, Any], device: torch.device
) -> Policy:
    """Return the policy of a trained model."""
    return BCPolicy(model, facts, meta, device)


AGENT = Agent(config=BCConfig, build=build_model, sampler=make_sampler, loss=loss, policy=make_policy)
