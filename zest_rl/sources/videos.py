"""Frames in a folder beside a dataset: ``episode_0.mp4``, or ``episode_0/`` with pictures, one for each episode.

One folder is one view. Frame t shows x_t: T + 1 frames for T actions, or T where the last one was not recorded.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zest_rl.data.video import VIDEO_SUFFIXES, frame_files, iter_frames
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.runtime.files import check_file
from zest_rl.types import Frame

_NAME = re.compile(r"episode_0*(\d+)")


@dataclass(frozen=True)
class EpisodeVideos:
    """`EpisodeFrames` of videos or folders of pictures."""

    paths: tuple[tuple[Path, ...], ...]
    """Per view, per episode."""

    @property
    def views(self) -> Sequence[str]:
        """Names of the folders."""
        return [paths[0].parent.name for paths in self.paths]

    def describe(self) -> dict[str, Any]:
        """The folders, their names, and the alignment of frames and steps."""
        alignment = "frame t is x_t; of T, x_T repeats the last"
        folders = [str(paths[0].parent.resolve()) for paths in self.paths]
        return {"kind": "clips", "views": list(self.views), "folders": folders, "alignment": alignment}

    def view(self, index: int) -> EpisodeVideos:
        """Return one view alone."""
        return EpisodeVideos((self.paths[index],))

    def digest(self, episode: int) -> str:
        """Hash the files."""
        return artifacts.hash_json([[artifacts.hash_file(file) for file in _files(of[episode])] for of in self.paths])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Decode all views in step."""
        paths = [of[episode] for of in self.paths]
        try:
            yield from zip(*map(iter_frames, paths), strict=True)
        except ValueError as error:
            if isinstance(error, BadInput):
                raise
            raise BadInput(f"the views of an episode must be equally long: {', '.join(map(str, paths))}") from error


def _files(path: Path) -> list[Path]:
    return frame_files(path) if path.is_dir() else [path]


def find_videos(
    folders: Sequence[Path], n_episodes: int, what: str, numbers: Sequence[int] | None = None
) -> EpisodeVideos:
    """Find the video of every episode in each folder.

    Args:
        folders: one per view.
        n_episodes: of the dataset.
        what: names the dataset in an error.
        numbers: of the episodes of a curated dataset in its source; the folders hold those that were dropped, too.

    Raises:
        BadInput: the video of an episode is missing or there are two, or there are more videos than episodes.
    """
    paths = []
    for folder in folders:
        by_number = videos_of(folder)
        missing = [number for number in numbers or range(n_episodes) if number not in by_number]
        if missing or (numbers is None and len(by_number) > n_episodes):
            raise BadInput(
                f"{folder} must hold episode_0.mp4 (or a folder episode_0 of pictures) and so on, one for each of the "
                f"{n_episodes} episodes of {what}; "
                + (f"{len(missing)} are missing, the first is {missing[0]}" if missing else f"got {len(by_number)}")
            )
        paths.append(tuple(by_number[number] for number in numbers or range(n_episodes)))
    return EpisodeVideos(tuple(paths))


def videos_of(folder: Path) -> dict[int, Path]:
    """Return the videos in a folder, or folders of pictures, by the number of the episode.

    Raises:
        BadInput: an episode has two.
    """
    by_number: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        name = _NAME.fullmatch(path.name if path.is_dir() else path.stem)
        if name is None or not (path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES):
            continue
        if (number := int(name[1])) in by_number:
            raise BadInput(f"{path} and {by_number[number].name} are both of episode {number}; remove one")
        if not path.is_dir():
            check_file(path)
        by_number[number] = path
    return by_number
