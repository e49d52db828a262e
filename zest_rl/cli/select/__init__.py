"""``zest select goals`` and ``zest select actions``: does a goal find the frames that reach it in a dataset?

``zest select footage`` asks the same of real video.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import tyro

from zest_rl.cli.select import footage
from zest_rl.cli.ui import Ui, progress_in_parts
from zest_rl.errors import BadInput
from zest_rl.rewards.scores import Features, Similarity, check_names


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What both selections need."""

    what: ClassVar[str]
    datasets: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATASET [DATASET …]")] = ()
    """Kitchen datasets whose frames are the candidates: one (narrow) or several tasks (diverse)."""
    task: str | None = None
    """What the goal is of; default the task of the first dataset."""
    goal: str = "same-scene"
    """As in `zest relabel`."""
    embedder: str = "efficientnet-lite0"
    """As in `zest relabel`."""
    features: Features = "delta"
    """Compare changes against the start, or the frames themselves; or a reward to compare with: VLM-RM's regularised
    similarity, the share of the distance to the goal that is covered, a classifier of goal against start."""
    similarity: Similarity = "cos"
    """Cosine, or minus the Euclidean distance."""
    views: int = 8
    """Cameras around the object; scores are averaged over them."""
    show_robot: bool = False
    """Keep the robot in view (the paper removes it)."""
    tolerance: float = 1e-3
    """As in `zest relabel`."""
    top: int = 25
    """N of the Top-N success rate; at most as many as candidates satisfy the goal."""
    n_frames: int = 500
    """Candidates drawn from each dataset."""
    n_goals: int | None = None
    """Pictures of the goal drawn per repeat; default all."""
    n_repeats: int = 5
    """Samples of the goal's pictures and of x_0 to average over; 1 when nothing is drawn."""
    seed: int = 0
    """Of the candidates."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Of the embedder."""
    n_workers: int | None = None
    """Processes; default one per core."""

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        if min(self.top, self.n_repeats, self.n_frames, self.views) < 1:
            raise BadInput(
                f"top, n_repeats, n_frames and views must be at least 1, got {self.top}, {self.n_repeats}, "
                f"{self.n_frames} and {self.views}"
            )


@dataclass(frozen=True, kw_only=True)
class GoalArguments(Arguments):
    """Goal selection (Cui et al. §4.1): do the frames that score highest reach the goal?"""

    what: ClassVar[str] = "goals"
    context: Literal["same", "different"] = "same"
    """x_0 of a candidate: of its own trajectory, or of another one."""


@dataclass(frozen=True, kw_only=True)
class ActionArguments(Arguments):
    """Action selection (Cui et al. §4.2): is what happens in the frames that score highest the goal's action, done to
    whatever object? Opening a cabinet counts for opening the microwave.
    """

    what: ClassVar[str] = "actions"


CONFIGS: dict[str, type[Any]] = {
    config.what: config for config in (GoalArguments, ActionArguments, footage.FootageArguments)
}


def run(config: Arguments | footage.FootageArguments, ui: Ui) -> dict[str, Any]:
    """Draw candidates, score them, judge the highest scores."""
    if isinstance(config, footage.FootageArguments):
        return footage.run(config, ui)
    from functools import partial

    from zest_rl.analysis.frame_selection import draw_candidates, score_as_actions, score_as_goals
    from zest_rl.kitchen.tasks import get_task
    from zest_rl.kitchen.views import Views
    from zest_rl.metrics import selection
    from zest_rl.rewards.scorer import ScorerConfig

    if not config.datasets:
        raise BadInput("`zest select` needs at least 1 dataset; `zest collect` makes them")
    candidates = draw_candidates(config.datasets, config.n_frames, config.seed)
    task = get_task(config.task or candidates.task[0])
    satisfies = candidates.satisfies(task) if isinstance(config, GoalArguments) else candidates.does(task)
    if satisfies.sum() < config.top:
        raise BadInput(
            f"only {satisfies.sum()} of {len(satisfies)} candidates satisfy the goal of {task.name!r}, so the highest "
            f"{config.top} could not all; give more --n-frames, a smaller --top, or a dataset with more successes"
        )
    views = Views(task.name, config.views, robot=config.show_robot, tolerance=config.tolerance)
    scorer = ScorerConfig(config.goal, config.embedder, config.features, config.similarity, config.precision)
    if isinstance(config, GoalArguments) and config.context == "different" and candidates.start_alike(views):
        ui.warn("all trajectories start with the same picture, so x_0 of another one changes nothing; try --show-robot")
    drawn = config.n_goals is not None or (isinstance(config, GoalArguments) and config.context == "different")
    options: dict[str, Any] = {
        "n_repeats": config.n_repeats if drawn else 1, "n_goals": config.n_goals, "n_workers": config.n_workers,
    }  # fmt: skip
    with progress_in_parts(ui, "rendering and embedding") as on_progress:
        if isinstance(config, GoalArguments):
            scores = score_as_goals(
                candidates, scorer, views, context=config.context, on_progress=on_progress, **options
            )
        else:
            scores = score_as_actions(candidates, scorer, views, on_progress=on_progress, **options)
    measures: dict[str, selection.Measure] = {
        "top_n_success": partial(selection.top_up_to, n=config.top),
        "dataset_total_variation": selection.dataset_total_variation,
        "relative_variation": selection.relative_variation,
    }
    found = {
        name: selection.over_trajectories(measure, scores, satisfies, candidates.trajectory)
        for name, measure in measures.items()
    }
    chance = selection.goal_frame_ratio(satisfies)
    return {
        "select": config.what,
        "task": task.name,
        "goal": config.goal,
        "top": config.top,
        "n_repeats": len(scores),
        "top_n_by_repeat": [selection.top_up_to(row, satisfies, config.top) for row in scores],
        **{name: one.as_json() for name, one in found.items()},
        "goal_frame_ratio": chance,
        "times_random": found["top_n_success"].value / chance,
        "n_candidates": len(satisfies),
        "n_satisfying": int(satisfies.sum()),
        "next": f"zest relabel {config.datasets[0]} --goal {shlex.quote(config.goal)}",
    }


def summary(result: Mapping[str, Any]) -> str:
    """What was found, as text."""
    if result["select"] == "footage":
        return footage.summary(dict(result))

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
