"""``zest select``: of the frames that score highest by a goal, how many are right?

`frames`: in datasets of the kitchen, for goals and for actions. `clips`: in real video.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from zest_rl.cli.select import clips, frames
from zest_rl.cli.select.clip_arguments import ClipArguments
from zest_rl.cli.select.frame_arguments import ActionArguments, GoalArguments
from zest_rl.cli.ui import Ui

CONFIGS: dict[str, type[Any]] = {config.what: config for config in (GoalArguments, ActionArguments, ClipArguments)}


def run(config: GoalArguments | ActionArguments | ClipArguments, ui: Ui) -> dict[str, Any]:
    """Score candidates by the goal and judge the highest scores."""
    return clips.run(config, ui) if isinstance(config, ClipArguments) else frames.run(config, ui)


def summary(result: Mapping[str, Any]) -> str:
    """The figures as text."""
    return clips.summary(result) if result["select"] == ClipArguments.what else frames.summary(result)
