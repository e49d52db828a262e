"""Scores of episodes → which are worth keeping, and in words what is wrong with the others.

An episode's **worth** is the mean of two numbers: its mean score, and the score of its last frame. The rule was chosen
on development data (docs/curate.md); the other figures only say what is wrong with an episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zest_rl.errors import BadInput
from zest_rl.types import FloatArray

STANDS_OUT = 0.8
"""A figure that is worse than this share of the other episodes' is put in words."""
NOTHING = "no figure stands out"


@dataclass(frozen=True)
class RankedEpisode:
    """An episode's place among those of its dataset."""

    index: int
    """In the dataset, from 0."""
    worth: float
    """Mean of `mean` and `end`; episodes of the lowest worth are dropped first."""
    mean: float
    """Mean score of the frames after the first: the return per step."""
    end: float
    """Score of the last frame."""
    progress: float
    """Highest score less that of the first frame."""
    still: float
    """Share of the steps that do not change the score."""
    dip: float
    """Largest fall of the score below an earlier one."""
    words: str
    """What is worse than in most other episodes."""


def rank_episodes(scores: Sequence[FloatArray]) -> list[RankedEpisode]:
    """Rank episodes by their scores alone, the best first; of equal worth the earlier one.

    Args:
        scores: (T+1,) per episode, of x_0 … x_T, T ≥ 1.

    Raises:
        BadInput: no episode, an episode of fewer than two frames, or a score that is no finite number.
    """
    if not scores:
        raise BadInput("there must be at least 1 episode to rank, got 0; use a dataset with episodes")
    for i, episode in enumerate(scores):
        if episode.ndim != 1 or len(episode) < 2 or not np.isfinite(episode).all():
            raise BadInput(
                f"episode {i} must have (T + 1 >= 2,) finite scores, got {episode.shape} with "
                f"{np.count_nonzero(~np.isfinite(episode))} that are not; relabel the dataset again"
            )
    means = np.array([episode[1:].mean(dtype=np.float64) for episode in scores])
    ends = np.array([episode[-1] for episode in scores], dtype=np.float64)
    progress = np.array([episode.max() - episode[0] for episode in scores], dtype=np.float64)
    still = np.array([(np.diff(episode) == 0).mean() for episode in scores])
    dips = np.array([(np.maximum.accumulate(episode) - episode).max() for episode in scores], dtype=np.float64)
    worst_low, worst_high = 1, -1
    figures = (
        (means, worst_low, "mean score {:.3f} ({:.0f} % of the others have more)"),
        (ends, worst_low, "ends at {:.3f} ({:.0f} % end higher)"),
        (progress, worst_low, "gains at most {:.3f} ({:.0f} % gain more)"),
        (100 * still, worst_high, "stands still in {:.0f} % of its steps ({:.0f} % do less)"),
        (dips, worst_high, "falls by {:.3f} after a better frame ({:.0f} % fall less)"),
    )
    said: list[list[str]] = [[] for _ in scores]
    for values, sign, phrase in figures:
        for i, value in enumerate(values):
            worse_than = np.count_nonzero(sign * values > sign * value) / max(1, len(values) - 1)
            if worse_than >= STANDS_OUT:
                said[i].append(phrase.format(value, 100 * worse_than))
    worth = (means + ends) / 2
    return [
        RankedEpisode(
            int(i),
            float(worth[i]),
            float(means[i]),
            float(ends[i]),
            float(progress[i]),
            float(still[i]),
            float(dips[i]),
            "; ".join(said[i]) or NOTHING,
        )
        for i in np.argsort(-worth, kind="stable")
    ]


def n_to_keep(share: float, n: int) -> int:
    """Return how many of n episodes are kept: that share, rounded, but one at least."""
    return max(1, round(share * n))
