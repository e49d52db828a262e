"""``zest follow``: an episode that reaches several goals → its similarity to each of them over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from zest_rl.cli.config import expand_variables
from zest_rl.cli.ui import Ui
from zest_rl.rewards.scores import Features, Similarity, check_names

if TYPE_CHECKING:
    from zest_rl.analysis.sub_goals import SubGoalScores


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What both kinds of episode need."""

    what: ClassVar[str]
    embedder: str = "efficientnet-lite0"
    """As in `zest relabel`."""
    features: Features = "delta"
    """As in `zest relabel`."""
    similarity: Similarity = "cos"
    """As in `zest relabel`."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Of the embedder."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, …"""
    output: Path = Path("follow.html")
    """The HTML page."""

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)


@dataclass(frozen=True, kw_only=True)
class KitchenArguments(Arguments):
    """Experts do several kitchen tasks one after another; each task is a sub-goal, seen from its own views."""

    what: ClassVar[str] = "kitchen"
    tasks: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TASK TASK …")]
    """In the order in which they are done."""
    goal: str = "same-scene"
    """As in `zest relabel`, of every task."""
    views: int = 8
    """Cameras around the object; scores are averaged over them."""
    tolerance: float = 1e-3
    """As in `zest relabel`."""
    seed: int = 0
    """Of the arm's start."""
    n_workers: int | None = None
    """Processes that embed; default one per core."""


@dataclass(frozen=True, kw_only=True)
class VideoArguments(Arguments):
    """A video, or a folder of pictures in the order of their names; each sub-goal is a picture (the video's first frame
    is its start), a folder with init/ and goal/, or "text:START -> GOAL". In a recipe, $NAME in a path stands for an
    environment variable.
    """

    what: ClassVar[str] = "video"
    clip: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="VIDEO")]
    """What to follow."""
    goals: tuple[str, ...]
    """Sub-goals, in the order in which they should be reached."""
    n_frames: int = 100
    """Frames that are looked at, evenly spaced; a shorter video gives all it has."""


CONFIGS: dict[str, type[Any]] = {config.what: config for config in (KitchenArguments, VideoArguments)}


def run(config: KitchenArguments | VideoArguments, ui: Ui) -> dict[str, Any]:
    """Score the episode by each sub-goal and write the page."""
    from zest_rl.analysis.sub_goals import rise_in_order
    from zest_rl.report.html import write_report
    from zest_rl.report.sub_goal_page import sub_goal_report
    from zest_rl.runtime import artifacts

    sub_goals = _kitchen(config, ui) if isinstance(config, KitchenArguments) else _video(config)
    in_order = rise_in_order(sub_goals)
    if not in_order:
        ui.warn("the scores do not rise in the order of the sub-goals; look at the page")
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(config).items()}
    page = write_report(
        sub_goal_report(sub_goals, {"settings": settings, "provenance": artifacts.provenance()}), config.output
    )
    return {
        "follow": config.what,
        "sub_goals": {sub_goal.name: sub_goal.as_json() for sub_goal in sub_goals},
        "in_order": in_order,
        "settings": settings,
        "report": str(page),
        "next": f"open {page} in a browser",
    }


def _kitchen(config: KitchenArguments, ui: Ui) -> list[SubGoalScores]:
    from zest_rl.analysis.sub_goals import score_performance
    from zest_rl.kitchen.task_sequence import perform
    from zest_rl.kitchen.views import Views
    from zest_rl.rewards.scorer import ScorerConfig
    from zest_rl.rewards.state_scorer import StateScorer

    performance = perform(config.tasks, config.seed)

    def build(task: str) -> StateScorer:
        views = Views(task, config.views, tolerance=config.tolerance)
        scorer = ScorerConfig(config.goal, config.embedder, config.features, config.similarity, config.precision)
        return StateScorer.build(scorer, views, performance.states[0], device=config.device, n_workers=config.n_workers)

    with ui.progress("sub-goals", len(config.tasks)) as advance:
        return score_performance(performance, build, advance)


def _video(config: VideoArguments) -> list[SubGoalScores]:
    from zest_rl.analysis.sub_goals import score_video
    from zest_rl.embedders import load_embedder
    from zest_rl.rewards.goals import TEXT

    embedder = load_embedder(config.embedder, device=config.device, precision=config.precision)
    goals = [goal if goal.startswith(TEXT) else str(expand_variables(Path(goal))) for goal in config.goals]
    clip = expand_variables(config.clip)
    return score_video(clip, goals, embedder, config.n_frames, config.features, config.similarity)


def summary(result: Mapping[str, Any]) -> str:
    """One line per sub-goal, as text."""
    lines = [
        f"  {name:<16} "
        + ("never rises" if one["rises_at"] is None else f"rises at step {one['rises_at']:>3}")
        + f", highest at {one['highest_at']:>3}"
        + ("" if one["done_at"] is None else f", done at {one['done_at']:>3}")
        for name, one in result["sub_goals"].items()
    ]
    return "\n".join(
        [
            *lines,
            f"in the order of the sub-goals: {'yes' if result['in_order'] else 'no'}",
            f"report: {result['report']}",
        ]
    )
