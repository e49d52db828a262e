"""Is a reward worth training on? One line, and the two figures that decide; docs/inspect.md explains the rules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from zest_rl.analysis.reward_figures import (
    CLOCK,
    CONTRADICTORY,
    FIGURES,
    LENGTH,
    STILL,
    STRAIGHT,
    all_score_alike,
    correlation_with_length,
)
from zest_rl.metrics.reward_quality import returns_of
from zest_rl.metrics.statistics import Estimate
from zest_rl.types import FloatArray

Advice = Literal["train on it", "do not", "too few episodes to tell"]
MIN_EPISODES = 5
"""Chance orders four episodes rightly once in 24 times."""
RANKS = 0.5
"""Rank correlation with the true returns from which on a reward is good."""
RISES, FALLS = 0.25, 0.25
"""Scores rise where the whole interval of their rank correlation with time lies above the first: whatever drifts away
from the start correlates a little. They do not where a larger share of the episodes than the second ends lower."""
_LABELS = {figure.key: figure.label for figure in FIGURES}


@dataclass(frozen=True)
class Verdict:
    """What to do with a reward, and why. `str` gives the line that `zest inspect` prints first."""

    advice: Advice
    why: str
    figures: Mapping[str, Estimate]
    """Those that decided, by their names."""

    def __str__(self) -> str:
        decisive = [f"{name} {_with_interval(estimate)}" for name, estimate in self.figures.items()]
        return "; ".join([f"{self.advice}: {self.why}", *decisive])

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Read what `to_json` returned."""
        figures = {name: Estimate(each["value"], *each["ci95"]) for name, each in values["figures"].items()}
        return cls(values["advice"], values["why"], figures)

    def to_json(self) -> dict[str, Any]:
        """Return the form that it has in the result of `zest inspect --json`."""
        figures = {name: estimate.as_json() for name, estimate in self.figures.items()}
        return {"advice": self.advice, "why": self.why, "figures": figures}


def _with_interval(estimate: Estimate) -> str:
    interval = "" if estimate.low == estimate.high else f" [{estimate.low:.2f}, {estimate.high:.2f}]"
    return f"{estimate.value:.2f}{interval}"


def judge(
    rewards: Sequence[FloatArray],
    figures: Mapping[str, Estimate],
    *,
    shuffled: bool = False,
    view_cannot_tell: bool = False,
) -> Verdict:
    """Return the verdict on the rewards of a dataset.

    The first rule that applies decides: rewards that tell nothing or are of other episodes; too few episodes; with
    ground truth, how the returns rank the episodes; without, rewards that follow something else than the goal, and
    whether scores rise in an episode.

    Args:
        rewards: (T,) per episode.
        figures: of `measure_rewards`.
        shuffled: whether the dataset was relabeled with ``--shuffle``.
        view_cannot_tell: see `zest_rl.rewards.scorer.Scorer.view_cannot_tell`.
    """

    def decided(advice: Advice, why: str, *keys: str) -> Verdict:
        known = [key for key in keys if key in figures and not np.isnan(figures[key].value)]
        return Verdict(advice, why, {_LABELS[key]: figures[key] for key in known})

    def extremes(what: str, values: NDArray[Any]) -> dict[str, Estimate]:
        ends = {"lowest": float(values.min()), "highest": float(values.max())}
        return {f"{name} {what}": Estimate(value, value, value) for name, value in ends.items()}

    n, returns = len(rewards), returns_of(rewards)
    if all_score_alike(rewards):
        return Verdict("do not", "all frames score the same", extremes("reward", np.concatenate(rewards)))
    if np.ptp(returns) == 0:
        return Verdict("do not", "all episodes have the same return", extremes("return", returns))
    if shuffled or ("contradictory" in figures and figures["contradictory"].value >= CONTRADICTORY):
        return decided("do not", "these are the scores of other episodes", "contradictory", "spearman")
    direction = ("value_order", "fallen")
    rho = figures.get("spearman")
    if rho is not None and np.isnan(rho.value):  # all true returns are equal and rank nothing
        rho = None
    if n < MIN_EPISODES:
        keys = direction if rho is None else ("spearman", "pairwise")
        return decided("too few episodes to tell", f"{n}, and {MIN_EPISODES} are the least", *keys)
    if rho is not None:
        return decided(*_by_truth(rho, n), "spearman", "pairwise")
    if view_cannot_tell:
        return decided("do not", "one view that shows the robot cannot tell what the goal changes", *direction)
    by_length = correlation_with_length(rewards)
    if abs(by_length) >= LENGTH:
        lengths = extremes("number of steps", np.array([len(episode) for episode in rewards]))
        return Verdict("do not", f"the returns follow the episodes' length, ρ = {by_length:.2f}", lengths)
    for key, limit, why in (
        ("told_by_step", CLOCK, "the step number alone tells the score, whatever the robot does"),
        ("straight_in_time", STRAIGHT, "in every episode, good or bad, the score is proportional to time"),
        ("still", STILL, "most frames show what the first one shows"),
    ):
        if key in figures and figures[key].value >= limit:
            return decided("do not", why, key, "value_order")
    return decided(*_by_direction(figures["value_order"], figures["fallen"], n), *direction)


def _by_truth(rho: Estimate, n: int) -> tuple[Advice, str]:
    if rho.high < 0:
        return "do not", "the higher the return, the worse the episode"
    if rho.high < RANKS:
        return "do not", f"the returns hardly rank the {n} episodes as the true ones do"
    if rho.value >= RANKS and rho.low > 0:
        return "train on it", f"the returns rank the {n} episodes as the true ones do"
    return "too few episodes to tell", f"{n} leave open whether the returns rank them as the true ones do"


def _by_direction(order: Estimate, fallen: Estimate, n: int) -> tuple[Advice, str]:
    if order.high <= 0 or fallen.low > FALLS:
        return "do not", f"in the {n} episodes the score does not rise, so the goal is not what they lead to"
    if order.low >= RISES and fallen.value <= FALLS:
        return "train on it", f"in the {n} episodes the score rises; no ground truth ranks them"
    return "too few episodes to tell", f"{n} leave open whether the score rises in an episode"
