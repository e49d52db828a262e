"""Relabeled datasets → figures that judge their rewards before training. Reads ground truth, if there is any."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.analysis.reward_figures import VIEW_CANNOT_TELL, measure_rewards, reward_warnings, true_returns
from zest_rl.analysis.verdict import Verdict, judge
from zest_rl.data.folders import METADATA_FILE
from zest_rl.data.provenance import RelabelRecord
from zest_rl.data.reader import open_dataset
from zest_rl.errors import BadInput
from zest_rl.kitchen.views import Views, canonical_states
from zest_rl.metrics.reward_quality import returns_of
from zest_rl.metrics.statistics import MIN_EPISODES_TO_RANK, Estimate
from zest_rl.runtime.privacy import masked
from zest_rl.runtime.records import reading_record
from zest_rl.types import FloatArray, GroundTruth


@dataclass(frozen=True)
class Inspection:
    """The verdict, figures and warnings of one dataset's rewards."""

    dataset_id: str
    task: str
    """Kitchen task; of another robot, the id of the dataset that was relabeled."""
    relabel: RelabelRecord
    """How it was relabeled."""
    verdict: Verdict
    figures: Mapping[str, Estimate]
    """By the keys of `FIGURES`; those that need ground truth or states are missing where there are none."""
    warnings: tuple[str, ...]
    over_time: Mapping[str, FloatArray]
    """Mean reward at each step (T,), of successes and failures; without ground truth, of all episodes."""
    returns: NDArray[np.float64]
    """(N,) sums of the rewards."""
    true_returns: NDArray[np.float64] | None
    """(N,); None without ground truth."""
    score_range: tuple[float, float]
    """The lowest and the highest score of any frame."""
    states: list[NDArray[np.float64]] | None
    """(T+1, nq) simulator positions per episode; None outside the kitchen."""
    suits_agents: bool
    """Whether the package's agents can learn from it."""

    def known_figures(self) -> dict[str, Estimate | None]:
        """Return the figures by key, None where one is undefined, as for constant scores."""
        return {key: None if np.isnan(estimate.value) else estimate for key, estimate in self.figures.items()}


def inspect(dataset_id: str) -> Inspection:
    """Judge the rewards of a relabeled dataset.

    Raises:
        BadInput: there is no such dataset, it was not relabeled, or it has fewer than 3 episodes.
    """
    with open_dataset(dataset_id) as ds:
        record = ds.record.relabel
        if record is None:
            raise BadInput(
                f"dataset {dataset_id} holds no ZeST scores; run `zest relabel {dataset_id}` and inspect that"
            )
        rewards, scores = ds.rewards(), ds.scores()
        if len(rewards) < MIN_EPISODES_TO_RANK:
            raise BadInput(
                f"rewards can be judged on at least {MIN_EPISODES_TO_RANK} episodes, {dataset_id} has {len(rewards)}"
            )
        with reading_record(ds.path / METADATA_FILE, "relabel the dataset again"):
            views = None if record.scorer.views is None else Views.from_record(record.scorer.views)
        states = None if views is None else ds.states()
        truth = ds.truth() if ds.has_truth else None
        suits_agents = ds.suits_agents
    frames, still = (None, None) if views is None or states is None else rendered_frames(states, views)
    if (record.scorer.features, record.scorer.similarity) == ("delta", "cos") and record.shuffle is None:
        still = still or unchanged(scores)
    figures = measure_rewards(rewards, scores, frames, still, truth)
    warnings = reward_warnings(rewards, figures)
    if record.shuffle is not None:
        warnings.insert(0, "These are the scores of other episodes: the dataset was relabeled with --shuffle.")
    if record.view_cannot_tell:
        warnings.append(VIEW_CANNOT_TELL)
    return Inspection(
        dataset_id,
        record.source if views is None else views.task,
        record,
        judge(rewards, figures, shuffled=record.shuffle is not None, view_cannot_tell=record.view_cannot_tell),
        figures,
        tuple(warnings),
        _over_time(rewards, truth),
        returns_of(rewards),
        None if truth is None else true_returns(truth),
        (float(min(map(np.min, scores))), float(max(map(np.max, scores)))),
        states,
        suits_agents,
    )


def rendered_frames(
    states: Sequence[NDArray[np.float64]], views: Views
) -> tuple[list[NDArray[np.float64]], list[NDArray[np.bool_]]]:
    """Return of each episode (T+1, nq) the states after each action as they are rendered, and which equal the first."""
    rendered = [canonical_states(episode, views) for episode in states]
    return [episode[1:] for episode in rendered], [(episode[1:] == episode[0]).all(axis=1) for episode in rendered]


def unchanged(scores: Sequence[FloatArray]) -> list[NDArray[np.bool_]]:
    """Return which frames of each episode equal the first one, by their scores (T+1,) of cosines of changes."""
    return [episode[1:] == 0 for episode in scores]  # nothing else scores exactly 0


def _over_time(rewards: list[FloatArray], truth: list[GroundTruth] | None) -> dict[str, FloatArray]:
    groups = {"all episodes": rewards}
    if truth is not None and truth[0].success is not None:
        outcomes = list(zip(truth, rewards, strict=True))
        groups = {
            "successes": [curve for episode, curve in outcomes if episode.success],
            "failures": [curve for episode, curve in outcomes if not episode.success],
        }
    return {name: _mean_by_step(group) for name, group in groups.items() if group}


def _mean_by_step(rewards: Sequence[FloatArray]) -> FloatArray:
    """Return the mean at each step over the episodes that reach it: (T of the longest,)."""
    total, count = np.zeros(max(map(len, rewards))), np.zeros(max(map(len, rewards)))
    for episode in rewards:
        total[: len(episode)] += episode
        count[: len(episode)] += 1
    return np.asarray(total / count, dtype=np.float32)


def labels(inspections: Sequence[Inspection]) -> list[str]:
    """Name each by task and goal, and by the settings that differ among those of the same task and goal."""
    names = names_with_settings([(f"{each.task} by {_goal(each)}", _settings(each)) for each in inspections])
    return [
        f"{name} ({each.dataset_id})" if names.count(name) > 1 else name
        for name, each in zip(names, inspections, strict=True)
    ]


def names_with_settings(described: Sequence[tuple[str, Mapping[str, Any]]]) -> list[str]:
    """Append to each name the settings that differ among those of equal name."""
    names = []
    for name, settings in described:
        namesakes = [other for other_name, other in described if other_name == name]
        differing = [(k, v) for k, v in settings.items() if any(other.get(k) != v for other in namesakes)]
        names.append(", ".join([name, *(f"{k} {v}" for k, v in differing)]))
    return names


def _goal(inspection: Inspection) -> str:
    goal = Path(inspection.relabel.scorer.goal)
    return goal.name if goal.is_absolute() else inspection.relabel.scorer.goal


def _settings(inspection: Inspection) -> dict[str, Any]:
    """Return the settings in which rewards of one task and goal may differ, by their name in a label."""
    record, scorer = inspection.relabel, inspection.relabel.scorer
    return {
        "embedder": masked(scorer.embedder),
        "features": scorer.features,
        "similarity": scorer.similarity,
        "views": record.n_views,
        "share of goals": scorer.goal_share,
        "reward": record.reward if record.learned is None else f"learned of {record.learned['inputs']}",
        "shuffled": "no" if record.shuffle is None else record.shuffle,
    }
