"""``zest goal``: an episode or a video → goal pictures, seen as the scorer sees them."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from zest_rl.cli.arguments import words_of
from zest_rl.cli.ui import Ui


@dataclass(frozen=True)
class Config:
    """Write the first and the last frame of an episode as a folder for `zest relabel --goal`."""

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """As for `zest relabel`; or a video."""
    episode: int = 0
    """Its number, from 0."""
    output: Path = Path("goal")
    """Folder that gets init/ and goal/."""
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
    show_robot: bool = False
    """Keep the robot in view."""
    masks: tuple[str, ...] = ()
    """Folders with masks of the robot, one per view."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Render or read, and write."""
    from zest_rl.data.video import VIDEO_SUFFIXES
    from zest_rl.rewards.episode_goals import write_goal

    chosen = {name: getattr(config, name) for name in ("frames", "env", "robot", "look_at", "show_robot", "masks")}
    folder, goal = write_goal(config.dataset, config.episode, config.output, cameras=config.camera, **chosen)
    is_video = Path(config.dataset).suffix.lower() in VIDEO_SUFFIXES
    seen = replace(config, episode=Config.episode, output=Config.output)
    words = words_of(replace(seen, dataset="DATASET") if is_video else seen)
    command = shlex.join(["zest", "relabel", *words, "--goal", str(folder)])
    return {"goal": str(folder), "n_views": len(goal.goals), "next": command}
