"""One episode of a relabeled dataset → what a person looks at: a strip of frames with their scores, and each view's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from zest_rl.frames import canonical_states
from zest_rl.scorer import Scorer
from zest_rl.types import FloatArray

N_FRAMES = 8
"""Frames of a strip."""


@dataclass(frozen=True)
class Look:
    """How the score sees one episode."""

    frames: NDArray[np.uint8]
    """(n, H, W, 3) frames of the middle view, evenly spaced over the episode."""
    steps: NDArray[np.intp]
    """(n,) which steps they are."""
    scores: FloatArray
    """(T+1,) of all views together."""
    by_view: FloatArray
    """(V, T+1), each view's own."""
    pixel_difference: FloatArray
    """(T+1,) mean absolute difference to the first frame, over pixels and views, in [0, 255]."""

    @classmethod
    def at(cls, scorer: Scorer, states: NDArray[np.float64]) -> Self:
        """Render and score an episode.

        Args:
            scorer: of the dataset.
            states: (T+1, nq) simulator positions.
        """
        renderer = scorer.config.views.shared_renderer()
        distinct, inverse = np.unique(canonical_states(states, scorer.config.views), axis=0, return_inverse=True)
        frames = np.stack([renderer.render(state) for state in distinct])  # (U, V, H, W, 3)
        inverse = inverse.reshape(-1)
        first = frames[inverse[0]].astype(np.int16)
        difference = np.array([np.abs(frame - first).mean() for frame in frames], dtype=np.float32)
        steps = np.unique(np.linspace(0, len(states) - 1, N_FRAMES).round().astype(np.intp))
        return cls(
            frames=frames[inverse[steps], frames.shape[1] // 2],
            steps=steps,
            scores=scorer.score_episodes([states])[0][0],
            by_view=scorer.score_by_view(states),
            pixel_difference=difference[inverse],
        )
