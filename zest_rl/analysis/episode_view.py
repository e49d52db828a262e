"""One kitchen episode → frames for people to look at, with the scores of all views and of each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from zest_rl.analysis.inspection import Inspection
from zest_rl.data.reader import dataset_path
from zest_rl.data.video import evenly_spaced
from zest_rl.rewards.scorer import SCORER_FILE
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.types import FloatArray

N_FRAMES = 8
"""Frames of a strip."""


@dataclass(frozen=True)
class EpisodeView:
    """The frames and scores of one episode, computed when first used."""

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
        frames, index = self._render(self.states[self.steps])
        return np.asarray(frames[index, frames.shape[1] // 2])

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
        frames, index = self._render(self.states)
        first = frames[index[0]].astype(np.int16)
        return np.array([np.abs(frame - first).mean() for frame in frames], dtype=np.float32)[index]

    def _render(self, states: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
        """Render each distinct state once: frames (U, V, H, W, 3), and the index of each state's frame (T+1,)."""
        views = self.scorer.embedder.views
        distinct, index = np.unique(views.canonical(states), axis=0, return_inverse=True)
        return np.stack([np.stack(views.render(state)) for state in distinct]), index.reshape(-1)


def best_and_worst(inspection: Inspection, *, n_workers: int | None = None) -> dict[str, EpisodeView]:
    """Return the episodes with the highest and the lowest return, as "best" and "worst".

    Empty where scores were shuffled, or frames were not rendered from kitchen states.

    Args:
        inspection: of a dataset.
        n_workers: processes that embed, default one per core.

    Raises:
        ZestError: the scorer is missing, or was made with another embedder or renderer than those installed.
    """
    if inspection.relabel.shuffle is not None or inspection.states is None:
        return {}
    scorer = StateScorer.load(dataset_path(inspection.dataset_id) / SCORER_FILE, n_workers=n_workers)
    chosen = {"best": np.argmax(inspection.returns), "worst": np.argmin(inspection.returns)}
    return {which: EpisodeView(scorer, inspection.states[int(index)]) for which, index in chosen.items()}
