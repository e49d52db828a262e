"""``zest select goals`` and ``zest select actions``: does a goal find the frames of datasets that reach it?"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from zest_rl.cli.select.frame_arguments import ActionArguments, GoalArguments
from zest_rl.cli.ui import Ui, progress_in_parts


def run(config: GoalArguments | ActionArguments, ui: Ui) -> dict[str, Any]:
    """Draw candidates, score them, judge the highest scores."""
    from zest_rl.analysis.frame_selection import select_frames

    def warn() -> None:
        ui.warn("all trajectories start with the same picture, so x_0 of another one changes nothing; try --show-robot")

    with progress_in_parts(ui, "rendering and embedding") as on_progress:
        selected = select_frames(ask=config.what, **vars(config), on_alike_starts=warn, on_progress=on_progress)
    return {
        "select": config.what,
        "task": selected.task,
        "goal": config.goal,
        **selected.as_json(),
        "next": f"zest relabel {config.datasets[0]} --goal {shlex.quote(config.goal)}",
    }


def summary(result: Mapping[str, Any]) -> str:
    """What was found, as text."""

    def figure(name: str) -> str:
        low, high = result[name]["ci95"]
        return f"{result[name]['value']:.1%}  [{low:.1%}, {high:.1%}]"

    return "\n".join(
        [
            f"{result['task']} by {result['goal']}: "
            f"{result['n_satisfying']} of {result['n_candidates']} candidates satisfy it",
            f"  Top-{result['top']} success      {figure('top_n_success')}",
            f"  picking at random   {result['goal_frame_ratio']:.1%}  ({result['times_random']:.1f} times as good)",
            f"  total variation     {result['dataset_total_variation']['value']:.6f}, "
            f"{figure('relative_variation')} of the largest",
        ]
    )
