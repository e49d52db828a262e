"""Figures that judge the rewards of a dataset, and warnings of bad ones. Ground truth judges, it makes no reward."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zest_rl.metrics import reward_quality, statistics
from zest_rl.metrics.statistics import Estimate
from zest_rl.types import FloatArray, GroundTruth

CLOCK, STRAIGHT, SATURATED, STILL, FALLEN, CONTRADICTORY, LENGTH = 0.95, 0.9, 0.95, 0.9, 0.5, 0.01, 0.8
"""Shares from which on a warning is given; `LENGTH`: rank correlation of returns with the episodes' lengths."""
VIEW_CANNOT_TELL = (
    "From the first to the last frames this view changes as much as the goal does, but in other directions: one view "
    "that shows the robot cannot tell; hide the robot (recorded states, or `--masks`), or add views."
)
"""The warning of `zest_rl.rewards.scorer.Scorer.view_cannot_tell`."""
FLAT = 1e-5
"""Scores whose range is at most this share of the largest count as constant up to rounding."""


@dataclass(frozen=True)
class Figure:
    """One number that judges a reward, as `measure_rewards` returns it."""

    key: str
    """In `zest inspect --json`."""
    label: str
    """On pages and in text."""
    meaning: str
    """One sentence."""
    undefined: str = ""
    """Why there may be no such number."""

    def sentence(self, *, is_defined: bool = True) -> str:
        """Return its meaning and, where it has no value, why."""
        return self.meaning if is_defined else f"{self.meaning} Undefined: {self.undefined}."


FIGURES = (
    Figure(
        "spearman",
        "Rank correlation with the true returns",
        "Spearman's ρ: 1 orders the episodes as the ground truth does, 0 at random, -1 the wrong way round.",
        "all returns, or all true ones, are equal",
    ),
    Figure(
        "kendall",
        "Kendall's τ-b with the true returns",
        "The same, counted by pairs of episodes.",
        "all returns, or all true ones, are equal",
    ),
    Figure(
        "pairwise",
        "Pairs of episodes in the right order",
        "Share of pairs in which the better episode has the higher return; .5 is chance.",
        "all true returns are equal",
    ),
    Figure(
        "auprc",
        "Average precision for success",
        "AUPRC: how well the return separates successes; chance is their share, which is the next line.",
        "no episode succeeds",
    ),
    Figure("successes", "Successful episodes", "Their share in the dataset."),
    Figure(
        "epic",
        "EPIC distance to the true reward",
        "Compared step by step: 0 is equal up to scale and offset, .71 unrelated.",
        "one of the two rewards never changes",
    ),
    Figure(
        "value_order",
        "Rank correlation with time",
        "Value-order correlation of score and time in an episode: 1 rises at every step, below 0 it falls.",
        "no episode has two steps",
    ),
    Figure(
        "told_by_step",
        "Variance explained by the step number",
        "1 is a clock: the same score at the same step, whatever the robot does.",
        "all frames score the same",
    ),
    Figure(
        "straight_in_time",
        "R² of a linear trend",
        "Of score over time in an episode; 1 is proportional to time.",
        "no episode has three steps",
    ),
    Figure(
        "saturated",
        "Rewards at an end of their range",
        "Share close to the lowest or the highest.",
        "all frames score the same",
    ),
    Figure("still", "Unchanged frames", "Share of frames that equal the first one: nothing is seen to move."),
    Figure("fallen", "Episodes that end lower", "Share whose last frame scores lower than their first."),
    Figure(
        "contradictory",
        "Contradictory scores",
        "Share of frames that score differently from an equal frame of the same episode; 0 is right.",
    ),
)
"""In the order of display."""


def true_returns(truth: Sequence[GroundTruth]) -> NDArray[np.float64]:
    """(N,) float64 ground-truth returns."""
    return np.array([episode.episode_return for episode in truth])


def measure_rewards(
    rewards: list[FloatArray],
    scores: list[FloatArray],
    frames: list[NDArray[np.float64]] | None,
    still: list[NDArray[np.bool_]] | None,
    truth: list[GroundTruth] | None,
) -> dict[str, Estimate]:
    """Return the figures by the keys of `FIGURES`; those that need missing arguments are missing.

    Args:
        rewards: (T,) per episode, as a trainer gets them.
        scores: (T+1,) per episode, of all frames; those after each action are the rewards unless these are differences.
        frames: (T, nq) states per episode after each action, rounded as for rendering; None outside the kitchen.
        still: (T,) per episode, whether the frame equals the first one; None where that is unknown.
        truth: ground truth per episode; None where there is none.
    """
    figures = deciding_figures(rewards, scores, frames, still, truth)
    if truth is not None:
        returns, after_actions = reward_quality.returns_of(rewards), [episode[1:] for episode in scores]
        figures |= {
            "kendall": reward_quality.kendall(returns, true_returns(truth)),
            "epic": reward_quality.epic_distance(after_actions, [episode.rewards for episode in truth]),
        }
        told = [episode.success for episode in truth if episode.success is not None]
        if told:
            figures["auprc"] = reward_quality.average_precision(returns, np.array(told))
            figures["successes"] = statistics.wilson(sum(told), len(told))
    return figures


def deciding_figures(
    rewards: list[FloatArray],
    scores: list[FloatArray],
    frames: list[NDArray[np.float64]] | None,
    still: list[NDArray[np.bool_]] | None,
    truth: list[GroundTruth] | None,
) -> dict[str, Estimate]:
    """Return those figures of `measure_rewards` that warnings and the verdict depend on, with the same arguments."""
    after_actions = [episode[1:] for episode in scores]
    figures = {
        "value_order": reward_quality.value_order(after_actions),
        "told_by_step": reward_quality.share_explained_by_step(rewards),
        "straight_in_time": reward_quality.linear_trend_r2(after_actions),
        "saturated": reward_quality.share_saturated(rewards),
        "fallen": reward_quality.share_fallen(scores),
    }
    if still is not None:
        figures["still"] = reward_quality.share_unchanged(still)
    if frames is not None:
        figures["contradictory"] = reward_quality.share_contradictory(after_actions, frames)
    if truth is not None:
        returns, targets = reward_quality.returns_of(rewards), true_returns(truth)
        figures["spearman"] = statistics.spearman(returns, targets)
        figures["pairwise"] = reward_quality.pairwise_accuracy(returns, targets)
    return figures


def all_score_alike(rewards: Sequence[FloatArray]) -> bool:
    """Whether all rewards are equal up to rounding."""
    values = np.concatenate(rewards)
    return bool(np.ptp(values) <= FLAT * np.abs(values).max())


def correlation_with_length(rewards: Sequence[FloatArray]) -> float:
    """Return Spearman's ρ of the returns and the numbers of steps; 0 where all episodes are equally long."""
    lengths = np.array([len(episode) for episode in rewards])
    if np.ptp(lengths) == 0:
        return 0.0
    return statistics.spearman(reward_quality.returns_of(rewards), lengths, n_resamples=1).value


def ends_lower(share: float) -> str:
    """Return the warning of `FALLEN`."""
    return (
        f"{share:.0%} of the episodes end with a lower score than they began with: the goal is not what they lead to, "
        "or some of its pictures mislead. Of many pictures, `--goal-share 0.2` keeps those that the episodes end "
        "nearest to."
    )


def reward_warnings(rewards: Sequence[FloatArray], figures: Mapping[str, Estimate]) -> list[str]:
    """Return sentences that speak against training on these rewards, if any.

    Args:
        rewards: (T,) per episode.
        figures: of `measure_rewards`.
    """
    if all_score_alike(rewards):
        return ["All frames score the same: this goal and embedder tell nothing apart. Look at the goal's pictures."]
    sentences = []
    returns, lengths = reward_quality.returns_of(rewards), np.array([len(episode) for episode in rewards])
    if np.ptp(returns) == 0:
        sentences.append("All episodes have the same return: there is nothing to condition a policy on.")
    by_length = correlation_with_length(rewards)
    if abs(by_length) >= LENGTH:
        sentences.append(
            f"Episodes are {lengths.min()} to {lengths.max()} steps long, and their returns follow the length (ρ = "
            f"{by_length:.2f}): a sum of levels rewards a long episode whatever it shows. Let all last equally long, "
            "or reward the change of the score (`--reward difference`)."
        )
    if "contradictory" in figures and figures["contradictory"].value >= CONTRADICTORY:
        sentences.append(
            f"{figures['contradictory'].value:.0%} of the frames score otherwise than an equal frame of the same "
            "episode: these scores are not of these episodes (shuffled?)."
        )
    if figures["told_by_step"].value >= CLOCK:
        sentences.append(
            "The number of the step alone tells the score: the reward is a clock, whatever the robot does."
        )
    elif figures["straight_in_time"].value >= STRAIGHT:
        sentences.append(
            "In every episode, good or bad, the score is nearly proportional to time: it may tell how long the robot "
            "has moved rather than how near the goal is."
        )
    if figures["saturated"].value >= SATURATED:
        sentences.append("Nearly all frames score next to the lowest or the highest: most progress is not rewarded.")
    if "still" in figures and figures["still"].value >= STILL:
        sentences.append("Most frames show what the first one shows: nothing moves, or the cameras do not see it.")
    if figures["fallen"].value >= FALLEN:
        sentences.append(ends_lower(figures["fallen"].value))
    rho = figures.get("spearman")
    if rho is not None and np.isnan(rho.value):
        if np.ptp(returns) > 0:
            sentences.append(
                "All true returns are equal, so they rank nothing: the verdict goes by the rules without ground truth."
            )
    elif rho is not None and not rho.low > 0:
        against = " The higher the return, the worse the episode." if rho.high < 0 else ""
        sentences.append(
            f"The returns do not rank the episodes as the true ones do: ρ = {rho.value:.2f}, "
            f"95 % interval {rho.low:.2f} to {rho.high:.2f}.{against}"
        )
    return sentences
