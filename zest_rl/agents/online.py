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
    LARGEST_BATCH,
    LARGEST_WIDTH,
    DataFacts,
    Policy,
    Rules,
    check_fields,
    few_weights,
    mean_action,
    whole,
)
from zest_rl.agents.bc import AGENT as CLONING
from zest_rl.agents.bc import BCConfig, BCPolicy

START = BCConfig(hidden_size=256, dropout=0.0, batch_size=320, learning_rate=1e-3, n_networks=2)
"""The behaviour cloning that a policy starts from."""
LARGEST_COUNT = 10**9

# ---------------------------------------------------------------------------------------------------------- config


@dataclass(frozen=True, kw_only=True)
class OnlineConfig:
    """What the algorithms share."""

    n_steps: int = 10_000
    """Steps in the environment, of all its copies together."""
    reward: str = "own"
    """own: what made the dataset's rewards, its scorer or its environment; truth: its environment's, which is what the
    dataset had before it was relabeled; trex: what T-REX learns from the dataset first; or a folder of `zest train
    trex`."""
    from_scratch: bool = False
    """Learn the whole action from nothing, and use the dataset for its environment, scorer and scales alone."""
    start_updates: int = 1500
    """Gradient steps of the behaviour cloning to start from."""
    correction: float = 0.3
    """Largest correction of the cloned action, in units of the action."""
    hidden_size: int = 128
    """Units per hidden layer, of actor and critics."""
    n_layers: int = 2
    """Hidden layers."""
    learning_rate: float = 1e-3
    """Adam's step size."""
    gamma: float = 0.97
    """Discount per step."""
    batch_size: int = 256
    """Transitions per gradient step."""
    n_envs: int = 4
    """Copies of the environment, stepped together."""
    subprocesses: bool = False
    """Run each copy in a process of its own: for many cores, or slow environments."""

    def __post_init__(self) -> None:
        check_fields(type(self).__name__, self, self.rules())

    def rules(self) -> Rules:
        """Return the rules of the fields."""
        return {
            "n_steps": whole(self.n_steps, LARGEST_COUNT),
            "start_updates": whole(self.start_updates, LARGEST_COUNT),
            "correction": (0 < self.correction <= 2, "in (0, 2]"),
            "hidden_size": whole(self.hidden_size, LARGEST_WIDTH),
            "n_layers": few_weights(self.n_layers, self.hidden_size**2, 1),
            "learning_rate": (0 < self.learning_rate < float("inf"), "positive"),
            "gamma": (0 < self.gamma < 1, "in (0, 1)"),
            "batch_size": (2 <= self.batch_size <= LARGEST_BATCH, f"2 to {LARGEST_BATCH}"),
            "n_envs": whole(self.n_envs, 1024),
        }


@dataclass(frozen=True, kw_only=True)
class SACConfig(OnlineConfig):
    """SAC (Haarnoja et al. 2018): off-policy, the fastest here; half of every batch is from the dataset."""

    updates_per_step: int = 1
    """Gradient steps per step in the environment."""
    entropy: float = 1.0
    """The entropy that is aimed at is minus this, times the action's dimensions."""

    def rules(self) -> Rules:
        """Return the rules of the fields."""
        return {
            **super().rules(),
            "updates_per_step": whole(self.updates_per_step, 1024),
            "entropy": (0 <= self.entropy < float("inf"), "0 or positive"),
        }


@dataclass(frozen=True, kw_only=True)
class OnPolicyConfig(OnlineConfig):
    """What PPO and TRPO share."""

    n_steps: int = 40_000
    batch_size: int = 250
    """Transitions per gradient step; a divisor of the rollout."""
    rollout: int = 2_000
    """Steps in the environment between two updates of the policy."""
    log_std: float = -1.0
    """Logarithm of the correction's standard deviation at first."""

    def rules(self) -> Rules:
        """Return the rules of the fields."""
        return {
            **super().rules(),
            "rollout": (2 * self.n_envs <= self.rollout <= LARGEST_COUNT, f"{2 * self.n_envs} to {LARGEST_COUNT}"),
            "log_std": (-20 <= self.log_std <= 2, "-20 to 2"),
        }


@dataclass(frozen=True, kw_only=True)
class PPOConfig(OnPolicyConfig):
    """PPO (Schulman et al. 2017): policy gradient with clipped ratios."""

    learning_rate: float = 3e-4


@dataclass(frozen=True, kw_only=True)
class TRPOConfig(OnPolicyConfig):
    """TRPO (Schulman et al. 2015): natural policy gradient, the family of the paper's."""

    target_kl: float = 0.01
    """Largest mean KL divergence of an update of the policy."""

    def rules(self) -> Rules:
        """Return the rules of the fields."""
        return {**super().rules(), "target_kl": (0 < self.target_kl < float("inf"), "positive")}


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
