"""A relabeled dataset → the pictures or sentences of its goal, and how its rewards rank episodes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from zest_rl.analysis.reward_figures import true_returns
from zest_rl.data.folders import GOAL_FOLDER
from zest_rl.data.images import list_images, read_image
from zest_rl.data.provenance import RelabelRecord
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput
from zest_rl.kitchen.tasks import get_task
from zest_rl.metrics.reward_quality import returns_of
from zest_rl.metrics.statistics import MIN_EPISODES_TO_RANK, Estimate, Values, spearman
from zest_rl.report.content import GoalPanel, Scatter
from zest_rl.rewards.goals import TASK_TEXT, TEXT, read_goal, read_text


def goal_scatter(name: str, ds: Dataset) -> Scatter:
    """Plot the returns by a relabeled dataset's rewards against the ground-truth returns."""
    returns, truth = returns_of(ds.rewards()), true_returns(ds.truth())
    rho = Estimate(math.nan, math.nan, math.nan)
    if len(returns) >= MIN_EPISODES_TO_RANK:
        rho = spearman(returns, truth)
    return return_scatter(name, returns, truth, rho)


def return_scatter(name: str, returns: Values, truth: Values, rho: Estimate) -> Scatter:
    """Plot returns (N,) by the rewards against the true ones (N,), with their rank correlation."""
    return Scatter(name, truth.astype(np.float32), returns.astype(np.float32), rho.value, (rho.low, rho.high))


def goal_panel(name: str, record: RelabelRecord, folder: Path, scatter: Scatter | None = None) -> GoalPanel:
    """Return the goal of a relabeled dataset, as pictures or sentences; pictures need not have come with it.

    Args:
        name: of the goal in the report.
        record: how the dataset was relabeled.
        folder: of the dataset.
        scatter: how the goal ranks episodes, if known.

    Raises:
        BadInput: the goals that were kept are none of its goals.
    """
    ranking = (None, 0) if scatter is None else (scatter.spearman, len(scatter.x))
    if (folder / GOAL_FOLDER).is_dir():
        start, goal = (
            tuple(read_image(path) for path in list_images(folder / GOAL_FOLDER / part)) for part in ("init", "goal")
        )
        return GoalPanel(name, start, goal, *ranking)
    views, spec = record.scorer.views, record.scorer.goal
    if not (spec == TASK_TEXT or spec.startswith(TEXT)):  # a dataset names no other folders to read
        absent = ("pictures that did not come with the dataset",)
        return GoalPanel(name, absent, absent, *ranking)
    sentences = read_text(spec) if views is None else read_goal(spec, get_task(views["task"]))
    n_goals = len(sentences.goals)
    kept = range(n_goals) if record.kept_goals is None else record.kept_goals
    if not set(kept) <= set(range(n_goals)):
        raise BadInput(f"kept_goals in {folder} must be of the {n_goals} goals of {spec!r}, got {record.kept_goals}")
    return GoalPanel(name, sentences.starts, tuple(sentences.goals[k] for k in kept), *ranking)
