"""Goals out of a dataset's own episodes or a video: the first and the last frame, seen as the scorer sees them.

``episode:3`` is a goal spec, too: each view has its own pair, as with ``same-scene``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from zest_rl.data.video import VIDEO_SUFFIXES, iter_frames
from zest_rl.errors import BadInput
from zest_rl.rewards.goals import GoalSpec, read_free_goal, read_kitchen_goal
from zest_rl.runtime.files import user_path
from zest_rl.sources import EpisodeFrames, KitchenStates, Source, open_source
from zest_rl.sources.base import RenderedFrames
from zest_rl.types import Frame

EPISODE = "episode:"


def read_source_goal(spec: str, source: Source, *, cached: bool = False) -> GoalSpec:
    """Read a goal spec for a dataset that is to be relabeled; `cached` as in `read_kitchen_goal`.

    Raises:
        BadInput: there is no such episode, or as `zest_rl.rewards.goals.read_goal`.
    """
    frames = source.frames
    if spec.startswith(EPISODE):
        return episode_goal(source, spec.removeprefix(EPISODE))
    if isinstance(frames, KitchenStates):
        return read_kitchen_goal(spec, frames.ring, frames.states[0][0], cached=cached)
    return read_free_goal(spec)


def episode_goal(source: Source, episode: str | int) -> GoalSpec:
    """Return the first and the last frame of an episode, by its number from 0, in all views.

    Raises:
        BadInput: there is no such episode.
    """
    number, n_episodes = str(episode), len(source.trajectories.n_steps)
    if not number.isdecimal() or int(number) >= n_episodes:
        raise BadInput(
            f"a goal out of {source.trajectories.dataset_id} needs the number of an episode in 0 … {n_episodes - 1}, "
            f"got {number!r}; write e.g. --goal {EPISODE}0"
        )
    first, last = ends(source.frames, int(number))
    return GoalSpec(f"{EPISODE}{int(number)}", tuple(first), tuple(last), per_view=True)


def ends(frames: EpisodeFrames, episode: int) -> tuple[Sequence[Frame], Sequence[Frame]]:
    """Return the views of the first and of the last step of an episode."""
    if isinstance(frames, RenderedFrames):
        return frames.at(episode, 0), frames.at(episode, -1)
    return first_and_last(frames.read(episode))


def first_and_last(steps: Iterator[Sequence[Frame]]) -> tuple[Sequence[Frame], Sequence[Frame]]:
    """Return the first and the last of some steps."""
    first = next(steps)
    return first, deque(chain([first], steps), maxlen=1)[0]


def write_goal(dataset: str, episode: int, folder: Path, **frames: Any) -> tuple[Path, GoalSpec]:
    """Write the first and the last frame of an episode, or of a video, as a goal folder.

    Args:
        dataset: as `zest_rl.sources.open_source` takes it; or a video file.
        episode: its number from 0; of a video, 0.
        folder: gets ``init/`` and ``goal/``; must not hold anything.
        frames: options of `open_source`.

    Raises:
        BadInput: there are no such frames, or the folder holds something.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise BadInput(f"goal pictures go to an empty folder, but {folder} is there; give --output another name")
    path = user_path(dataset)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        if episode or any(frames.values()):
            raise BadInput(f"{path} is a video, which has one episode and one view; leave the other flags out")
        start, end = first_and_last([frame] for frame in iter_frames(path))
        goal = GoalSpec(str(path), tuple(start), tuple(end))
    else:
        goal = episode_goal(open_source(dataset, **frames), episode)
    write_pictures(folder, goal)
    return folder, goal


def write_pictures(folder: Path, goal: GoalSpec) -> None:
    """Write a goal's pictures as ``init/`` and ``goal/``, as they are."""
    for part, pictures in (("init", goal.starts), ("goal", goal.goals)):
        (folder / part).mkdir(parents=True)
        for i, picture in enumerate(pictures):
            Image.fromarray(np.asarray(picture)).save(folder / part / f"{i}.png")
