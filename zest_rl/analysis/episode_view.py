"""One episode → frames for people to look at, with its scores; in the kitchen also those of each view."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from zest_rl.analysis.inspection import Inspection
from zest_rl.data.reader import dataset_path, open_dataset
from zest_rl.data.video import evenly_spaced
from zest_rl.kitchen.videos import FPS
from zest_rl.rewards.scorer import SCORER_FILE
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.simulation.videos import write_mp4
from zest_rl.sources.base import EpisodeFrames
from zest_rl.sources.recorded_frames import middle_view
from zest_rl.types import FloatArray

N_FRAMES, SIDE = 8, 224
"""Frames of a strip; longest side in pixels of what is read to be shown."""


class EpisodeView(Protocol):
    """What a page shows of an episode."""

    @property
    def scores(self) -> FloatArray:
        """(T+1,) of all views together."""

    @property
    def by_view(self) -> FloatArray:
        """(V, T+1) of each view alone, or (0, T+1)."""

    @property
    def steps(self) -> NDArray[np.intp]:
        """(n,) steps of `frames`, evenly spaced over the episode."""

    @property
    def frames(self) -> NDArray[np.uint8]:
        """(n, H, W, 3) frames of the middle view at `steps`."""

    @property
    def pixel_difference(self) -> FloatArray:
        """(T+1,) mean absolute difference to the first frame, over pixels, in [0, 255]."""

    def write_video(self, path: Path) -> float:
        """Write the episode as H.264, and return its frames per second."""


@dataclass(frozen=True, eq=False)
class RecordedView:
    """The `EpisodeView` of any dataset: the middle view of its frames, and the scores that it holds."""

    shown: NDArray[np.uint8]
    """(T+1, H, W, 3)."""
    scores: FloatArray
    fps: float

    @property
    def by_view(self) -> FloatArray:
        """None is known."""
        return np.empty((0, len(self.scores)), np.float32)

    @property
    def steps(self) -> NDArray[np.intp]:
        """Of `frames`."""
        return evenly_spaced(len(self.scores), N_FRAMES)

    @property
    def frames(self) -> NDArray[np.uint8]:
        """Those at `steps`."""
        return self.shown[self.steps]

    @property
    def pixel_difference(self) -> FloatArray:
        """Of the middle view."""
        first = self.shown[0].astype(np.int16)
        return np.array([np.abs(frame - first).mean() for frame in self.shown], dtype=np.float32)

    def write_video(self, path: Path) -> float:
        """Write all frames, cut to even sides."""
        height, width = (side // 2 * 2 for side in self.shown.shape[1:3])
        write_mp4(path, self.shown[:, :height, :width], self.fps)
        return self.fps


@dataclass(frozen=True)
class KitchenView:
    """The `EpisodeView` of kitchen states, computed when first used."""

    scorer: StateScorer
    """Of the dataset."""
    states: NDArray[np.float64]
    """(T+1, nq) simulator positions."""

    @cached_property
    def steps(self) -> NDArray[np.intp]:
        """(n,) steps of `frames`, evenly spaced over the episode."""
        return evenly_spaced(len(self.states), N_FRAMES)

    @cached_property
    def frames(self) -> NDArray[np.uint8]:
        """(n, H, W, 3) frames of the middle view at `steps`."""
        return self._seen[0][self.steps]

    @cached_property
    def scores(self) -> FloatArray:
        """(T+1,) of all views together."""
        return self.scorer.score_episode(self.states)

    @cached_property
    def by_view(self) -> FloatArray:
        """(V, T+1) of each view alone."""
        return self.scorer.by_view(self.states)

    @cached_property
    def pixel_difference(self) -> FloatArray:
        """(T+1,) mean absolute difference to the first frame, over pixels and views, in [0, 255]."""
        return self._seen[1]

    def write_video(self, path: Path) -> float:
        """Write the middle view of all steps."""
        write_mp4(path, self._seen[0], FPS)
        return FPS

    @cached_property
    def _seen(self) -> tuple[NDArray[np.uint8], FloatArray]:
        """Render each distinct state once: the middle view of all steps (T+1, H, W, 3), and their pixel difference."""
        views = self.scorer.embedder.views
        distinct, inverse = np.unique(views.canonical(self.states), axis=0, return_inverse=True)
        index = inverse.reshape(-1)
        frames = np.stack([np.stack(views.render(state)) for state in distinct])  # [distinct, view, height, width, 3]
        first = frames[index[0]].astype(np.int16)
        difference = np.array([np.abs(frame - first).mean() for frame in frames], dtype=np.float32)
        return frames[index, frames.shape[1] // 2], difference[index]


def best_and_worst(inspection: Inspection, *, n_workers: int | None = None) -> dict[str, EpisodeView]:
    """Return the episodes with the highest and the lowest return, as "best" and "worst".

    Empty where scores were shuffled.

    Args:
        inspection: of a dataset.
        n_workers: processes that embed, default one per core.

    Raises:
        ZestError: in the kitchen, the scorer is missing, or was made with another embedder or renderer than those
            installed; elsewhere, the frames lie outside the dataset, or cannot be rendered here.
    """
    if inspection.relabel.shuffle is not None:
        return {}
    chosen = {"best": int(np.argmax(inspection.returns)), "worst": int(np.argmin(inspection.returns))}
    if inspection.states is not None:
        scorer = StateScorer.load(dataset_path(inspection.dataset_id) / SCORER_FILE, n_workers=n_workers)
        return {which: KitchenView(scorer, inspection.states[index]) for which, index in chosen.items()}
    with open_dataset(inspection.dataset_id) as ds:
        frames, scores, fps = middle_view(ds), ds.scores(), ds.record.fps or FPS
        return {which: RecordedView(_shown(frames, i, len(scores[i])), scores[i], fps) for which, i in chosen.items()}


def _shown(frames: EpisodeFrames, episode: int, n_frames: int) -> NDArray[np.uint8]:
    """Read all frames of an episode's only view, small; a missing last one repeats the one before."""
    shown = []
    for (frame,) in frames.read(episode):
        picture = Image.fromarray(frame)
        picture.thumbnail((SIDE, SIDE))
        shown.append(np.asarray(picture))
    return np.stack([*shown, *shown[-1:]][:n_frames])
