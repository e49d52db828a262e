"""What all agents share: statistics of the data, and the interfaces of agents and policies. No algorithm is here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from zest_rl.errors import BadInput
from zest_rl.types import Episode, FloatArray

Batch = dict[str, Tensor]
Sampler = Callable[[np.random.Generator], Batch]
Precision = Literal["auto", "bf16", "fp32"]

# The Decision Transformer's code divides by std + 1e-6: a joint that never moved in the data would become a huge number
# once it moves. Hence a floor (rad or m, as the kitchen's observations) and a bound (in standard deviations).
STD_FLOOR = 1e-3
MAX_NORMALIZED = 10.0


@dataclass(frozen=True)
class DataFacts:
    """Everything about the training data that the model or the policy needs; stored in ``meta.json`` as it is here."""

    obs_dim: int
    act_dim: int
    n_episodes: int
    n_transitions: int
    max_steps: int
    """Actions in the longest episode."""
    obs_mean: tuple[float, ...]
    """(obs_dim,) over o_0 … o_{T-1} of all episodes."""
    obs_std: tuple[float, ...]
    """(obs_dim,) standard deviation, at least `STD_FLOOR`."""
    return_scale: float
    """Largest absolute return of the data."""
    return_quantiles: tuple[float, ...]
    """(101,) quantiles 0, 0.01, … 1 of the episodes' returns."""
    rtg_schedule: tuple[float, ...]
    """(T+1,) return-to-go of the episode with the largest return; starts at that return and ends at 0."""

    def normalize(self, obs: FloatArray) -> FloatArray:
        """Return ``(obs - mean) / std`` clipped to ± `MAX_NORMALIZED`; obs (…, obs_dim) float32, and so the result."""
        mean, std = np.array(self.obs_mean, dtype=np.float32), np.array(self.obs_std, dtype=np.float32)
        normalized: FloatArray = np.clip((obs - mean) / std, -MAX_NORMALIZED, MAX_NORMALIZED).astype(np.float32)
        return normalized


def returns_to_go(rewards: FloatArray) -> FloatArray:
    """Return ``R_t = Σ_{k ≥ t} r_k`` for t = 0 … T, so the last is 0; rewards (T,), result (T+1,) float32."""
    total = np.zeros(len(rewards) + 1)
    total[:-1] = np.cumsum(rewards[::-1], dtype=np.float64)[::-1]
    return total.astype(np.float32)


def describe_data(episodes: Sequence[Episode]) -> DataFacts:
    """Measure `episodes`.

    Raises:
        BadInput: there are none, their dimensions differ, or an action leaves [-1, 1].
    """
    if not episodes:
        raise BadInput("training needs at least 1 episode, got 0; check the dataset id and its filters")
    dims = [(e.obs.shape[1], e.actions.shape[1]) for e in episodes]
    odd = next((i for i, d in enumerate(dims) if d != dims[0]), None)
    if odd is not None:
        raise BadInput(
            f"all episodes must have the same (obs_dim, act_dim): episode 0 has {dims[0]}, episode {odd} has "
            f"{dims[odd]}; train on one environment at a time"
        )
    largest = max(float(np.abs(e.actions).max()) for e in episodes)
    if largest > 1.0 + 1e-5:
        raise BadInput(f"actions must lie in [-1, 1], got {largest:g}; rescale them to the bounds of the action space")
    obs = np.concatenate([e.obs[:-1] for e in episodes]).astype(np.float64)
    curves = [returns_to_go(e.rewards) for e in episodes]
    returns = np.array([curve[0] for curve in curves], dtype=np.float64)
    return DataFacts(
        obs_dim=dims[0][0],
        act_dim=dims[0][1],
        n_episodes=len(episodes),
        n_transitions=len(obs),
        max_steps=max(map(len, episodes)),
        obs_mean=_floats(obs.mean(axis=0)),
        obs_std=_floats(np.maximum(obs.std(axis=0), STD_FLOOR)),
        return_scale=float(np.abs(returns).max()),
        return_quantiles=_floats(np.quantile(returns, np.linspace(0, 1, 101))),
        rtg_schedule=_floats(curves[int(returns.argmax())]),
    )


def _floats(array: np.ndarray[Any, Any]) -> tuple[float, ...]:
    return tuple(float(x) for x in array.astype(np.float32))


def resolve_precision(precision: Precision, device: torch.device) -> Precision:
    """Return bf16 or fp32; ``auto`` is bf16 where the hardware computes it natively (slower than fp32 elsewhere)."""
    if precision != "auto":
        return precision
    if device.type == "cuda":
        return "bf16" if torch.cuda.is_bf16_supported() else "fp32"
    flags = Path("/proc/cpuinfo")  # Linux only
    words = set(flags.read_text().split()) if flags.exists() else set()
    return "bf16" if words & {"avx512_bf16", "amx_bf16", "bf16"} else "fp32"


def autocast(precision: Precision, device: torch.device) -> torch.autocast:
    """Return the context in which matrix products are computed in the resolved `precision`; the rest stays float32."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=precision == "bf16")


class OptimizerConfig(Protocol):
    """The fields of a config that `zest_rl.training.loop` reads; all others are the agent's own."""

    @property
    def learning_rate(self) -> float:
        """AdamW's step size after warm-up."""

    @property
    def weight_decay(self) -> float:
        """AdamW's decoupled weight decay."""

    @property
    def warmup_updates(self) -> int:
        """Updates over which the step size rises linearly from 0."""

    @property
    def grad_clip(self) -> float:
        """Largest Euclidean norm of the gradient."""

    @property
    def ema_decay(self) -> float:
        """Decay of the moving average of the weights, which is what acts."""

    @property
    def amp(self) -> Precision:
        """Precision of matrix products; ``auto`` is bf16 where the hardware has it."""


Rules = Mapping[str, tuple[bool, str]]  # field: (holds, "must be …")


def optimizer_rules(config: OptimizerConfig) -> Rules:
    """Return the rules of the fields that every agent's config has."""
    return {
        "learning_rate": (0 < config.learning_rate < float("inf"), "positive"),
        "weight_decay": (0 <= config.weight_decay < float("inf"), "0 or positive"),
        "warmup_updates": (config.warmup_updates >= 0, "0 or positive"),
        "grad_clip": (0 < config.grad_clip < float("inf"), "positive"),
        "ema_decay": (0 <= config.ema_decay < 1, "in [0, 1)"),
        "amp": (config.amp in ("auto", "bf16", "fp32"), "one of auto, bf16, fp32"),
    }


def check_fields(what: str, values: Any, rules: Rules) -> None:
    """Raise one `BadInput` that lists every field of `values` (an object with attributes) that breaks its rule."""
    problems = [f"{f} must be {rule}, got {getattr(values, f)!r}" for f, (holds, rule) in rules.items() if not holds]
    if problems:
        raise BadInput(f"{what}: " + "; ".join(problems))


class Policy(Protocol):
    """A trained agent at work on N episodes in step: `begin`, then `act` and `observe` in turn, then `end`."""

    agent: str
    """Name in the registry, or ``foreign``."""
    meta: dict[str, Any]
    """The run's ``meta.json``."""
    uses_return: bool
    """`begin` needs a target return, and rewards given to `observe` change the actions."""

    def begin(self, n_episodes: int, target_return: float | None = None) -> None:
        """Reset and start N episodes, each asked for `target_return` (in the data's units)."""

    def act(self, obs: FloatArray) -> FloatArray:
        """Return actions (N, act_dim) float32 in [-1, 1] for obs (N, obs_dim) float32, the newest of each episode."""

    def observe(self, rewards: FloatArray) -> None:
        """Take the rewards (N,) of the last actions off the returns still asked for."""

    def end(self) -> dict[str, NDArray[Any]]:
        """Release per-episode resources, even after a failure; return further results by name, arrays (N, …)."""


def check_obs(obs: FloatArray, n_episodes: int, obs_dim: int) -> None:
    """Raise `BadInput` unless obs is (n_episodes, obs_dim) and finite."""
    if n_episodes == 0:
        raise BadInput("a policy must be told how many episodes it plays: call begin(n_episodes) before act")
    if obs.shape != (n_episodes, obs_dim):
        raise BadInput(f"obs must have shape ({n_episodes}, {obs_dim}), got {obs.shape}; give one row per episode")
    if not np.isfinite(obs).all():
        raise BadInput("obs must be finite, got NaN or infinity; the simulation has probably diverged")


ConfigT = TypeVar("ConfigT")


@dataclass(frozen=True)
class Agent(Generic[ConfigT]):
    """One algorithm as `zest_rl.training.loop` sees it."""

    config: type[ConfigT]
    """Flat frozen dataclass with the fields of `OptimizerConfig`; checks itself."""
    build: Callable[[ConfigT, DataFacts], nn.Module]
    """Model with fresh weights, drawn from torch's global generator."""
    sampler: Callable[[ConfigT, DataFacts, Sequence[Episode]], Sampler]
    """From the data to a function that draws one batch; ``valid`` in it tells what is not padding."""
    loss: Callable[[nn.Module, Batch], Tensor]
    """Scalar to minimise: an average over the batch's rows, or over the elements that are valid."""
    policy: Callable[[nn.Module, ConfigT, DataFacts, dict[str, Any], torch.device], Policy]
    """From a trained model (in eval mode, on the device) and the run's meta to a policy."""
