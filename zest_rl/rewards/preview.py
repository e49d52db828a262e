"""One picture of what a scorer will see, before anything is embedded: all views of an episode's ends, and the goal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from zest_rl.kitchen.views import Views
from zest_rl.rewards.episode_goals import ends, read_source_goal
from zest_rl.rewards.goals import GoalSpec
from zest_rl.runtime import artifacts
from zest_rl.sources import Source, open_source
from zest_rl.types import Frame

CELL, GAP, TITLE = 160, 4, 16
"""Pixels: side of a picture, space between pictures, height of a line of text."""
MAX_ROWS = 8


FRAME_OPTIONS = ("frames", "env", "robot", "look_at", "show_robot", "tolerance", "skip_incomplete", "masks")
"""Arguments of `zest_rl.rewards.relabel.relabel` that `open_source` takes by the same names."""


def preview(path: Path, dataset: str, goal: str, **options: Any) -> int:
    """Draw what `zest_rl.rewards.relabel.relabel` would see with the same arguments; returns as `write_preview`."""
    source = seen_source(dataset, **options)
    return write_preview(path, source, read_source_goal(goal, source))


def seen_source(dataset: str, **options: Any) -> Source:
    """Open the episodes and frames that `zest_rl.rewards.relabel.relabel` scores with the same arguments."""
    frames = {name: options[name] for name in FRAME_OPTIONS if name in options}
    cameras, n_views = options.get("camera", ()), options.get("views", Views.n_views)
    return open_source(dataset, cameras=cameras, n_views=n_views, **frames)


def write_preview(path: Path, source: Source, goal: GoalSpec) -> int:
    """Draw a row for each view: the first and the last frame of an episode, and beside them pictures of the goal.

    The episode is the one in which most moves, where that is known, else the first.

    Args:
        path: of the PNG.
        source: the dataset.
        goal: its pictures or sentences.

    Returns:
        The number of the episode.
    """
    episode = int(source.frames.describe().get("liveliest", 0))
    first, last = ends(source.frames, episode)
    columns = [(f"episode {episode}: first", first), ("last", last)]
    if goal.is_text:
        title = f"goal: {' | '.join(map(str, goal.starts))} -> {' | '.join(map(str, goal.goals))}"
    else:
        title = f"goal: {goal.name}"
        columns += [("start", _pictures(goal.starts)), ("goal", _pictures(goal.goals))]
    n_rows = max(len(pictures[:MAX_ROWS]) for _, pictures in columns)
    size = (len(columns) * (CELL + GAP), 2 * TITLE + n_rows * (CELL + GAP))
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((GAP, 2), title.encode("ascii", "replace").decode(), "black")
    for x, (name, pictures) in enumerate(columns):
        draw.text((x * (CELL + GAP) + GAP, TITLE), name, "black")
        for y, picture in enumerate(pictures[:MAX_ROWS]):
            image = Image.fromarray(picture)
            image.thumbnail((CELL, CELL))
            sheet.paste(image, (x * (CELL + GAP), 2 * TITLE + y * (CELL + GAP)))
    with artifacts.atomic_path(path) as temporary:
        sheet.save(temporary, "PNG")
    return episode


def _pictures(items: Sequence[Frame] | Sequence[str]) -> list[Frame]:
    return [np.asarray(item, np.uint8) for item in items]
