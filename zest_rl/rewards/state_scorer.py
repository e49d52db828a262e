"""A scorer with the embedder of its views: scores of simulator states, recorded or during a rollout."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import ZestError
from zest_rl.kitchen.views import Views
from zest_rl.rewards.goals import read_kitchen_goal
from zest_rl.rewards.scorer import Scorer, ScorerConfig
from zest_rl.rewards.state_embeddings import StateEmbedder, StateEmbeddings
from zest_rl.types import FloatArray


@dataclass(frozen=True, eq=False)
class StateScorer:
    """Scores states of the environment that its scorer sees (`StateViews`); each is rendered and embedded once."""

    scorer: Scorer
    embedder: StateEmbedder

    @classmethod
    def of(cls, scorer: Scorer, *, device: str = "auto", **options: Any) -> Self:
        """Open the cache of a scorer's views; `options` as in `StateEmbedder`.

        Raises:
            ZestError: the scorer's frames are not rendered from states.
        """
        if scorer.views is None:
            raise ZestError("the frames of this scorer are no rendered states, so it cannot score states")
        return cls(scorer, StateEmbedder(scorer.views, **scorer.config.embedding(), device=device, **options))

    @classmethod
    def build(
        cls,
        config: ScorerConfig,
        views: Views,
        scene_qpos: NDArray[np.float64],
        *,
        device: str = "auto",
        **options: Any,
    ) -> Self:
        """Read and embed the goal.

        Args:
            config: of the scorer.
            views: of the task.
            scene_qpos: (nq,) a start state of the scene, for same-scene goals.
            device: of the embedder.
            options: as in `StateEmbedder`.

        Raises:
            BadInput: the goal cannot be read, or is a sentence and the embedder reads pictures only.
        """
        goal = read_kitchen_goal(config.goal, views, scene_qpos)
        return cls.of(Scorer.build(config, goal, views=views, device=device), device=device, **options)

    @classmethod
    def load(cls, path: Path, *, device: str = "auto", **options: Any) -> Self:
        """Read the file of `Scorer.save`; raises as `Scorer.load`."""
        return cls.of(Scorer.load(path, device=device), device=device, **options)

    def seen_as(self, task: str) -> Self:
        """Return a scorer with the same goals that sees the kitchen's states from the views of another task."""
        cache = self.embedder
        assert isinstance(cache.views, Views), "only the kitchen has tasks"
        scorer = replace(self.scorer, views=replace(cache.views, task=task))
        return self.of(scorer, device=cache.embedder.device, n_workers=cache.n_workers, engine=cache.engine)

    def with_goals(self, kept: NDArray[np.intp]) -> Self:
        """Return a scorer with only the goals of these indices, and the same cache."""
        return replace(self, scorer=self.scorer.with_goals(kept))

    def embeddings(self, states: Sequence[NDArray[np.float64]]) -> StateEmbeddings:
        """Embed whole episodes, (T+1, width) states each."""
        embeddings = StateEmbeddings(self.embedder, states)
        embeddings.embed()
        return embeddings

    def score_episode(self, states: NDArray[np.float64]) -> FloatArray:
        """Score a whole episode: (T+1, width) → (T+1,) float32."""
        return self.scorer.score_episodes(self.embeddings([states]))[0][0]

    def by_view(self, states: NDArray[np.float64]) -> FloatArray:
        """Score one episode by each view alone: (T+1, width) → (V, T+1) float32."""
        (episode,) = self.embeddings([states])
        return self.scorer.by_view(episode)

    def score_now(self, first: NDArray[np.float64], current: NDArray[np.float64]) -> FloatArray:
        """Score one state of each of N running episodes; `flush` writes their embeddings to the cache.

        Args:
            first: (N, width) their first states.
            current: (N, width) their current states.

        Returns:
            (N,) float32 scores.
        """
        scores = np.empty(len(current), dtype=np.float32)
        _, group = np.unique(self.embedder.views.canonical(first), axis=0, return_inverse=True)
        for g in range(group.max() + 1):  # mostly one group: the objects start alike
            rows = np.flatnonzero(group.reshape(-1) == g)
            states = np.concatenate([first[rows[:1]], current[rows]])
            scores[rows] = self.scorer.score(self.embedder.embed_now(states))[1:]
        return scores

    def score_pairs(
        self,
        first: NDArray[np.float64],
        current: NDArray[np.float64],
        on_progress: Callable[[int, int], None] | None = None,
    ) -> FloatArray:
        """Score many states, each against its own start, embedded on all cores.

        Args:
            first: (N, width) start states, x_0 of each.
            current: (N, width) states.
            on_progress: called with (parts embedded, parts in all).

        Returns:
            (N,) float32 scores.
        """
        self.embedder.embed(np.concatenate([first, current]), on_progress)
        return self.score_now(first, current)

    def flush(self) -> None:
        """Write the embeddings of `score_now` to the cache."""
        self.embedder.flush()
