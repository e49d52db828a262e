"""One dataset that is explored: its embedded episodes, and what any goal makes of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from zest_rl.analysis.curation import RankedEpisode, n_to_keep, rank_episodes
from zest_rl.analysis.inspection import rendered_frames, unchanged
from zest_rl.analysis.reward_figures import VIEW_CANNOT_TELL, deciding_figures, reward_warnings
from zest_rl.analysis.verdict import Verdict, judge
from zest_rl.data.reader import open_dataset
from zest_rl.data.writer import DatasetCopy, Trajectories
from zest_rl.errors import BadInput
from zest_rl.explore.background import Choice
from zest_rl.explore.films import Film, frames_at
from zest_rl.explore.shelf import Shelf
from zest_rl.metrics.statistics import MIN_EPISODES_TO_RANK
from zest_rl.rewards.embeddings import EmbeddedEpisode
from zest_rl.rewards.episode_goals import write_pictures
from zest_rl.rewards.goals import GoalSpec
from zest_rl.rewards.relabel import relabel, rewards_from_scores, view_cannot_tell
from zest_rl.rewards.scorer import Scorer, ScorerConfig
from zest_rl.rewards.scores import (
    Doubles,
    Features,
    Reward,
    Similarity,
    alone,
    averaged,
    check_goal_share,
    check_names,
    similarities,
)
from zest_rl.runtime import artifacts
from zest_rl.runtime.parallel import n_cores
from zest_rl.sources import KitchenStates
from zest_rl.sources.conversion import ConvertedTrajectories
from zest_rl.types import FloatArray, GroundTruth

FILMS = 4
"""Episodes whose pictures are kept."""
READING = 0.3
"""Seconds of computing for which the cache is read between two answers."""


@dataclass(frozen=True)
class Ask:
    """A goal, and how it scores: what the page's switches say."""

    starts: tuple[str, ...]
    """Names of pictures (`Shelf`), or sentences."""
    goals: tuple[str, ...]
    are_sentences: bool = False
    features: Features = "delta"
    similarity: Similarity = "cos"
    goal_share: float = 1.0
    reward: Reward = "level"

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        check_goal_share(self.goal_share)
        if not self.starts or not self.goals:
            raise BadInput("a goal needs at least one picture of the start and one of the goal")
        sentences = (*self.starts, *self.goals) if self.are_sentences else ()
        for unfit in (text for text in sentences if not text.strip() or "|" in text or "->" in text):
            raise BadInput(f"a sentence must hold words and neither | nor ->, got {unfit!r}")


@dataclass(frozen=True, eq=False)
class Scored:
    """The episodes that are embedded, compared with a goal."""

    ask: Ask
    scorer: Scorer
    kept: Sequence[int]
    """Indices of the goals that count."""
    compared: Mapping[int, Doubles]
    """Episode → `similarities` (V, T+1, K) with all of the goals."""

    def scores(self, episode: int) -> FloatArray:
        """Score one episode: (T+1,)."""
        return averaged(np.ascontiguousarray(self.compared[episode][..., self.kept]), self.ask.features)

    def rewards(self, episode: int) -> FloatArray:
        """Reward one episode: (T,)."""
        return rewards_from_scores(self.scores(episode), self.ask.reward)

    def ranking(self) -> list[RankedEpisode]:
        """Rank the episodes as `zest curate` does, the best first."""
        episodes = sorted(self.compared)
        ranked = rank_episodes([self.scores(episode) for episode in episodes]) if episodes else []
        return [replace(each, index=episodes[each.index]) for each in ranked]

    def disagreement(self, episode: int) -> float:
        """Standard deviation of the scores by each view and goal alone, averaged over frames."""
        each = alone(self.compared[episode][..., self.kept], self.ask.features)
        return float(each.std(axis=(0, 2)).mean())

    def by_view(self, episode: int) -> list[FloatArray]:
        """Score by each view alone: V × (T+1,)."""
        kept = self.compared[episode][..., self.kept]
        return [averaged(kept[v : v + 1], self.ask.features) for v in range(len(kept))]

    def by_goal(self, episode: int) -> list[FloatArray]:
        """Score by each goal alone, also those that do not count: K × (T+1,)."""
        compared = self.compared[episode]
        return [averaged(compared[..., k : k + 1], self.ask.features) for k in range(compared.shape[-1])]


class Session:
    """A dataset with the episodes that are ready. Methods that draw or read frames, `advance` too, need one thread."""

    def __init__(self, choice: Choice, shelf: Shelf, progress: Callable[[], tuple[float, str]]) -> None:
        """Open the dataset; `progress` is that of its `BackgroundEmbedding`. Raises as `Choice.find`."""
        self.choice, self.shelf = choice, shelf
        self.source, self._embeddings = choice.find()
        self.truth = recorded_truth(self.source.trajectories)
        self.n_steps = list(self.source.trajectories.n_steps)
        self.ready = dict[int, EmbeddedEpisode]()
        self._progress = progress
        self._films = dict[int, Film]()
        self._saved = dict[Ask, str]()
        """Goal → the dataset that was relabeled by it."""
        self._lock = threading.Lock()
        self._key: object = None
        self._compared = dict[int, Doubles]()

    def advance(self) -> tuple[float, str]:
        """Take over a few more of the episodes that are embedded; return as `BackgroundEmbedding.progress`."""
        progress, since = self._progress(), time.thread_time()
        for episode in (number for number in range(len(self.n_steps)) if number not in self.ready):
            if (embedded := self._embeddings.read(episode)) is None:
                break
            self.ready[episode] = embedded
            if time.thread_time() - since > READING:
                break
        return progress

    def score(self, ask: Ask) -> Scored:
        """Compare all episodes that are ready with a goal.

        Raises:
            BadInput: a picture is not known, or the embedder reads no sentences.
        """
        if ask.are_sentences and not self.shelf.embedder.reads_text:
            raise BadInput(f"{self.shelf.embedder.uri} reads pictures only; start zest explore with another --embedder")
        starts, goals = (self.shelf.embed(side, are_sentences=ask.are_sentences) for side in (ask.starts, ask.goals))
        settings = (ask.features, ask.similarity)
        key = (ask.starts, ask.goals, ask.are_sentences, *settings)
        config = ScorerConfig("", self.shelf.embedder.uri, *settings, goal_share=ask.goal_share)
        goal = self.goal(ask)
        embedder = self.shelf.embedder
        scorer = Scorer(config, starts, goals, goal.fingerprint(), embedder.fingerprint, embedder.backend, None, goal)

        def compare(episode: int) -> Doubles:
            embedded = self.ready[episode]
            return similarities(embedded.embeddings, starts, goals, *settings)[:, embedded.index]

        with self._lock, ThreadPoolExecutor(n_cores()) as pool:
            if key != self._key:
                self._key, self._compared = key, {}
            new = [episode for episode in list(self.ready) if episode not in self._compared]
            self._compared |= zip(new, pool.map(compare, new), strict=True)
            compared = dict(self._compared)
        every = range(len(goals))
        kept = scorer.goals_near([self.ready[e] for e in compared]).tolist() if ask.goal_share < 1 else every
        return Scored(ask, scorer, kept, compared)

    def goal(self, ask: Ask) -> GoalSpec:
        """Return the pictures or sentences of a goal; raises as `Shelf.picture`."""
        if ask.are_sentences:
            return GoalSpec(f"text:{' | '.join(ask.starts)} -> {' | '.join(ask.goals)}", ask.starts, ask.goals)
        starts, goals = (tuple(map(self.shelf.picture, side)) for side in (ask.starts, ask.goals))
        return GoalSpec("", starts, goals)

    def judge(self, ask: Ask) -> tuple[Verdict, list[str]] | None:
        """Return the verdict of `zest inspect` on the episodes that are ready, and warnings; None of too few."""
        scored = self.score(ask)
        chosen = sorted(scored.compared)
        if len(chosen) < MIN_EPISODES_TO_RANK:
            return None
        scores, rewards = [scored.scores(e) for e in chosen], [scored.rewards(e) for e in chosen]
        source, frames, still = self.source.frames, None, None
        if isinstance(source, KitchenStates):
            frames, still = rendered_frames([source.states[e] for e in chosen], source.ring)
        elif (ask.features, ask.similarity) == ("delta", "cos"):
            still = unchanged(scores)
        truth = None if self.truth is None else [self.truth[e] for e in chosen]
        figures = deciding_figures(rewards, scores, frames, still, truth)
        blind = view_cannot_tell(scored.scorer, source, [self.ready[e] for e in chosen])
        warnings = [*reward_warnings(rewards, figures), *([VIEW_CANNOT_TELL] if blind else [])]
        return judge(rewards, figures, view_cannot_tell=blind), warnings

    def proposal(self, ask: Ask, keep: float) -> tuple[list[int], str | None]:
        """Return the episodes that `zest curate` would drop, the worst first, and the saved dataset of this goal."""
        ranking = self.score(ask).ranking()
        worst_first = [each.index for each in reversed(ranking[n_to_keep(keep, len(ranking)) :])]
        return worst_first, self._saved.get(ask)

    def film(self, episode: int) -> Film:
        """Return the pictures of an episode; the `FILMS` that were asked for last are kept."""
        film = self._films.pop(episode, None) or Film(self.source.frames, episode)
        self._films[episode] = film
        for oldest, _ in zip(list(self._films), range(len(self._films) - FILMS), strict=False):
            del self._films[oldest]
        return film

    def take(self, episode: int, step: int, view: int | None) -> list[str]:
        """Put a frame on the shelf as the scorer sees it, of one view or of all, and return its names there."""
        frames = frames_at(self.source.frames, episode, step)
        return [self.shelf.add(frame) for frame in (frames if view is None else [frames[view]])]

    def save_goal(self, ask: Ask, folder: Path) -> str:
        """Write the pictures of a goal to a folder named by their hash, and return its spec: that, or the sentences."""
        goal = self.goal(ask)
        if goal.is_text:
            return goal.name
        path = folder / f"goal-{goal.fingerprint()[:8]}"
        with artifacts.lock(path):
            if not path.exists():
                with artifacts.staged_folder(path) as staging:
                    write_pictures(staging, goal)
        return str(path)

    def save(self, ask: Ask, folder: Path) -> tuple[str, dict[str, Any]]:
        """Write the goal and the dataset that is relabeled by it; return its id, and the arguments of `relabel`."""
        options = self.relabel_options(ask, self.save_goal(ask, folder))
        self._saved[ask] = relabel(**options).dataset_id
        return self._saved[ask], options

    def relabel_options(self, ask: Ask, goal: str) -> dict[str, Any]:
        """Return the arguments of `zest relabel` for a goal that `save_goal` wrote."""
        settings = {name: getattr(ask, name) for name in ("features", "similarity", "goal_share", "reward")}
        return {"dataset": self.choice.dataset, **self.choice.options, "goal": goal, **settings}


def recorded_truth(trajectories: Trajectories) -> list[GroundTruth] | None:
    """Return what judges the episodes of a dataset, by the rules of `Dataset.truth`; None where nothing does."""
    if isinstance(trajectories, DatasetCopy):
        with open_dataset(trajectories.dataset_id) as ds:
            return ds.truth() if ds.has_truth else None
    if not isinstance(trajectories, ConvertedTrajectories):
        return None
    episodes = [(each.rewards, each.success) for each in trajectories.episodes()]
    told = all(success is not None for _, success in episodes)
    if all(np.isfinite(rewards).all() for rewards, _ in episodes):
        return [GroundTruth(rewards, bool(np.any(success)) if told else None) for rewards, success in episodes]
    return [GroundTruth(np.asarray(s, np.float32), bool(np.any(s))) for _, s in episodes] if told else None
