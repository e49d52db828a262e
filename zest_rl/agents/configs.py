"""What each algorithm can be told. Flags and finished runs need these alone, and nothing here imports torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

from zest_rl.agents.rules import (
    LARGEST_BATCH,
    LARGEST_WIDTH,
    MOST_NETWORKS,
    Rules,
    check_fields,
    few_weights,
    whole,
)
from zest_rl.embedders import Precision
from zest_rl.errors import BadInput, nearest
from zest_rl.rewards.learned import Inputs

Timesteps = Literal["absolute", "relative"]
LONGEST_CONTEXT = 2048
"""Steps; the mask of each block grows with their square."""
LARGEST_COUNT = 10**9
FOREIGN = "foreign"
"""Name of the agent in the ``meta.json`` of a run of `zest_rl.agents.foreign`, which has no config."""


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """What the config of every agent inherits: how its networks are trained, and how many of them."""

    learning_rate: float = 3e-4
    """AdamW's step size after warm-up."""
    weight_decay: float = 1e-4
    """AdamW's decoupled weight decay."""
    warmup_updates: int = 200
    """Updates over which the step size rises linearly from 0."""
    grad_clip: float = 0.25
    """Largest Euclidean norm of the gradient."""
    ema_decay: float = 0.999
    """Largest decay of the moving average of the weights, which is what acts; 0 acts with the last weights. It rises as
    (1 + n) / (10 + n): about the last ninth of a training is averaged, until 0.999 is reached after 9000 updates."""
    amp: Precision = "auto"
    """Precision of matrix products; auto is bf16 where the hardware has it."""
    n_networks: int = 1
    """Networks that are trained on the same batches from different initial weights; the mean of their actions acts."""

    def optimizer_rules(self) -> Rules:
        """Return the rules of these fields."""
        return {
            "learning_rate": (0 < self.learning_rate < float("inf"), "positive"),
            "weight_decay": (0 <= self.weight_decay < float("inf"), "0 or positive"),
            "warmup_updates": (self.warmup_updates >= 0, "0 or positive"),
            "grad_clip": (0 < self.grad_clip < float("inf"), "positive"),
            "ema_decay": (0 <= self.ema_decay < 1, "in [0, 1)"),
            "amp": (self.amp in get_args(Precision), f"one of {', '.join(get_args(Precision))}"),
            "n_networks": whole(self.n_networks, MOST_NETWORKS),
        }


def _mlp_rules(config: BCConfig | RvSConfig) -> Rules:
    """Return the rules of the fields that the MLPs share."""
    return {
        "hidden_size": whole(config.hidden_size, LARGEST_WIDTH),
        "n_layers": few_weights(config.n_layers, config.hidden_size**2, config.n_networks),
        "dropout": (0 <= config.dropout < 1, "in [0, 1)"),
        "batch_size": whole(config.batch_size, LARGEST_BATCH),
        **config.optimizer_rules(),
    }


@dataclass(frozen=True)
class BCConfig(OptimizerConfig):
    """Behaviour cloning."""

    top_fraction: float = 1.0
    """Share of the episodes, those with the largest returns, that is cloned; 1 clones all and never reads a reward."""
    hidden_size: int = 512
    """Units per hidden layer."""
    n_layers: int = 3
    """Hidden layers."""
    dropout: float = 0.1
    """Share of hidden units that is zeroed while training."""
    batch_size: int = 1280
    """Transitions per update."""

    def __post_init__(self) -> None:
        top_fraction = (0 < self.top_fraction <= 1, "in (0, 1]")
        check_fields("BC config", self, {"top_fraction": top_fraction, **_mlp_rules(self)})


@dataclass(frozen=True)
class RvSConfig(OptimizerConfig):
    """Return-conditioned MLP (RvS)."""

    condition_on_return: bool = True
    """False zeroes the return-to-go: the same network without any information from the scores."""
    hidden_size: int = 512
    """Units per hidden layer."""
    n_layers: int = 3
    """Hidden layers."""
    dropout: float = 0.0
    """Share of hidden units that is zeroed while training."""
    batch_size: int = 320
    """Transitions per update."""
    learning_rate: float = 1e-3
    """AdamW's step size after warm-up."""

    def __post_init__(self) -> None:
        check_fields("RvS config", self, _mlp_rules(self))


@dataclass(frozen=True)
class DTConfig(OptimizerConfig):
    """Decision Transformer."""

    condition_on_return: bool = True
    """False zeroes the return-to-go: the same network without any information from the scores."""
    context_len: int = 20
    """K, the steps that the network sees."""
    timesteps: Timesteps = "absolute"
    """What a step's embedding counts from: the start of the episode, as in the paper, or the start of the window."""
    hidden_size: int = 128
    """Width of a token."""
    n_layers: int = 3
    """Transformer blocks."""
    n_heads: int = 1
    """Attention heads per block."""
    dropout: float = 0.1
    """Share zeroed of embeddings, residual branches and attention weights while training."""
    batch_size: int = 64
    """Windows of K steps per update."""

    def __post_init__(self) -> None:
        check_fields("DT config", self, {
            "context_len": whole(self.context_len, LONGEST_CONTEXT),
            "hidden_size": whole(self.hidden_size, LARGEST_WIDTH),
            "n_layers": few_weights(self.n_layers, 12 * self.hidden_size**2, self.n_networks),
            "n_heads": (
                self.n_heads >= 1 and self.hidden_size % self.n_heads == 0,
                f"a divisor of hidden_size ({self.hidden_size})",
            ),
            "dropout": (0 <= self.dropout < 1, "in [0, 1)"),
            "timesteps": (self.timesteps in get_args(Timesteps), f"one of {', '.join(get_args(Timesteps))}"),
            "batch_size": whole(self.batch_size, LARGEST_BATCH // min(max(1, self.context_len), LONGEST_CONTEXT)),
            **self.optimizer_rules(),
        })  # fmt: skip


@dataclass(frozen=True)
class TREXConfig(OptimizerConfig):
    """A reward from ranked trajectories (T-REX)."""

    inputs: Inputs = "obs"
    """The reward is a function of the observation, or of the scorer's embedding of the frame, mean of its views."""
    snippet_len: int = 50
    """Steps of the compared parts, drawn from the whole trajectory; at most those of the shortest trajectory."""
    held_out: float = 0.2
    """Share of the trajectories, evenly over the ranks, that is not trained on: the weights that agree best with its
    ranking are kept. 0 trains on all and keeps the last weights."""
    hidden_size: int = 64
    """Units per hidden layer."""
    n_layers: int = 0
    """Hidden layers; 0: a linear reward."""
    dropout: float = 0.0
    """Share of hidden units that is zeroed while training."""
    batch_size: int = 16
    """Pairs per update."""
    learning_rate: float = 3e-3
    """AdamW's step size after warm-up."""
    weight_decay: float = 10.0
    """AdamW's decoupled weight decay."""
    amp: Precision = "fp32"
    """Precision of matrix products; auto is bf16 where the hardware has it."""
    n_networks: int = 3
    """Networks that are trained on the same pairs from different initial weights; the mean of their rewards counts."""

    def __post_init__(self) -> None:
        check_fields("T-REX config", self, {
            "inputs": (self.inputs in get_args(Inputs), f"one of {', '.join(get_args(Inputs))}"),
            "snippet_len": whole(self.snippet_len, 10**6),
            "held_out": (0 <= self.held_out < 1, "in [0, 1)"),
            "hidden_size": whole(self.hidden_size, LARGEST_WIDTH),
            "n_layers": few_weights(self.n_layers + 1, self.hidden_size**2, self.n_networks),
            "dropout": (0 <= self.dropout < 1, "in [0, 1)"),
            "batch_size": whole(self.batch_size, LARGEST_BATCH),
            **self.optimizer_rules(),
        })  # fmt: skip


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


START = BCConfig(hidden_size=256, dropout=0.0, batch_size=320, learning_rate=1e-3, n_networks=2)
"""The behaviour cloning that a policy starts from."""
LARGEST_COUNT = 10**9
FOREIGN = "foreign"
"""Name of the agent in the ``meta.json`` of a run of `zest_rl.agents.foreign`, which has no config."""

CONFIGS: dict[str, type[Any]] = {
    "bc": BCConfig,
    "dt": DTConfig,
    "rvs": RvSConfig,
    "trex": TREXConfig,
    "sac": SACConfig,
    "ppo": PPOConfig,
    "trpo": TRPOConfig,
}
"""By name, the agents of `zest_rl.agents.AGENTS`."""


def config_of(name: str) -> type[Any]:
    """Return the config of the agent called `name`.

    Raises:
        BadInput: there is no such agent; the message names the nearest ones.
    """
    if name not in CONFIGS:
        raise BadInput(f"unknown agent {name!r}; {nearest(name, CONFIGS)}")
    return CONFIGS[name]
