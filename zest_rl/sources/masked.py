"""Frames of any source without what masks hide, such as a robot; the cameras must not move."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zest_rl.data.masks import Step, filled, first_seen
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.sources.base import EpisodeFrames
from zest_rl.sources.videos import EpisodeVideos, find_videos
from zest_rl.types import Frame

_VERSION = 1  # raise it when a pixel changes: cached embeddings depend on it
_WHITE = 128


@dataclass(frozen=True)
class MaskedFrames:
    """`EpisodeFrames` in which masked pixels are filled from the frames in which they are seen."""

    frames: EpisodeFrames
    masks: EpisodeVideos
    """White where the scene is hidden; of each view one folder, of each frame one picture."""

    @property
    def views(self) -> Sequence[str]:
        """Names of the views."""
        return self.frames.views

    def describe(self) -> dict[str, Any]:
        """Origin of the frames, and the names and folders of the masks."""
        masks = {"masks": list(self.masks.views), "mask_folders": self.masks.describe()["folders"]}
        return {**self.frames.describe(), **masks}

    def digest(self, episode: int) -> str:
        """Hash frames and masks."""
        return artifacts.hash_json([self.frames.digest(episode), self.masks.digest(episode), _VERSION])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Read everything twice: what is seen later fills what is not seen at first."""
        yield from filled(self._steps(episode), first_seen(self._steps(episode)))

    def _steps(self, episode: int) -> Iterator[Step]:
        try:
            for step, (frames, pictures) in enumerate(
                zip(self.frames.read(episode), self.masks.read(episode), strict=True)
            ):
                for frame, picture in zip(frames, pictures, strict=True):
                    if frame.shape != picture.shape:
                        raise BadInput(
                            f"the masks of episode {episode} must have the size of its frames, but that of frame "
                            f"{step} is {picture.shape[1]}×{picture.shape[0]}, the frame "
                            f"{frame.shape[1]}×{frame.shape[0]}; write masks of the stored frames"
                        )
                    if picture.max() == 1 and self.masks.paths[0][episode].is_dir():  # a video may have noise
                        raise BadInput(
                            f"masks must be black and white (0 and 255), but that of frame {step} of episode {episode} "
                            "holds 0 and 1; multiply by 255"
                        )
                yield frames, [picture.max(axis=-1) >= _WHITE for picture in pictures]
        except ValueError as error:
            if isinstance(error, BadInput):
                raise
            raise BadInput(f"episode {episode} must have one mask for each frame, and has more of one") from error


def without_masked(
    frames: EpisodeFrames, folders: Sequence[Path], n_episodes: int, what: str, numbers: Sequence[int] | None = None
) -> MaskedFrames:
    """Fill frames where masks are white.

    Args:
        frames: of a dataset.
        folders: of masks, one per view: ``episode_0.mp4``, or ``episode_0/`` with pictures.
        n_episodes: of the dataset.
        what: names the dataset in an error.
        numbers: as in `find_videos`.

    Raises:
        BadInput: there are more or fewer folders than views, or as `find_videos`.
    """
    if len(folders) != len(frames.views):
        raise BadInput(
            f"--masks needs a folder for each of the {len(frames.views)} views ({', '.join(frames.views)}), in their "
            f"order, got {len(folders)}"
        )
    for folder in folders:
        if not folder.is_dir():
            raise BadInput(
                f"--masks {folder} is not a folder; give one that holds episode_0.mp4, or episode_0/ of PNGs"
            )
    return MaskedFrames(frames, find_videos(folders, n_episodes, what, numbers))
