"""Relabeled datasets → what their rewards are worth before anything is trained on them. Reads ground truth, if any."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zest_rl.data import reader
from zest_rl.errors import BadInput
from zest_rl.kitchen.views import Views, canonical_states
from zest_rl.metrics import reward_quality, statistics
from zest_rl.metrics.statistics import Estimate
from zest_rl.report.panels import MIN_EPISODES_TO_RANK
from zest_rl.types import FloatArray, GroundTruth

CLOCK, STRAIGHT, SATURATED, STILL, CONTRADICTORY = 0.95, 0.9, 0.95, 0.9, 0.01
"""From these shares on a warning is given."""
FLAT = 1e-5
"""Scores whose range is at most this share of the largest are constant, whatever rounding makes of them."""


@dataclass(frozen=True)
class Figure:
    """One number that judges a reward."""

    name: str
    meaning: str
    needs: Literal["scores", "truth", "states", "still"]
    """What of `_Rewards` must be known."""
    measure: Callable[[_Rewards], Estimate]


@dataclass(frozen=True)
class _Rewards:
    """What is known of the rewards of one dataset."""

    rewards: list[FloatArray]
    """(T,) per episode, as a trainer sees them."""
    scores: list[FloatArray]
    """(T,) per episode, of the frames after each action; the rewards, unless these are differences."""
    states: list[NDArray[np.float64]] | None
    """(T+1, nq) per episode, rounded as the frames were rendered; None of other robots than the kitchen's."""
    still: list[NDArray[np.bool_]] | None
    """(T,) per episode, frames that show what the first one shows; None where that is not known."""
    truth: list[GroundTruth] | None

    @cached_property
    def returns(self) -> NDArray[np.float64]:
        """(N,) float64."""
        return reward_quality.returns_of(self.rewards)

    @cached_property
    def true_returns(self) -> NDArray[np.float64]:
        """(N,) float64."""
        return np.array([episode.episode_return for episode in self.known_truth])

    @property
    def known_truth(self) -> list[GroundTruth]:
        """The ground truth, which is there."""
        assert self.truth is not None
        return self.truth

    @property
    def known_states(self) -> list[NDArray[np.float64]]:
        """The states, which are there."""
        assert self.states is not None
        return self.states

    @property
    def known_still(self) -> list[NDArray[np.bool_]]:
        """Which frames are still, which is known."""
        assert self.still is not None
        return self.still


FIGURES = (
    Figure(
        "Spearman ρ",
        "rank correlation of the episodes' returns with the true ones; 1 is best",
        "truth",
        lambda r: statistics.spearman(r.returns, r.true_returns),
    ),
    Figure(
        "Kendall τ-b",
        "the same by pairs; 1 is best",
        "truth",
        lambda r: reward_quality.kendall(r.returns, r.true_returns),
    ),
    Figure(
        "Pairwise accuracy",
        "share of pairs of episodes that are ordered rightly; .5 is chance",
        "truth",
        lambda r: reward_quality.pairwise_accuracy(r.returns, r.true_returns),
    ),
    Figure(
        "AUPRC of success",
        "how well the return tells successes; chance is their share, which is the next line",
        "truth",
        lambda r: reward_quality.average_precision(r.returns, np.array([e.success for e in r.known_truth])),
    ),
    Figure(
        "Share of successes",
        "in the dataset",
        "truth",
        lambda r: statistics.wilson(sum(e.success for e in r.known_truth), len(r.known_truth)),
    ),
    Figure(
        "EPIC distance",
        "of levels to the true reward, step by step; 0 is the same up to scale and offset, .71 unrelated",
        "truth",
        lambda r: reward_quality.epic_distance(r.scores, [e.rewards for e in r.known_truth]),
    ),
    Figure(
        "Value-order correlation",
        "of reward and time within an episode; 1 rises at every step",
        "scores",
        lambda r: reward_quality.value_order(r.rewards),
    ),
    Figure(
        "Told by the step",
        "share of the rewards' variance that the number of the step tells; 1 is a clock",
        "scores",
        lambda r: reward_quality.share_told_by_step(r.rewards),
    ),
    Figure(
        "Straight in time",
        "share of the score's variance within an episode that a straight line in time tells; 1 is proportional to time",
        "scores",
        lambda r: reward_quality.straight_in_time(r.scores),
    ),
    Figure(
        "Saturated",
        "share of rewards next to the lowest or the highest",
        "scores",
        lambda r: reward_quality.share_saturated(r.rewards),
    ),
    Figure(
        "Nothing to see",
        "share of frames that show what the first one shows",
        "still",
        lambda r: reward_quality.share_still(r.known_still),
    ),
    Figure(
        "Contradictory",
        "share of frames that score otherwise than an equal one of the same episode; 0 is right",
        "states",
        lambda r: reward_quality.share_contradictory(r.scores, [episode[1:] for episode in r.known_states]),
    ),
)


@dataclass(frozen=True)
class Inspection:
    """What can be said of one dataset's rewards."""

    dataset_id: str
    task: str
    """Of the kitchen; of another robot, the dataset that was relabeled."""
    made: Mapping[str, Any]
    """How it was relabeled, as `zest_rl.rewards.relabel` left it."""
    figures: Mapping[str, Estimate]
    """By the names of `FIGURES`; those that need ground truth or states are missing where there are none."""
    warnings: tuple[str, ...]
    over_time: Mapping[str, FloatArray]
    """Mean reward at each step (T,), of successes and failures; without ground truth, of all episodes."""
    returns: NDArray[np.float64]
    """(N,) by the rewards."""
    true_returns: NDArray[np.float64] | None
    """(N,); None without ground truth."""

    @property
    def has_truth(self) -> bool:
        """Whether the dataset holds ground truth."""
        return self.true_returns is not None

    def known_figures(self) -> dict[str, Estimate | None]:
        """Every figure that was measured, by name; None where it is undefined, as for constant scores."""
        return {name: None if np.isnan(one.value) else one for name, one in self.figures.items()}


def inspect(dataset_id: str) -> Inspection:
    """Judge the rewards of a relabeled dataset.

    Raises:
        BadInput: no such dataset, it was not relabeled, or it has fewer than 3 episodes.
    """
    metadata = reader.read_metadata(dataset_id)
    made = metadata.get("zest", {}).get("relabel")
    if made is None:
        raise BadInput(f"dataset {dataset_id} holds no ZeST scores; run `zest relabel {dataset_id}` and inspect that")
    config = made["scorer"]["config"]
    views = None if reader.is_foreign(metadata) else Views(**config["views"])
    step_rewards = reader.read_rewards(dataset_id)
    if len(step_rewards) < MIN_EPISODES_TO_RANK:
        raise BadInput(
            f"rewards can be judged on at least {MIN_EPISODES_TO_RANK} episodes, {dataset_id} has {len(step_rewards)}"
        )
    scores = [score[1:] for score in reader.read_scores(dataset_id)]
    states, still = None, None
    if views is not None:
        states = [canonical_states(episode, views) for episode in reader.read_states(dataset_id)]
        still = [(episode[1:] == episode[0]).all(axis=1) for episode in states]
    elif (config["features"], config["similarity"]) == ("delta", "cos") and made["shuffle"] is None:
        still = [score == 0 for score in scores]  # nothing else scores exactly 0
    truth = reader.read_ground_truth(dataset_id) if reader.has_ground_truth(dataset_id) else None
    rewards = _Rewards(step_rewards, scores, states, still, truth)
    figures = {figure.name: figure.measure(rewards) for figure in FIGURES if getattr(rewards, figure.needs) is not None}
    found = warnings(step_rewards, figures)
    if made["shuffle"] is not None:
        found.insert(0, "These are the scores of other episodes: the dataset was relabeled with --shuffle.")
    return Inspection(
        dataset_id,
        str(made["source"]) if views is None else views.task,
        made,
        figures,
        tuple(found),
        _over_time(rewards),
        rewards.returns,
        None if rewards.truth is None else rewards.true_returns,
    )


def warnings(rewards: Sequence[FloatArray], figures: Mapping[str, Estimate]) -> list[str]:
    """What speaks against training on these rewards: sentences, none when nothing does.

    Args:
        rewards: (T,) per episode.
        figures: by the names of `FIGURES`.
    """
    every = np.concatenate(rewards)
    if np.ptp(every) <= FLAT * np.abs(every).max():
        return ["All frames score the same: this goal and embedder tell nothing apart. Look at the goal's pictures."]
    found = []
    if np.ptp(reward_quality.returns_of(rewards)) == 0:
        found.append("All episodes have the same return: there is nothing to condition a Decision Transformer on.")
    if "Contradictory" in figures and figures["Contradictory"].value >= CONTRADICTORY:
        found.append(
            f"{figures['Contradictory'].value:.0%} of the frames score otherwise than an equal frame of the same "
            "episode: these scores are not of these episodes (shuffled?)."
        )
    if figures["Told by the step"].value >= CLOCK:
        found.append("The number of the step alone tells the score: the reward is a clock, whatever the robot does.")
    elif figures["Straight in time"].value >= STRAIGHT:
        found.append(
            "In every episode, good or bad, the score is nearly proportional to time: it may tell how long the robot "
            "has moved rather than how near the goal is."
        )
    if figures["Saturated"].value >= SATURATED:
        found.append("Nearly all frames score next to the lowest or the highest: most progress is not rewarded.")
    if "Nothing to see" in figures and figures["Nothing to see"].value >= STILL:
        found.append("Most frames show what the first one shows: nothing moves, or the cameras do not see it.")
    rho = figures.get("Spearman ρ")
    if rho is not None and not rho.low > 0:  # also when it is NaN
        against = " The higher the return, the worse the episode." if rho.high < 0 else ""
        found.append(
            f"The returns do not rank the episodes as the true ones do: ρ = {rho.value:.2f}, "
            f"95 % interval {rho.low:.2f} to {rho.high:.2f}.{against}"
        )
    return found


def _over_time(rewards: _Rewards) -> dict[str, FloatArray]:
    groups = {"all episodes": list(range(len(rewards.rewards)))}
    if rewards.truth is not None:
        success = [episode.success for episode in rewards.truth]
        groups = {"successes": [], "failures": []}
        for i, won in enumerate(success):
            groups["successes" if won else "failures"].append(i)
    return {name: _mean_by_step([rewards.rewards[i] for i in group]) for name, group in groups.items() if group}


def _mean_by_step(scores: Sequence[FloatArray]) -> FloatArray:
    """Mean over those episodes that are long enough: (T of the longest,)."""
    total, count = np.zeros(max(map(len, scores))), np.zeros(max(map(len, scores)))
    for score in scores:
        total[: len(score)] += score
        count[: len(score)] += 1
    return np.asarray(total / count, dtype=np.float32)
