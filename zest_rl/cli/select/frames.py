"""``zest select goals`` and ``zest select actions``: does a goal find the frames of datasets that reach it?"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import tyro

from zest_rl.cli.ui import Ui, progress_in_parts
from zest_rl.errors import BadInput
from zest_rl.rewards.scores import Features, Similarity, check_names


@dataclass(frozen=True, kw_only=True)
class FrameArguments:
    """What both selections need."""

    what: ClassVar[Literal["goals", "actions"]]
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
class GoalArguments(FrameArguments):
    """Goal selection (Cui et al. §4.1): do the frames that score highest reach the goal?"""

    what: ClassVar[Literal["goals", "actions"]] = "goals"
    context: Literal["same", "different"] = "same"
    """x_0 of a candidate: of its own trajectory, or of another one."""


@dataclass(frozen=True, kw_only=True)
class ActionArguments(FrameArguments):
    """Action selection (Cui et al. §4.2): is what happens in the frames that score highest the goal's action, done to
    whatever object? Opening a cabinet counts for opening the microwave.
    """

    what: ClassVar[Literal["goals", "actions"]] = "actions"


def run(config: GoalArguments | ActionArguments, ui: Ui) -> dict[str, Any]:
    """Draw candidates, score them, judge the highest scores."""
    from zest_rl.analysis.frame_selection import select_frames

    with progress_in_parts(ui, "rendering and embedding") as on_progress:
        selected = select_frames(ask=config.what, **vars(config), on_progress=on_progress)
    if selected.starts_are_alike and getattr(config, "context", "same") == "different":
        ui.warn("all trajectories start with the same picture, so x_0 of another one changes nothing; try --show-robot")
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
