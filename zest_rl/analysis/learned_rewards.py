"""A learned reward → how it ranks parts of the trajectories that it never saw, beside the scores that it learned from.

Reads ground truth, which neither training nor the choice of weights has seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zest_rl.agents.trex import TREXConfig, split
from zest_rl.data.reader import open_dataset
from zest_rl.errors import BadInput
from zest_rl.metrics.part_ranking import part_accuracy
from zest_rl.metrics.statistics import MIN_EPISODES_TO_RANK, spearman
from zest_rl.rewards.by_learned import embeddings_of
from zest_rl.rewards.learned import LearnedReward
from zest_rl.rewards.scorer import SCORER_FILE
from zest_rl.runtime.records import from_json
from zest_rl.types import FloatArray


@dataclass(frozen=True)
class Judgement:
    """What a learned reward is worth, on the dataset that it learned from."""

    accuracy: float
    """`part_accuracy` on held-out trajectories."""
    plain: float
    """The same of the dataset's own rewards, which ranked the trajectories: a learned reward must beat it."""
    rho_seen: float
    """Rank correlation of learned and true returns, over the trajectories that were trained on; NaN of too few."""
    rho_unseen: float
    """Over those held out."""
    learned_returns: NDArray[np.float64]
    """(N,)."""
    true_returns: NDArray[np.float64]
    """(N,)."""
    held_out: NDArray[np.bool_]
    """(N,) which trajectories were held out."""


def judge_learned_reward(run: Path) -> Judgement:
    """Judge the reward of a run of `zest train trex` by the ground truth of its dataset.

    Raises:
        BadInput: nothing was held out, or as `open_dataset` and `LearnedReward.load`.
    """
    reward = LearnedReward.load(run)
    config = from_json(TREXConfig, reward.meta["config"])
    with open_dataset(reward.record.id) as ds:
        episodes, truth = ds.episodes(), [truth.rewards for truth in ds.truth()]
        if reward.inputs == "obs":
            learned = [reward.of_obs(episode.obs[1:]) for episode in episodes]
        else:
            learned = [reward.of_embeddings(seen[1:]) for seen in embeddings_of(ds, run / SCORER_FILE)]
    unseen = {id(episode) for episode in split(config, episodes)[1]}
    if not unseen:
        raise BadInput(f"{run} was trained on all trajectories; train with --held-out above 0 to judge it on some")
    held_out = np.array([id(episode) in unseen for episode in episodes])
    learned_returns, true_returns = _returns(learned), _returns(truth)

    def on_unseen(rewards: Sequence[FloatArray]) -> float:
        kept = np.flatnonzero(held_out).tolist()
        return part_accuracy([rewards[i] for i in kept], [truth[i] for i in kept], config.snippet_len)

    return Judgement(
        on_unseen(learned),
        on_unseen([episode.rewards for episode in episodes]),
        _rank_correlation(learned_returns[~held_out], true_returns[~held_out]),
        _rank_correlation(learned_returns[held_out], true_returns[held_out]),
        learned_returns,
        true_returns,
        held_out,
    )


def _rank_correlation(learned: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    return spearman(learned, true).value if len(true) >= MIN_EPISODES_TO_RANK else np.nan


def _returns(rewards: Sequence[FloatArray]) -> NDArray[np.float64]:
    return np.array([each.sum(dtype=np.float64) for each in rewards])
