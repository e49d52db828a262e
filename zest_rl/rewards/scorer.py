"""A scorer: a goal and an embedder, which score embedded frames of any origin.

The same scorer relabels a dataset and scores a rollout online. It is saved beside the dataset as a small safetensors
file (the goal's embeddings) with its config, so that the goal pictures are not needed later.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.env_specs import is_maker
from zest_rl.data.provenance import ScorerRecord
from zest_rl.embedders import DEFAULT_EMBEDDER, ONNX_RUNTIME, Backend, Embedder, Precision, Vectors
from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.views import Views
from zest_rl.rewards.embeddings import EmbeddedEpisode, check_equal, shared_embedder
from zest_rl.rewards.goals import GoalSpec, embed_goal
from zest_rl.rewards.scores import (
    NUMBERS,
    Features,
    Similarity,
    change_beside_goal,
    check_goal_share,
    check_names,
    score_views,
    zero_deltas,
)
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.runtime.cache import cache_folder
from zest_rl.runtime.files import check_file
from zest_rl.runtime.hub import SCORER_FILE as SCORER_FILE
from zest_rl.runtime.records import from_json, reading_record
from zest_rl.runtime.trust import check_trusted, remember
from zest_rl.simulation.makers import check_named, named_by_user
from zest_rl.sources.scene_views import SceneViews
from zest_rl.sources.states import check_env
from zest_rl.types import FloatArray

OTHER_DIRECTION = 0.1
"""Cosine of a change and the goal's below which they have nothing to do with each other; pictures of other scenes than
the dataset's have such cosines, too, and then only the mean over views tells."""


@dataclass(frozen=True)
class ScorerConfig:
    """Everything that a score depends on, besides the frames."""

    goal: str
    """Goal spec, see `zest_rl.rewards.goals`."""
    embedder: str = "efficientnet-lite0"
    features: Features = "delta"
    similarity: Similarity = "cos"
    precision: Precision = "auto"
    goal_share: float = 1.0
    """Share of the goals that are used: the nearest to the ends of the episodes (`Scorer.goals_near`)."""
    backend: Backend = "auto"
    vectors: Vectors = "float32"

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        check_goal_share(self.goal_share)

    def load_embedder(self, device: str) -> Embedder:
        """Return this process's embedder; raises as `zest_rl.embedders.load_embedder`."""
        return shared_embedder(self.embedder, self.precision, device, self.backend, self.vectors)

    def embedding(self) -> dict[str, Any]:
        """Return the arguments of `zest_rl.rewards.relabel.open_embeddings` that choose the embedder."""
        return {name: getattr(self, name) for name in ("embedder", "precision", "backend", "vectors")}


@dataclass(frozen=True, eq=False)
class Scorer:
    """Scores frames by a goal: φ of `zest_rl.rewards.scores`, averaged over goals and views."""

    config: ScorerConfig
    starts: FloatArray
    """(S, D), or (V, S, D) for a goal per view."""
    goals: FloatArray
    """(K, D) or (V, K, D)."""
    goal_sha256: str
    """Hash of the goal's content, before any choice among its pictures."""
    embedder_sha256: str
    backend: str
    """What computes the embedder, see `zest_rl.embedders.Embedder`."""
    views: Views | SceneViews | None = None
    """How the frames are rendered from states; None where they are not, and where a dataset holds their embeddings."""
    goal: GoalSpec | None = None
    """The goal itself; None when only its embeddings were loaded."""

    @classmethod
    def build(cls, config: ScorerConfig, goal: GoalSpec, *, views: Views | None = None, device: str = "auto") -> Self:
        """Embed the goal.

        Raises:
            BadInput: the goal is a sentence and the embedder reads pictures only.
        """
        embedder = config.load_embedder(device)
        if config.embedder != DEFAULT_EMBEDDER:
            remember("embedder", config.embedder)
        starts, goals = embed_goal_cached(goal, embedder)
        return cls(config, starts, goals, goal.fingerprint(), embedder.fingerprint, embedder.backend, views, goal)

    def check_goal(self, device: str, goal: GoalSpec | None = None) -> None:
        """Embed a start and a goal again, and compare, because they may be from the cache; raises as `check_equal`.

        Args:
            device: of the embedder.
            goal: the goal, rendered again; None: its pictures are not from the cache.
        """
        goal = goal or self.goal
        if goal is None:
            return
        embedder = self.config.load_embedder(device)
        i, k = np.random.default_rng().integers([len(goal.starts), len(goal.goals)])
        pair = replace(goal, starts=goal.starts[i : i + 1], goals=goal.goals[k : k + 1])
        starts, goals = embed_goal(pair, embedder)
        check_equal(cache_folder("goals"), [(self.starts[i], starts[0]), (self.goals[k], goals[0])])

    def score(self, embeddings: FloatArray) -> FloatArray:
        """Score frames of one episode: (n, V, D) embeddings, the first of x_0 → (n,) float32."""
        return score_views(embeddings, self.starts, self.goals, self.config.features, self.config.similarity)

    def score_episode(self, episode: EmbeddedEpisode) -> FloatArray:
        """Score all frames of an episode: (T+1,) float32."""
        return self.score(episode.embeddings)[episode.index]

    def score_episodes(self, episodes: Iterable[EmbeddedEpisode]) -> tuple[list[FloatArray], int]:
        """Score whole episodes.

        Returns:
            (T+1,) float32 scores per episode; and the number of unchanged frames, equal to the first in every view.
        """
        scores, n_still = [], 0
        for episode in episodes:
            scores.append(self.score_episode(episode))
            still = np.ones(len(episode.embeddings), np.bool_)
            for view in range(episode.embeddings.shape[1]):
                still[still] = zero_deltas(episode.embeddings[still, view])  # x_0 comes first, and is always still
            n_still += int(still[episode.index[1:]].sum())
        return scores, n_still

    def by_view(self, episode: EmbeddedEpisode) -> FloatArray:
        """Score one episode by each view alone: (V, T+1) float32."""
        scores = []
        for v in range(episode.embeddings.shape[1]):
            view = slice(v, v + 1)
            scorer = self if self.starts.ndim == 2 else replace(self, starts=self.starts[view], goals=self.goals[view])
            scores.append(scorer.score_episode(replace(episode, embeddings=episode.embeddings[:, view])))
        return np.stack(scores)

    def view_cannot_tell(self, episodes: Iterable[EmbeddedEpisode]) -> bool:
        """Whether the only view changes as much as the goal does, but in other directions, as where a robot moves."""
        ends = np.concatenate([episode.ends.swapaxes(0, 1) for episode in episodes])
        dim = ends.shape[-1]
        size, cosine = change_beside_goal(ends, self.starts.reshape(-1, dim), self.goals.reshape(-1, dim))
        return size >= 1 and cosine < OTHER_DIRECTION

    def goals_near(self, episodes: Iterable[EmbeddedEpisode]) -> NDArray[np.intp]:
        """Choose the share ``config.goal_share`` of the goals (at least one) nearest to the ends of the episodes.

        The rule needs no ground truth ("goal images with high similarity", Cui et al. §5.3): it keeps the goals for
        which the last frames of the episodes score highest on average. It assumes that episodes lead to the goal: on
        aimless behaviour it picks whatever resembles their end.

        Returns:
            Indices of the goals, ascending.
        """
        n_goals = self.goals.shape[-2]
        alone = [self.with_goals(np.array([k])) for k in range(n_goals)]
        at_end = np.zeros(n_goals)
        for episode in episodes:
            at_end += [scorer.score(episode.ends)[-1] for scorer in alone]
        n_kept = max(1, round(self.config.goal_share * n_goals))
        return np.sort(np.argsort(-at_end, kind="stable")[:n_kept])

    def with_goals(self, kept: NDArray[np.intp]) -> Self:
        """Return a scorer with only the goals of these indices."""
        goal = self.goal
        if goal is not None and not goal.per_view:
            goal = replace(goal, goals=tuple(goal.goals[k] for k in kept))
        return replace(self, goals=self.goals[..., kept, :], goal=goal)

    @property
    def record(self) -> ScorerRecord:
        """Config and content hashes, for provenance."""
        return ScorerRecord(
            **asdict(self.config) | {"backend": self.backend},
            goal_sha256=self.goal_sha256,
            embedder_sha256=self.embedder_sha256,
            views=None if self.views is None else asdict(self.views),
            views_sha256=None if self.views is None else self.views.fingerprint(),
        )

    def fingerprint(self) -> str:
        """Hash of everything that a score depends on besides the frames; names of files and folders do not matter."""
        config = self.config
        settings = {"features": config.features, "similarity": config.similarity, "goal_share": config.goal_share}
        rule = [] if config.goal_share == 1 else ["by last frames"]
        numbers = [f"{name} {number}" for name, number in NUMBERS.items() if name == config.features]
        hashes: list[Any] = [self.goal_sha256, self.embedder_sha256]
        if self.views is not None:
            hashes = [[*hashes, self.views.fingerprint()]]
        return artifacts.hash_json([settings, *rule, *numbers, *hashes])

    def save(self, path: Path) -> None:
        """Write the goal's embeddings and the config as one safetensors file."""
        from safetensors.numpy import save

        header = {"scorer": json.dumps(self.record.to_json())}
        arrays = {"starts": np.ascontiguousarray(self.starts), "goals": np.ascontiguousarray(self.goals)}
        artifacts.write_bytes(path, save(arrays, metadata=header))

    @classmethod
    def load(cls, path: Path, *, device: str = "auto") -> Self:
        """Read what `save` wrote.

        Raises:
            BadInput: the file names an embedder or environment that this user did not, nor trust (`check_scorer`).
            ZestError: the file is missing or damaged, or the embedder or renderer here differs from the one that was
                used (scores would not be comparable).
        """
        config, views, saved, starts, goals = _read(path)
        _check_named(path, config, views)
        embedder = config.load_embedder(device)
        scorer = cls(config, starts, goals, saved.goal_sha256, embedder.fingerprint, embedder.backend, views)
        record = scorer.record
        changed = [key for key in ("embedder_sha256", "views_sha256") if getattr(record, key) != getattr(saved, key)]
        if changed:
            raise ZestError(
                f"the scorer {path} was made with another {' and '.join(k.removesuffix('_sha256') for k in changed)} "
                "(weights, precision, or versions differ); relabel and train here, or use the versions of its meta.json"
            )
        if (dim := starts.shape[-1]) != embedder.dim:
            raise BadInput(
                f"{path} holds embeddings of {dim} numbers, but its embedder {config.embedder} makes {embedder.dim}; "
                "relabel the dataset again"
            )
        return scorer


def check_scorer(path: Path, *, trust: bool = False) -> None:
    """Check that a scorer's file may be loaded, without loading its embedder.

    Args:
        path: of the file.
        trust: let it load the embedder and make the environment that it names, from now on.

    Raises:
        BadInput: it names an embedder or environment that this user did not.
        ZestError: the file is missing or damaged.
    """
    config, views, *_ = _read(path)
    if trust:
        remember("embedder", config.embedder)
        if isinstance(views, SceneViews) and is_maker(views.env_spec):
            named_by_user(views.env_spec)
    _check_named(path, config, views)


def _check_named(path: Path, config: ScorerConfig, views: Views | SceneViews | None) -> None:
    """Refuse what data name: an embedder may run a package, read a file, or download weights; an environment runs."""
    if config.embedder != DEFAULT_EMBEDDER:
        check_trusted("embedder", config.embedder, f"{path} would load the embedder {config.embedder}")
    if isinstance(views, SceneViews):
        check_named(views.env_spec, f"the scorer {path}")
        check_env(views.env_spec, f"the scorer {path}")


def _read(path: Path) -> tuple[ScorerConfig, Views | SceneViews | None, ScorerRecord, FloatArray, FloatArray]:
    """Read a scorer's file: config, views, both with the hashes of what they mean, starts and goals."""
    from safetensors import safe_open

    if not path.exists():
        raise ZestError(f"there is no scorer {path}; relabel the dataset again")
    check_file(path)
    with reading_record(path, "relabel the dataset again"):
        with safe_open(path, framework="numpy") as file:
            described = json.loads(file.metadata()["scorer"])
            starts, goals = file.get_tensor("starts"), file.get_tensor("goals")
        values = dict(described["config"])
        views = _read_views(values.pop("views")) if "views" in values else None
        values["backend"] = "auto" if values.get("backend") == ONNX_RUNTIME else "torch"  # as the dataset was scored
        config = from_json(ScorerConfig, values)
        for array in (starts, goals):
            if (
                array.dtype != np.float32
                or array.ndim not in (2, 3)
                or 0 in array.shape
                or not np.isfinite(array).all()
            ):
                raise ValueError(f"{array.dtype} embeddings of shape {array.shape}, or not finite")
        n_views = starts.shape[:-2] if views is None else (views.n_drawn,)[: starts.ndim - 2]
        if not (starts.shape[:-2] == goals.shape[:-2] == n_views and starts.shape[-1] == goals.shape[-1]):
            raise ValueError(f"starts of shape {starts.shape} beside goals of shape {goals.shape}")
        return config, views, ScorerRecord.from_json(described), starts, goals


def _read_views(values: Mapping[str, Any]) -> Views | SceneViews:
    return SceneViews.from_json(values) if "env_spec" in values else Views.from_record(values)


def embed_goal_cached(goal: GoalSpec, embedder: Embedder) -> tuple[FloatArray, FloatArray]:
    """Embed a goal's starts and goals through a cache; see `embed_goal`.

    Raises:
        BadInput: the goal is a sentence and the embedder reads pictures only.
    """
    if goal.is_text and not embedder.reads_text:
        raise BadInput(
            f"goal {goal.name!r} is a sentence, but embedder {embedder.uri!r} reads pictures only; use one that "
            "reads text, e.g. open_clip:ViT-B-32/openai, or a goal of pictures"
        )
    digest = artifacts.hash_json([goal.fingerprint(), embedder.cache_key])
    path = cache_folder("goals") / f"{digest[:20]}.npz"

    def form(pictures: Sequence[Any]) -> tuple[type[np.float32], tuple[int, ...]]:
        return np.float32, (len(pictures), *((1,) if goal.per_view else ()), embedder.dim)

    cached = read_arrays(path, {"starts": form(goal.starts), "goals": form(goal.goals)})
    if cached is None:
        starts, goals = embed_goal(goal, embedder)
        write_arrays(path, {"starts": starts, "goals": goals})
        return starts, goals
    return cached["starts"], cached["goals"]
