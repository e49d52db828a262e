"""The page of an episode with several sub-goals: all curves in one chart, and a strip of frames per sub-goal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from zest_rl.analysis.sub_goals import SubGoalScores, rise_in_order
from zest_rl.report.content import Curve, Strip
from zest_rl.report.sections import DETAILS, FRAMES, SUB_GOALS, Report


def sub_goal_report(sub_goals: Sequence[SubGoalScores], details: dict[str, object]) -> Report:
    """Build the page of one episode."""
    steps = np.arange(len(sub_goals[0].scores), dtype=np.float32)
    order = "rise one after another, in the order of" if rise_in_order(sub_goals) else "do not rise in the order of"
    rises = [
        f"{sub_goal.name} {'never' if sub_goal.rises_at is None else f'at step {sub_goal.rises_at}'}"
        + ("" if sub_goal.done_at is None else f" (done at {sub_goal.done_at})")
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
    curves = (Curve(sub_goal.name, "similarity to the sub-goal", steps, sub_goal.scores) for sub_goal in sub_goals)
    return Report(
        "Similarity to each sub-goal",
        f"The scores {order} the sub-goals: {', '.join(rises)}.",
        (FRAMES(strips), SUB_GOALS(curves), DETAILS(details.items())),
    )
