"""The page of an episode with several sub-goals: all curves in one chart, and a strip of frames per sub-goal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from zest_rl.analysis.sub_goals import SubGoalScores, rise_in_order
from zest_rl.report.content import Series, Strip
from zest_rl.report.sections import DETAILS, FRAMES, SUB_GOALS, Report


def sub_goal_report(sub_goals: Sequence[SubGoalScores], details: dict[str, object]) -> Report:
    """Build the page of one episode."""
    steps = np.arange(len(sub_goals[0].scores), dtype=np.float32)
    if not any(sub_goal.has_signal for sub_goal in sub_goals):
        order = "There is no signal, as no score tells anything of the next"
    elif rise_in_order(sub_goals):
        order = "The scores rise one after another, in the order of the sub-goals"
    else:
        order = "The scores do not rise in the order of the sub-goals"
    rises = [
        f"{sub_goal.name} {sub_goal.rises}" + ("" if sub_goal.done_at is None else f" (done at {sub_goal.done_at})")
        for sub_goal in sub_goals
    ]
    strips = (
        Strip(
            sub_goal.name,
            sub_goal.frames,
            sub_goal.steps,
            (sub_goal.scores[sub_goal.steps] - sub_goal.scores.min()) / (np.ptp(sub_goal.scores) or 1.0),
        )
        for sub_goal in sub_goals
    )
    curves = (Series(sub_goal.name, "similarity to the sub-goal", steps, sub_goal.scores) for sub_goal in sub_goals)
    return Report(
        "Similarity to each sub-goal",
        f"{order}: {', '.join(rises)}.",
        (FRAMES(strips), SUB_GOALS(curves), DETAILS(details.items())),
    )
