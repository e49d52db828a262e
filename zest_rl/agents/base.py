"""What all agents share: statistics of the data, the optimizer's settings, the interfaces of agents and policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from zest_rl.agents.configs import OptimizerConfig
from zest_rl.agents.rules import LARGEST_WIDTH, check_fields, whole
from zest_rl.data.observations import standardized
from zest_rl.embedders import Precision, computes_bf16
from zest_rl.errors import BadInput
from zest_rl.types import Episode, FloatArray

Batch = dict[str, Tensor]
T = TypeVar("T")
Sampler = Callable[[np.random.Generator], Batch]
Judge = Callable[[Sequence[nn.Module]], dict[str, float]]
JUDGED = ("held_out_loss", "held_out_accuracy", "disagreement")
"""What a `Judge` tells; the weights of the smallest loss are kept."""

STD_FLOOR = 1e-3
"""The Decision Transformer's code divides by std + 1e-6: a joint that never moved in the data would become a huge
number once it moves. Hence a floor (rad or m, as the kitchen's observations), and the bound of `standardized`."""


@dataclass(frozen=True)
class DataFacts:
    """Everything about the training data that the model or the policy needs; ``meta.json`` holds the same fields."""

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

    def __post_init__(self) -> None:
        check_fields("facts about the data", self, {
            "obs_dim": whole(self.obs_dim, LARGEST_WIDTH**2),
            "act_dim": whole(self.act_dim, LARGEST_WIDTH**2),
            "max_steps": whole(self.max_steps, 10**9),
            "obs_mean": (len(self.obs_mean) == self.obs_dim, f"{self.obs_dim} numbers"),
            "obs_std": (
                len(self.obs_std) == self.obs_dim and min(self.obs_std) > 0, f"{self.obs_dim} positive numbers"
            ),
            "return_quantiles": (len(self.return_quantiles) == 101, "101 numbers"),
            "rtg_schedule": (len(self.rtg_schedule) >= 1, "at least one number"),
        })  # fmt: skip

    def normalize(self, obs: FloatArray) -> FloatArray:
        """Return observations (…, obs_dim) as networks take them, float32 of the same shape: see `standardized`."""
        return standardized(obs, *self._mean_and_std)

    @cached_property
    def _mean_and_std(self) -> tuple[FloatArray, FloatArray]:
        """As arrays: to convert the numbers takes longer than to normalise the observations of a few episodes."""
        return np.array(self.obs_mean, np.float32), np.array(self.obs_std, np.float32)


def returns_to_go(rewards: FloatArray) -> FloatArray:
    """Return ``R_t = Σ_{k ≥ t} r_k`` for t = 0 … T, so the last is 0; rewards (T,), result (T+1,) float32."""
    sums = np.zeros(len(rewards) + 1)
    sums[:-1] = np.cumsum(rewards[::-1], dtype=np.float64)[::-1]
    return sums.astype(np.float32)


def describe_data(episodes: Sequence[Episode]) -> DataFacts:
    """Return the facts of `episodes`.

    Raises:
        BadInput: there are none, their dimensions differ, or an action leaves [-1, 1].
    """
    if not episodes:
        raise BadInput("training needs at least 1 episode, got 0; check the dataset id and its filters")
    dims = [(e.obs.shape[1], e.actions.shape[1]) for e in episodes]
    other = next((i for i, d in enumerate(dims) if d != dims[0]), None)
    if other is not None:
        raise BadInput(
            f"all episodes must have the same (obs_dim, act_dim): episode 0 has {dims[0]}, episode {other} has "
            f"{dims[other]}; train on one environment at a time"
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
    return "bf16" if computes_bf16("cpu") else "fp32"


def autocast(precision: Precision, device: torch.device) -> torch.autocast:
    """Return the context in which matrix products are computed in the resolved `precision`; the rest stays float32."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=precision == "bf16")


def check_returns(facts: DataFacts) -> None:
    """Raise `BadInput` if all returns are zero, so that nothing can be asked for."""
    if facts.return_scale == 0:
        raise BadInput(
            "a policy conditioned on returns needs returns that are not all 0; check that the dataset is relabeled, or "
            "set condition_on_return to false"
        )


class ReturnToGo:
    """The returns that N episodes still ask for, in the data's units; always zero for a policy that uses none."""

    def __init__(self, facts: DataFacts, is_used: bool):
        self._scale = facts.return_scale
        self._is_used = is_used
        self._remaining = np.zeros(0)

    def __len__(self) -> int:
        return len(self._remaining)

    def begin(self, n_episodes: int, target_return: float | None) -> None:
        """Ask for `target_return` in N episodes.

        Raises:
            BadInput: returns are used, and it is not a finite number.
        """
        if self._is_used and (target_return is None or not np.isfinite(target_return)):
            raise BadInput(
                f"a policy conditioned on returns must be asked for a finite return, got {target_return}; "
                "take a quantile of the training returns from meta['return_quantiles']"
            )
        self._remaining = np.full(n_episodes, target_return if self._is_used else 0.0)

    def scaled(self) -> FloatArray:
        """Return (N,) float32, divided by the largest absolute return of the data."""
        if not self._is_used:
            return self._remaining.astype(np.float32)
        return (self._remaining / self._scale).astype(np.float32)

    def subtract(self, rewards: FloatArray) -> None:
        """Subtract what the last actions earned, (N,)."""
        if self._is_used:
            self._remaining = self._remaining - rewards


def mlp(n_inputs: int, hidden_size: int, n_layers: int, n_outputs: int, dropout: float) -> nn.Sequential:
    """Return linear, ReLU and dropout for each hidden layer, then a linear layer and tanh: [batch, n_outputs]."""
    layers: list[nn.Module] = []
    widths = [n_inputs, *[hidden_size] * n_layers]
    for width in widths[:-1]:
        layers += [nn.Linear(width, hidden_size), nn.ReLU(), nn.Dropout(dropout)]
    return nn.Sequential(*layers, nn.Linear(widths[-1], n_outputs), nn.Tanh())


def networks_of(model: nn.Module) -> list[nn.Module]:
    """Return the networks of what `Agent.networks` returned."""
    return list(model) if isinstance(model, nn.ModuleList) else [model]


def ready_to_act(model: nn.Module, precision: Precision) -> nn.Module:
    """Return a trained model, in eval mode, without what acting does not need; its outputs stay equal to the bit.

    In bf16 `autocast` casts the weights of every product anew in each step, which takes longer than the product.
    """
    for module in list(model.modules()):
        for name, child in module.named_children():
            if isinstance(child, nn.Dropout):
                setattr(module, name, nn.Identity())
            elif precision == "bf16" and (isinstance(child, nn.Linear) or type(child).__name__ == "Conv1D"):
                child.bfloat16()
    return model


def mean_action(predict: Callable[[nn.Module, T], Tensor], model: nn.Module, batch: T) -> Tensor:
    """Return the mean of ``predict(network, batch)``, actions of any shape, over the networks of `Agent.networks`."""
    actions = [predict(network, batch) for network in networks_of(model)]
    return actions[0] if len(actions) == 1 else torch.stack(actions).mean(dim=0)


class Policy(Protocol):
    """A trained agent that plays N episodes in lockstep: `begin`, then `act` and `observe` in turn, then `end`."""

    agent: str
    """Name in the registry, or ``foreign``."""
    meta: dict[str, Any]
    """The run's ``meta.json``."""
    uses_return: bool
    """`begin` needs a target return, and rewards given to `observe` change the actions."""

    def begin(self, n_episodes: int, target_return: float | None = None) -> None:
        """Start N new episodes, each asked for `target_return` (in the data's units)."""

    def act(self, obs: FloatArray) -> FloatArray:
        """Return actions (N, act_dim) float32 in [-1, 1] for obs (N, obs_dim) float32, the newest of each episode."""

    def observe(self, rewards: FloatArray) -> None:
        """Subtract the rewards (N,) of the last actions from the returns still asked for."""

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


ConfigT = TypeVar("ConfigT", bound=OptimizerConfig)


@dataclass(frozen=True)
class Agent(Generic[ConfigT]):
    """One algorithm as `zest_rl.training.loop` sees it."""

    config: type[ConfigT]
    """Frozen dataclass that checks itself."""
    build: Callable[[ConfigT, DataFacts], nn.Module]
    """One network with fresh weights, drawn from torch's global generator."""
    sampler: Callable[[ConfigT, DataFacts, Sequence[Episode]], Sampler]
    """From the data to a function that draws one batch; its ``valid``, if any, is False for padding."""
    loss: Callable[[nn.Module, Batch], Tensor]
    """Scalar to minimise: an average over the batch's rows, or over the elements that are valid."""
    policy: Callable[[nn.Module, ConfigT, DataFacts, dict[str, Any], torch.device], Policy]
    """From a trained model (in eval mode, on the device) and the run's meta to a policy."""
    judge: Callable[[ConfigT, DataFacts, Sequence[Episode]], Judge | None] = lambda config, facts, episodes: None
    """From the data to a function that judges networks (in eval mode) by what is held out of training, as `JUDGED`;
    None keeps the last weights."""

    def networks(self, config: ConfigT, facts: DataFacts) -> nn.Module:
        """Return the model: one network, or ``config.n_networks`` in a list."""
        networks = [self.build(config, facts) for _ in range(config.n_networks)]
        return networks[0] if len(networks) == 1 else nn.ModuleList(networks)
