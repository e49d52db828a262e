"""The arguments of ``zest select goals`` and ``zest select actions``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import tyro

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
