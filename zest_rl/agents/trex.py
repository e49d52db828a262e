"""T-REX: a reward network from ranked trajectories, by the Bradley-Terry loss on pairs of their parts.

Brown et al. 2019 (https://arxiv.org/abs/1904.06387). A trajectory ranks by its return, which is the summed ZeST score
where `zest relabel` made the rewards (Cui et al. 2022, App. "T-REX Training"). Deviations:
  - every pair of trajectories with different returns is used, whatever their distance in rank;
  - a part of a trajectory is 50 steps drawn from all of it, not 50 in a row: it ranks as the whole does more often;
  - without hidden layers the reward is linear in its standardised inputs, with a strong decay of the weights: with 80
    trajectories, MLPs rank the held-out ones better and tell their parts apart worse (docs/findings.md);
  - the reward ends in tanh, so that it is bounded and the networks of the ensemble have one scale;
  - the weights that do best on pairs of held-out trajectories are kept, by the same ranking.
What is trained is a reward, not a policy: `zest_rl.rewards.learned.LearnedReward` applies it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import softplus

from zest_rl.agents.base import (
    Agent,
    Batch,
    DataFacts,
    Judge,
    Policy,
    Sampler,
    mlp,
)
from zest_rl.agents.configs import TREXConfig as TREXConfig
from zest_rl.errors import BadInput
from zest_rl.types import Episode

N_JUDGED = 256
"""Held-out pairs."""

# ----------------------------------------------------------------------------------------------------------- model


def build_model(config: TREXConfig, facts: DataFacts) -> nn.Module:
    """Return the MLP: [..., obs_dim] → [..., 1] in [-1, 1]."""
    return mlp(facts.obs_dim, config.hidden_size, config.n_layers, 1, config.dropout)


def predict_returns(model: nn.Module, obs: Tensor) -> Tensor:
    """Return the sum of the rewards [batch] float32 over normalised obs [batch, snippet_len, obs_dim]."""
    predicted: Tensor = model(obs)
    return predicted.float().sum(dim=(1, 2))


# ----------------------------------------------------------------------------------------------------------- batch


def split(config: TREXConfig, episodes: Sequence[Episode]) -> tuple[list[Episode], list[Episode]]:
    """Return the trajectories to train on and those held out, the latter evenly over the ranks.

    Raises:
        BadInput: one of the two has no pair of different returns.
    """
    returns = np.array([e.rewards.sum(dtype=np.float64) for e in episodes])
    if len(np.unique(returns)) < 2:
        raise BadInput(
            f"T-REX needs at least 2 trajectories that rank differently, but the {len(returns)} of this dataset have "
            "the same return; relabel it with a goal that tells them apart"
        )
    n_held_out = max(2, round(config.held_out * len(episodes))) if config.held_out else 0
    order = np.argsort(returns, kind="stable")
    ranks = ((np.arange(n_held_out) + 0.5) * len(episodes) / max(1, n_held_out)).astype(int)
    chosen = set(order[ranks])
    trained = [e for i, e in enumerate(episodes) if i not in chosen]
    held_out = [e for i, e in enumerate(episodes) if i in chosen]
    if len(_pairs(trained)) == 0 or (n_held_out and len(_pairs(held_out)) == 0):
        raise BadInput(
            f"T-REX needs at least 2 trajectories of different returns to train on and 2 to hold out, but got "
            f"{len(trained)} and {len(held_out)} of {len(np.unique(returns))} returns in all; collect more, or set "
            "--held-out 0"
        )
    return trained, held_out


def _pairs(episodes: Sequence[Episode]) -> NDArray[np.intp]:
    """Return all pairs (worse, better) of different returns: (n, 2)."""
    returns = np.array([e.rewards.sum(dtype=np.float64) for e in episodes])
    return np.argwhere(returns[:, None] < returns[None])


def _sampler(config: TREXConfig, facts: DataFacts, episodes: Sequence[Episode], n_pairs: int, length: int) -> Sampler:
    pairs = _pairs(episodes)
    starts = np.cumsum([0, *map(len, episodes)])[:-1]
    n_steps = np.array([len(e) for e in episodes])
    obs = torch.from_numpy(facts.normalize(np.concatenate([e.obs[1:] for e in episodes])))  # o_{t+1} earns r_t

    def sample(rng: np.random.Generator) -> Batch:
        drawn = pairs[rng.integers(len(pairs), size=n_pairs)]
        order = rng.random((n_pairs, 2, n_steps.max()))
        order[np.arange(n_steps.max()) >= n_steps[drawn][..., None]] = 1  # steps after the end are drawn last
        steps = starts[drawn][..., None] + np.sort(order.argsort(axis=-1)[..., :length])
        worse, better = (obs[torch.from_numpy(steps[:, i])] for i in (0, 1))
        return {
            "worse": worse,  # [batch, length, obs_dim]
            "better": better,  # [batch, length, obs_dim]
        }

    return sample


def make_sampler(config: TREXConfig, facts: DataFacts, episodes: Sequence[Episode]) -> Sampler:
    """Return a function that draws pairs of trajectories, and from each some of its steps; all are equally likely.

    Raises:
        BadInput: as in `split`.
    """
    length = min(config.snippet_len, *map(len, episodes))
    return _sampler(config, facts, split(config, episodes)[0], config.batch_size, length)


# ------------------------------------------------------------------------------------------------------------ loss


def loss(model: nn.Module, batch: Batch) -> Tensor:
    """Return −log P(better > worse) of Bradley and Terry, −log σ(Σ r(better) − Σ r(worse)), averaged over the batch."""
    return softplus(predict_returns(model, batch["worse"]) - predict_returns(model, batch["better"])).mean()


def make_judge(config: TREXConfig, facts: DataFacts, episodes: Sequence[Episode]) -> Judge | None:
    """Return a function that judges networks on pairs of the held-out trajectories; None without any."""
    held_out = split(config, episodes)[1]
    if not held_out:
        return None
    length = min(config.snippet_len, *map(len, episodes))
    batch = _sampler(config, facts, held_out, N_JUDGED, length)(np.random.default_rng(0))

    @torch.no_grad()
    def judge(networks: Sequence[nn.Module]) -> dict[str, float]:
        worse, better = (
            torch.stack([network(batch[which].to(next(network.parameters()).device)) for network in networks])
            for which in ("worse", "better")
        )  # [network, batch, length, 1]
        margins = (better - worse).sum(dim=(2, 3))  # [network, batch]
        return {
            "held_out_loss": float(softplus(-margins).mean()),
            "held_out_accuracy": float((margins.mean(dim=0) > 0).float().mean()),
            "disagreement": float(torch.cat([worse, better], dim=1).std(dim=0, correction=0).mean()),
        }

    return judge


# ------------------------------------------------------------------------------------------------------------- act


def make_policy(
    model: nn.Module, config: TREXConfig, facts: DataFacts, meta: dict[str, Any], device: torch.device
) -> Policy:
    """Refuse: a reward does not act."""
    raise BadInput(
        "this run holds a reward, not a policy; `zest relabel DATASET --reward RUN` writes a dataset with it, which "
        "policies can be trained on"
    )


AGENT = Agent(
    config=TREXConfig, build=build_model, sampler=make_sampler, loss=loss, policy=make_policy, judge=make_judge
)
