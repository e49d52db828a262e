"""Rewards of new steps: the environment's own, online ZeST scores, or what T-REX learned.

Each is the reward of the same state in the dataset, so that recorded and new steps can be learned from together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput
from zest_rl.rewards.learned import LearnedReward
from zest_rl.rewards.scorer import SCORER_FILE
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.sources.base import StateViews
from zest_rl.types import Episode, FloatArray

States = NDArray[np.float64]


class Steps(NamedTuple):
    """One step of N environments; states as the scorer's views read them, with no columns where there are no views."""

    obs: FloatArray
    """(N, obs_dim) o_{t+1}, not normalised."""
    own: FloatArray
    """(N,) the environments' own rewards."""
    first: States
    """(N, width) x_0 of each episode."""
    before: States
    """(N, width) x_t."""
    after: States
    """(N, width) x_{t+1}."""


@dataclass(frozen=True)
class OnlineReward:
    """A reward of new steps, and the same reward of the dataset's."""

    of_steps: Callable[[Steps], FloatArray]
    """(N,) float32."""
    recorded: Sequence[FloatArray]
    """(T,) of every episode of the dataset."""
    views: StateViews | None = None
    """What reads the states that it needs; None: it needs none."""
    flush: Callable[[], None] = lambda: None
    """Write what was computed to a cache."""


def own_reward(dataset: Dataset, episodes: Sequence[Episode]) -> OnlineReward:
    """Return the reward that a dataset holds.

    Raises:
        BadInput: new states have no such rewards.
    """
    record, recorded = dataset.record, [episode.rewards for episode in episodes]
    if record.has_recorded_rewards:
        return OnlineReward(lambda steps: steps.own, recorded)
    why = None
    if record.relabel is None:
        why = "were given as numbers"
    elif record.relabel.shuffle is not None:
        why = "are those of other episodes (--shuffle)"
    elif not (dataset.path / SCORER_FILE).exists():
        why = "are scores of frames from elsewhere"
    if why is not None:
        raise BadInput(
            f"the rewards of {dataset.id} {why}, so new states have none; relabel recorded states without --frames, or "
            "give --reward truth, or the folder of a `zest train trex`"
        )
    scores = _Scores(StateScorer.load(dataset.path / SCORER_FILE, n_workers=1))
    assert record.relabel is not None
    of_steps = scores.differences if record.relabel.reward == "difference" else scores.levels
    return OnlineReward(of_steps, recorded, scores.scorer.embedder.views, scores.scorer.flush)


def learned_reward(run: Path, dataset: Dataset, episodes: Sequence[Episode]) -> OnlineReward:
    """Return the reward that a `zest train trex` learned.

    Raises:
        BadInput: it is no such run, or one of another environment, task or observation.
    """
    reward = LearnedReward.load(run)
    reward.check_fits(dataset.record)
    return OnlineReward(lambda steps: reward.of_obs(steps.obs), [reward.of_obs(e.obs[1:]) for e in episodes])


@dataclass
class _Scores:
    """Online scores, each computed once."""

    scorer: StateScorer
    _known: dict[bytes, np.float32] = field(default_factory=dict)

    def levels(self, steps: Steps) -> FloatArray:
        return self._scores(steps.first, steps.after)

    def differences(self, steps: Steps) -> FloatArray:
        return self._scores(steps.first, steps.after) - self._scores(steps.first, steps.before)

    def _scores(self, first: States, current: States) -> FloatArray:
        canonical = self.scorer.embedder.views.canonical
        pairs = np.concatenate([canonical(first), canonical(current)], axis=1)
        keys = [pair.tobytes() for pair in pairs]
        new = [i for i, key in enumerate(keys) if key not in self._known]
        if new:
            self._known.update(
                zip((keys[i] for i in new), self.scorer.score_now(first[new], current[new]), strict=True)
            )
        return np.array([self._known[key] for key in keys], dtype=np.float32)
