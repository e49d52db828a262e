"""The flags of ``zest follow kitchen`` and ``zest follow video``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from zest_rl.rewards.scores import Features, Similarity, check_names


@dataclass(frozen=True, kw_only=True)
class FollowArguments:
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
class KitchenArguments(FollowArguments):
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
class VideoArguments(FollowArguments):
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
