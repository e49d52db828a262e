"""A goal, an embedder and a ring of views, joined into one object that scores simulator states.

The same scorer relabels a dataset and scores a rollout online. It is saved beside what it made as a small safetensors
file (the goal's embeddings) with its config, so that neither the goal pictures nor their folder are needed later.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from zest_rl.embedders import Embedder, Precision
from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.tasks import get_task
from zest_rl.rewards.goals import SAME_SCENE, GoalSpec, embed_goal, read_goal
from zest_rl.rewards.scores import (
    NUMBERS,
    Features,
    Similarity,
    check_goal_share,
    check_names,
    score_views,
    zero_deltas,
)
from zest_rl.rewards.state_embeddings import EmbedConfig, StateEmbedder
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.runtime.parallel import Engine, one_thread
from zest_rl.simulation.views import Views, canonical_states, scene_pair
from zest_rl.types import FloatArray


@dataclass(frozen=True)
class ScorerConfig:
    """Everything that a score depends on, besides the states."""

    views: Views
    goal: str
    """Goal spec, see `zest_rl.rewards.goals`."""
    embedder: str = "efficientnet-lite0"
    features: Features = "delta"
    similarity: Similarity = "cos"
    precision: Precision = "auto"
    goal_share: float = 1.0
    """Share of the goals that are used: those that the episodes end nearest to (`Scorer.select_goals`)."""

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        check_goal_share(self.goal_share)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Rebuild from ``dataclasses.asdict``."""
        return cls(**{**values, "views": Views(**values["views"])})


class Scoring(Protocol):
    """What a score depends on besides frames, goal and embedder: the fields of a scorer's config that say how."""

    @property
    def features(self) -> Features:
        """See `zest_rl.rewards.scores`."""

    @property
    def similarity(self) -> Similarity:
        """See `zest_rl.rewards.scores`."""

    @property
    def goal_share(self) -> float:
        """Share of the goals that are used."""


def how_scored(config: Scoring) -> list[Any]:
    """What of a config changes a score, for hashes of it; JSON-ready."""
    named = {"features": config.features, "similarity": config.similarity, "goal_share": config.goal_share}
    rule = [] if config.goal_share == 1 else ["by last frames"]
    return [named, *rule, *(f"{name} {number}" for name, number in NUMBERS.items() if name == config.features)]


def goals_near(ends: Iterable[FloatArray], starts: FloatArray, goals: FloatArray, config: Scoring) -> NDArray[np.intp]:
    """Return the share ``config.goal_share`` of the goals (at least one) that the episodes end nearest to.

    The rule needs no ground truth ("goal images with high similarity", Cui et al. §5.3): kept are the goals by which
    the last frames of the episodes score highest on average. It takes the data to lead somewhere: on behaviour without
    intention it picks what resembles its end.

    Args:
        ends: (2, V, D) embeddings of the first and the last frame, per episode.
        starts: see `score_views`.
        goals: see `score_views`.
        config: how frames are scored.

    Returns:
        Indices of the goals, in their order.
    """
    n_goals = goals.shape[-2]
    at_end = np.zeros(n_goals)
    for frames in ends:
        for k in range(n_goals):
            at_end[k] += score_views(frames, starts, goals[..., k : k + 1, :], config.features, config.similarity)[-1]
    n_kept = max(1, round(config.goal_share * n_goals))
    return np.sort(np.argsort(-at_end, kind="stable")[:n_kept])


class Scorer:
    """Scores simulator states by a goal: φ of `zest_rl.rewards.scores`, averaged over goals and views."""

    def __init__(
        self,
        config: ScorerConfig,
        starts: FloatArray,
        goals: FloatArray,
        goal_fingerprint: str,
        *,
        device: str = "auto",
        n_workers: int | None = None,
        engine: Engine = "local",
    ) -> None:
        """Join the parts; use `Scorer.build` or `Scorer.load`.

        Args:
            config: what is scored how.
            starts: (S, D), or (V, S, D) for a goal of its own per view.
            goals: (K, D) or (V, K, D).
            goal_fingerprint: hash of the goal's content.
            device: where the embedder runs.
            n_workers: processes that embed many states, default one per core.
            engine: processes of this machine, or workers of a Ray cluster.
        """
        self.config, self.starts, self.goals, self.goal_fingerprint = config, starts, goals, goal_fingerprint
        embed_config = EmbedConfig(config.views, config.embedder, config.precision, device)
        self.goal: GoalSpec | None = None
        """The goal itself; None when only its embeddings were loaded."""
        self.states = StateEmbedder(embed_config, n_workers=n_workers, engine=engine)

    @classmethod
    def build(cls, config: ScorerConfig, scene_qpos: NDArray[np.float64], **options: Any) -> Self:
        """Read and embed the goal.

        Args:
            config: what is scored how.
            scene_qpos: (nq,) a start state of the scene, for same-scene goals.
            options: see the constructor.

        Raises:
            BadInput: the goal cannot be read, or the embedder does not read its kind.
        """
        task = get_task(config.views.task)
        same_scene = config.goal == SAME_SCENE
        scene = scene_pair(config.views.shared_renderer(), scene_qpos, task) if same_scene else None
        goal = read_goal(config.goal, task, scene)
        device = options.get("device", "auto")
        embedder = EmbedConfig(config.views, config.embedder, config.precision, device).load_embedder()
        starts, goals = embed_goal_cached(goal, embedder)
        scorer = cls(config, starts, goals, goal.fingerprint(), **options)
        scorer.goal = goal
        return scorer

    def score_episodes(
        self, states: Sequence[NDArray[np.float64]], on_progress: Callable[[int, int], None] | None = None
    ) -> tuple[list[FloatArray], int]:
        """Score whole episodes.

        Args:
            states: (T+1, nq) simulator positions per episode.
            on_progress: called with (parts embedded, parts in all).

        Returns:
            (T+1,) float32 scores per episode; and how many frames after the first had no change in any view.
        """
        scores, n_still = [], 0
        for frames, inverse in self._frames(states, on_progress):
            scores.append(self._score(frames)[1:][inverse])
            still = np.all([zero_deltas(frames[:, view]) for view in range(frames.shape[1])], axis=0)
            n_still += int(still[1:][inverse[1:]].sum())
        return scores, n_still

    def score_by_view(self, states: NDArray[np.float64]) -> FloatArray:
        """Score one episode by each view alone: (T+1, nq) → (V, T+1) float32."""
        ((frames, inverse),) = self._frames([states], None)
        rows = []
        for view in range(frames.shape[1]):
            own = slice(view, view + 1)
            starts, goals = (rows_[own] if rows_.ndim == 3 else rows_ for rows_ in (self.starts, self.goals))
            scores = score_views(frames[:, own], starts, goals, self.config.features, self.config.similarity)
            rows.append(scores[1:][inverse])
        return np.stack(rows)

    def select_goals(
        self, states: Sequence[NDArray[np.float64]], on_progress: Callable[[int, int], None] | None = None
    ) -> NDArray[np.intp]:
        """Keep the share ``config.goal_share`` of the goals (at least one) and forget the others.

        The rule is that of `goals_near`.

        Args:
            states: (T+1, nq) simulator positions per episode.
            on_progress: called with (parts embedded, parts in all).

        Returns:
            Indices of the goals that are kept, in their order.
        """
        ends = (frames[[0, 1 + inverse[-1]]] for frames, inverse in self._frames(states, on_progress))
        kept = goals_near(ends, self.starts, self.goals, self.config)
        self.keep_goals(kept)
        return kept

    def seen_as(self, task: str) -> Scorer:
        """Return a scorer with the same goals that sees states from the views of another task."""
        config = replace(self.config, views=replace(self.config.views, task=task))
        states = self.states
        return Scorer(
            config,
            self.starts,
            self.goals,
            self.goal_fingerprint,
            device=states.config.device,
            n_workers=states.n_workers,
            engine=states.engine,
        )

    def with_goals(self, kept: NDArray[np.intp]) -> Scorer:
        """Return a scorer with the goals of these indices alone; both share what is embedded."""
        one = copy.copy(self)
        one.keep_goals(kept)
        return one

    def keep_goals(self, kept: NDArray[np.intp]) -> None:
        """Keep the goals with these indices and forget the others."""
        self.goals = self.goals[..., kept, :]
        if self.goal is not None and not self.goal.per_view:
            self.goal = replace(self.goal, goals=tuple(self.goal.goals[k] for k in kept))

    def _frames(
        self, states: Sequence[NDArray[np.float64]], on_progress: Callable[[int, int], None] | None
    ) -> Iterator[tuple[FloatArray, NDArray[np.intp]]]:
        """Yield per episode the (n, V, D) embeddings of x_0 and its distinct states, and which one each frame is."""
        self.states.embed(np.concatenate(list(states)), on_progress)
        for episode in states:
            distinct, inverse = self.states.embedded(episode)  # resting objects repeat their state
            yield np.concatenate([distinct[inverse[:1]], distinct]), inverse  # x_0 first, as the scores want it

    def score_now(self, first: NDArray[np.float64], current: NDArray[np.float64]) -> FloatArray:
        """Score one state of each of N running episodes.

        Args:
            first: (N, nq) their first states.
            current: (N, nq) their current states.

        Returns:
            (N,) float32 scores.
        """
        scores = np.empty(len(current), dtype=np.float32)
        _, group = np.unique(canonical_states(first, self.config.views), axis=0, return_inverse=True)
        for same in range(group.max() + 1):  # mostly one group: the objects start alike
            rows = np.flatnonzero(group.reshape(-1) == same)
            frames = np.concatenate([self.states.embed_now(first[rows[:1]]), self.states.embed_now(current[rows])])
            scores[rows] = self._score(frames)[1:]
        return scores

    def score_pairs(
        self,
        first: NDArray[np.float64],
        current: NDArray[np.float64],
        on_progress: Callable[[int, int], None] | None = None,
    ) -> FloatArray:
        """Score many states, each against a start of its own; all cores embed.

        Args:
            first: (N, nq) their x_0.
            current: (N, nq).
            on_progress: called with (parts embedded, parts in all).

        Returns:
            (N,) float32 scores.
        """
        self.states.embed(np.concatenate([first, current]), on_progress)
        return self.score_now(first, current)

    def _score(self, embeddings: FloatArray) -> FloatArray:
        """(n, V, D) embeddings, the first of x_0 → (n,) scores."""
        return score_views(embeddings, self.starts, self.goals, self.config.features, self.config.similarity)

    def describe(self) -> dict[str, Any]:
        """Config and content hashes, JSON-ready: what provenance records."""
        return {
            "config": asdict(self.config),
            "goal_sha256": self.goal_fingerprint,
            "embedder_sha256": self.states.embedder.fingerprint,
            "views_sha256": self.config.views.fingerprint(),
        }

    def fingerprint(self) -> str:
        """Hash of all that a score depends on; names of files and folders are left out."""
        described = self.describe()
        hashes = [described[k] for k in ("goal_sha256", "embedder_sha256", "views_sha256")]
        return artifacts.hash_json([*how_scored(self.config), hashes])

    def save(self, path: Path) -> None:
        """Write the goal's embeddings and the config as one safetensors file."""
        from safetensors.numpy import save

        header = {"scorer": json.dumps(self.describe())}
        arrays = {"starts": np.ascontiguousarray(self.starts), "goals": np.ascontiguousarray(self.goals)}
        artifacts.write_bytes(path, save(arrays, metadata=header))

    @classmethod
    def load(cls, path: Path, **options: Any) -> Self:
        """Read what `save` wrote.

        Raises:
            ZestError: the file is missing or damaged, or the embedder or renderer here is not the one that was used
                (its scores would not be comparable).
        """
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, framework="numpy") as file:
                described = json.loads(file.metadata()["scorer"])
                starts, goals = file.get_tensor("starts"), file.get_tensor("goals")
            config, goal_fingerprint = ScorerConfig.from_dict(described["config"]), described["goal_sha256"]
        except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
            raise ZestError(f"the scorer {path} cannot be read ({error}); relabel the dataset again") from error
        scorer = cls(config, starts, goals, goal_fingerprint, **options)
        here = scorer.describe()
        changed = [key for key in ("embedder_sha256", "views_sha256") if here[key] != described[key]]
        if changed:
            raise ZestError(
                f"the scorer {path} was made with another {' and '.join(k.removesuffix('_sha256') for k in changed)} "
                "(weights, precision, or versions differ); relabel and train here, or use the versions of its meta.json"
            )
        return scorer


def embed_goal_cached(goal: GoalSpec, embedder: Embedder) -> tuple[FloatArray, FloatArray]:
    """Embed a goal's starts and goals, through a cache: see `embed_goal`.

    Raises:
        BadInput: the goal is a sentence and the embedder reads pictures only.
    """
    if goal.is_text and not embedder.reads_text:
        raise BadInput(
            f"goal {goal.name!r} is a sentence, but embedder {embedder.uri!r} reads pictures only; use one that "
            "reads text, e.g. open_clip:ViT-B-32/openai, or a goal of pictures"
        )
    digest = artifacts.hash_json([goal.fingerprint(), embedder.fingerprint])
    path = artifacts.cache_dir() / "goals" / f"{digest[:20]}.npz"
    cached = read_arrays(path)
    if cached is None:
        with one_thread():
            starts, goals = embed_goal(goal, embedder)
        write_arrays(path, {"starts": starts, "goals": goals})
        return starts, goals
    return cached["starts"], cached["goals"]
