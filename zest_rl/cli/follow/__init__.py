"""``zest follow``: an episode that reaches several goals → its similarity to each of them over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from zest_rl.cli.config import expand_variables
from zest_rl.cli.follow.arguments import KitchenArguments, VideoArguments
from zest_rl.cli.ui import Ui, progress_in_parts

CONFIGS: dict[str, type[Any]] = {config.what: config for config in (KitchenArguments, VideoArguments)}


def run(config: KitchenArguments | VideoArguments, ui: Ui) -> dict[str, Any]:
    """Score the episode by each sub-goal and write the page."""
    from zest_rl.analysis.sub_goals import follow_kitchen, follow_video, rise_in_order
    from zest_rl.report.html import write_report
    from zest_rl.report.sub_goal_page import sub_goal_report
    from zest_rl.rewards.goals import TEXT
    from zest_rl.runtime import artifacts

    given = {name: value for name, value in vars(config).items() if name != "output"}
    if isinstance(config, KitchenArguments):
        with progress_in_parts(ui, "sub-goals") as on_progress:
            sub_goals = follow_kitchen(**given, on_progress=on_progress)
    else:
        given["clip"] = expand_variables(config.clip)
        given["goals"] = [g if g.startswith(TEXT) else str(expand_variables(Path(g))) for g in config.goals]
        sub_goals = follow_video(**given)
    in_order = rise_in_order(sub_goals)
    if not in_order:
        ui.warn("the scores do not rise in the order of the sub-goals; look at the page")
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in vars(config).items()}
    details: dict[str, object] = {"settings": settings, "provenance": artifacts.provenance()}
    page = write_report(sub_goal_report(sub_goals, details), config.output)
    return {
        "follow": config.what,
        "sub_goals": {sub_goal.name: sub_goal.as_json() for sub_goal in sub_goals},
        "in_order": in_order,
        "settings": settings,
        "report": str(page),
        "next": f"open {page} in a browser",
    }


def summary(result: Mapping[str, Any]) -> str:
    """One line per sub-goal, as text."""
    lines = [
        f"  {name:<16} "
        + _rise(times)
        + f", highest at {times['highest_at']:>3}"
        + ("" if times["done_at"] is None else f", done at {times['done_at']:>3}")
        for name, times in result["sub_goals"].items()
    ]
    has_signal = any(times["signal"] for times in result["sub_goals"].values())
    order = ("yes" if result["in_order"] else "no") if has_signal else "no signal"
    return "\n".join([*lines, f"in the order of the sub-goals: {order}", f"report: {result['report']}"])


def _rise(times: Mapping[str, Any]) -> str:
    if not times["signal"]:
        return "no signal"
    return "never rises" if times["rises_at"] is None else f"rises at step {times['rises_at']:>3}"
