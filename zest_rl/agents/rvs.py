"""Return-conditioned MLP: an MLP from observation and return-to-go to the action, mean squared error.

RvS-R of Emmons et al. 2022 (https://arxiv.org/abs/2112.10751: width 1024, 2 hidden layers, batch 16,384, Adam, learning
rate 1e-3, ReLU). It is the network of `bc` with the return-to-go as one more input, and asks for returns as `dt` does.
Deviations:
  - the return-to-go itself, divided by the largest absolute return of the data as in `dt`, not by the steps left;
  - three hidden layers of 512 units, as in `bc`, and 320 transitions per update;
  - AdamW with warm-up and clipped gradients; what acts is a moving average of the weights, as in `bc` and `dt`;
  - observations are normalised with a floor under the deviation and a bound on the result (`base.STD_FLOOR`);
  - tanh at the end and a squared error instead of a Gaussian's likelihood.
``condition_on_return=False`` is the null control: the return-to-go is zero at every step, in training and acting.
"""

from __future__ import annotations

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
    ReturnToGo,
    Sampler,
    autocast,
    check_obs,
    check_returns,
    mean_action,
    mlp,
    returns_to_go,
)
from zest_rl.agents.configs import RvSConfig as RvSConfig
from zest_rl.types import Episode, FloatArray

# ----------------------------------------------------------------------------------------------------------- model


def build_model(config: RvSConfig, facts: DataFacts) -> nn.Module:
    """Return the MLP: [batch, obs_dim + 1] → [batch, act_dim] in [-1, 1]; the last input is the scaled return-to-go."""
    return mlp(facts.obs_dim + 1, config.hidden_size, config.n_layers, facts.act_dim, config.dropout)


def predict_actions(model: nn.Module, inputs: Tensor) -> Tensor:
    """Return the actions [batch, act_dim] float32 for normalised inputs [batch, obs_dim + 1]."""
    predicted: Tensor = model(inputs)
    return predicted.float()


# ----------------------------------------------------------------------------------------------------------- batch


def make_sampler(config: RvSConfig, facts: DataFacts, episodes: Sequence[Episode]) -> Sampler:
    """Return a function that draws transitions; each is equally likely.

    Raises:
        BadInput: all returns are zero although the model is to be conditioned on them.
    """
    if config.condition_on_return:
        check_returns(facts)
    scale = facts.return_scale if config.condition_on_return else np.inf
    obs = torch.from_numpy(facts.normalize(np.concatenate([e.obs[:-1] for e in episodes])))
    rtg = torch.from_numpy(np.concatenate([returns_to_go(e.rewards)[:-1] for e in episodes]) / np.float32(scale))
    inputs = torch.cat([obs, rtg[:, None]], dim=1)
    actions = torch.from_numpy(np.concatenate([e.actions for e in episodes]))

    def sample(rng: np.random.Generator) -> Batch:
        index = torch.from_numpy(rng.integers(len(inputs), size=config.batch_size))
        return {
            "inputs": inputs[index],  # [batch, obs_dim + 1]
            "actions": actions[index],  # [batch, act_dim]
        }

    return sample


# ------------------------------------------------------------------------------------------------------------ loss


def loss(model: nn.Module, batch: Batch) -> Tensor:
    """Return the squared error, averaged over the batch and the action's dimensions."""
    return (predict_actions(model, batch["inputs"]) - batch["actions"]).square().mean()


# ------------------------------------------------------------------------------------------------------------- act


class RvSPolicy:
    """Acts by the MLP on the newest observation and the return that is still asked for."""

    agent = "rvs"

    def __init__(
        self, model: nn.Module, config: RvSConfig, facts: DataFacts, meta: dict[str, Any], device: torch.device
    ):
        self.meta = meta
        self.uses_return = config.condition_on_return
        self._model, self._facts, self._device = model, facts, device
        self._autocast = autocast(meta["precision"], device)
        self._asked = ReturnToGo(facts, self.uses_return)

    def begin(self, n_episodes: int, target_return: float | None = None) -> None:
        """Start N new episodes.

        Raises:
            BadInput: the model is conditioned on returns and `target_return` is not a finite number.
        """
        self._asked.begin(n_episodes, target_return)

    @torch.no_grad()
    def act(self, obs: FloatArray) -> FloatArray:
        """Return actions (N, act_dim) float32 in [-1, 1] for obs (N, obs_dim) float32."""
        check_obs(obs, len(self._asked), self._facts.obs_dim)
        inputs = np.concatenate([self._facts.normalize(obs), self._asked.scaled()[:, None]], axis=1)
        batch = torch.from_numpy(inputs).to(self._device)
        with self._autocast:
            actions = mean_action(predict_actions, self._model, batch)
        return actions.cpu().numpy()

    def observe(self, rewards: FloatArray) -> None:
        """Subtract the rewards (N,) of the last actions from the returns still asked for."""
        self._asked.subtract(rewards)

    def end(self) -> dict[str, NDArray[Any]]:
        """Return nothing; there are no resources to release."""
        return {}


def make_policy(
    model: nn.Module, config: RvSConfig, facts: DataFacts, meta: dict[str, Any], device: torch.device
) -> Policy:
    """Return the policy of a trained model."""
    return RvSPolicy(model, config, facts, meta, device)


AGENT = Agent(config=RvSConfig, build=build_model, sampler=make_sampler, loss=loss, policy=make_policy)
