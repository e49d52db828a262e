"""The flags of ``zest explore``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Config:
    """Open a page in the browser: drop pictures of the start and the goal, or click frames; all episodes are scored.

    It answers on this machine alone; Ctrl-C ends it. Episodes are embedded meanwhile, and what is embedded is kept.
    """

    datasets: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATASET [DATASET …]")]
    """As for `zest relabel`, relabeled or not."""
    goal: str | None = None
    """Folder with init/ and goal/ pictures, or two sentences, to begin with."""
    output: Path = Path("goals")
    """Folder that gets a folder for each goal that is saved."""
    port: int = 0
    """Of 127.0.0.1; 0: any that is free."""
    browser: bool = True
    """Open the page."""
    frames: tuple[str, ...] = ()
    """As for `zest relabel`, like the following ones."""
    camera: tuple[str, ...] = ()
    """Cameras of the environment's model, or default."""
    env: str | None = None
    """package.module:make, a function that makes the environment."""
    robot: tuple[str, ...] = ()
    """Bodies of the model that are hidden."""
    look_at: str | None = None
    """Body of the model in the middle of the views."""
    embedder: str = "efficientnet-lite0"
    """Frozen network."""
    views: int = 8
    """Cameras around the object."""
    show_robot: bool = False
    """Keep the robot in view."""
    tolerance: float = 1e-3
    """States that agree to this many rad or m are embedded once."""
    masks: tuple[str, ...] = ()
    """Folders with masks of the robot, one per view."""
    skip_incomplete: bool = False
    """Leave out incomplete episodes of a LeRobot folder."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Of the embedder."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, …"""
    backend: Literal["auto", "torch"] = "auto"
    """As for `zest relabel`."""
    vectors: Literal["float32", "float16"] = "float32"
    """As for `zest relabel`."""
    n_workers: int | None = None
    """Processes that embed; default one per core."""
