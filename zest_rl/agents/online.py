"""Policies that learn in the environment: behaviour cloning, frozen, and a small correction that is learned by SAC, PPO
or TRPO (`zest_rl.online`, which leaves the algorithms to stable-baselines3).

The robot is hidden from the scorer, so a reward says nothing before the object moves: exploring from scratch finds
nothing. A dataset shows how the object is reached. The action is ``clip(start(o) + correction · c(o), -1, 1)``, where
``start`` is `bc` on the dataset and c, within [-1, 1], is what is learned: residual reinforcement learning (Johannink
et al. 2019, https://arxiv.org/abs/1812.03201; Silver et al. 2018, https://arxiv.org/abs/1812.06298), which starts as
good as the clone. It takes the place of fine-tuning the clone as in DAPG (Rajeswaran et al. 2018,
https://arxiv.org/abs/1709.10087): here SAC's first critic drew a fine-tuned clone to 0 % within 2,000 steps. SAC also
draws half of every batch from the dataset, and its networks normalise their layers (RLPD, Ball et al. 2023,
https://arxiv.org/abs/2302.02948; two critics instead of ten).

Only what acts is here, so that a policy is loaded and evaluated without stable-baselines3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from zest_rl.agents.base import (
    DataFacts,
    Policy,
    mean_action,
)
from zest_rl.agents.bc import AGENT as CLONING
from zest_rl.agents.bc import BCPolicy
from zest_rl.agents.configs import START, OnlineConfig, PPOConfig, SACConfig, TRPOConfig

# ----------------------------------------------------------------------------------------------------------- model


class NormalizedReLU(nn.Module):
    """ReLU of the units, normalised to mean 0 and variance 1 over the layer: keeps critics from overestimating."""

    def forward(self, units: Tensor) -> Tensor:
        """[batch, width] → [batch, width]."""
        return nn.functional.relu(nn.functional.layer_norm(units, units.shape[-1:]))


class CorrectedPolicy(nn.Module):
    """The mean action: normalised obs [batch, obs_dim] → [batch, act_dim] in [-1, 1]."""

    def __init__(self, start: nn.Module | None, correction: nn.Module, scale: float, *, squashes: bool):
        super().__init__()
        self.start, self.correction = start, correction
        self.scale, self._squash = scale, torch.tanh if squashes else lambda mean: mean.clamp(-1, 1)

    def cloned(self, obs: Tensor) -> Tensor | float:
        """Return what the correction is added to."""
        return 0.0 if self.start is None else mean_action(_predict, self.start, obs)

    def forward(self, obs: Tensor) -> Tensor:
        """Return the action."""
        correction: Tensor = self._squash(self.correction(obs))
        return (self.cloned(obs) + self.scale * correction).clamp(-1, 1)


def _predict(network: nn.Module, obs: Tensor) -> Tensor:
    predicted: Tensor = network(obs)
    return predicted


def build_model(config: OnlineConfig, facts: DataFacts) -> CorrectedPolicy:
    """Return the policy; the correction has the layers of stable-baselines3's actors."""
    layers: list[nn.Module] = []
    for width in [facts.obs_dim, *[config.hidden_size] * (config.n_layers - 1)]:
        layers += [nn.Linear(width, config.hidden_size), NormalizedReLU()]
    correction = nn.Sequential(*layers, nn.Linear(config.hidden_size, facts.act_dim))
    start = None if config.from_scratch else CLONING.networks(START, facts)
    scale = 1.0 if config.from_scratch else config.correction
    return CorrectedPolicy(start, correction, scale, squashes=isinstance(config, SACConfig))


# ------------------------------------------------------------------------------------------------------------- act


class OnlinePolicy(BCPolicy):
    """Acts by the mean of the learned distribution; it has no memory and uses no return."""

    def __init__(self, model: nn.Module, facts: DataFacts, meta: dict[str, Any], device: torch.device):
        super().__init__(model, facts, meta, device)
        self.agent = meta["agent"]


def make_policy(
    model: nn.Module, config: OnlineConfig, facts: DataFacts, meta: dict[str, Any], device: torch.device
) -> Policy:
    """Return the policy of a trained model."""
    return OnlinePolicy(model, facts, meta, device)


@dataclass(frozen=True)
class OnlineAgent:
    """One algorithm as `zest_rl.online` and `zest_rl.agents.load_policy` see it."""

    config: type[OnlineConfig]
    """Frozen dataclass that checks itself."""
    networks: Callable[[Any, DataFacts], nn.Module] = build_model
    """The whole policy with fresh weights."""
    policy: Callable[[nn.Module, Any, DataFacts, dict[str, Any], torch.device], Policy] = make_policy
    """From a trained model (in eval mode, on the device) and the run's meta to a policy."""


SAC, PPO, TRPO = OnlineAgent(SACConfig), OnlineAgent(PPOConfig), OnlineAgent(TRPOConfig)
