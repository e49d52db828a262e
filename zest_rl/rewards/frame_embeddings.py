"""A goal and an embedder, joined into one object that scores frames from anywhere.

The counterpart of `scorer`, which renders its frames itself. Frames are embedded episode by episode, a few
steps at a time, and the embeddings of an episode are one file in the cache, named by its content: memory does not grow
with the dataset, and a cut run goes on at the episode where it was cut.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.embedders import Precision
from zest_rl.errors import BadInput, ZestError
from zest_rl.rewards.goals import read_free_goal
from zest_rl.rewards.scorer import embed_goal_cached, goals_near, how_scored
from zest_rl.rewards.scores import (
    Features,
    Similarity,
    check_goal_share,
    check_names,
    score_views,
    zero_deltas,
)
from zest_rl.rewards.state_embeddings import check_same_embedder, shared_embedder
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays
from zest_rl.runtime.parallel import Engine, cached_jobs, counted, one_thread
from zest_rl.sources.base import Frames, Source
from zest_rl.types import FloatArray

STEPS_PER_BATCH = 16


@dataclass(frozen=True)
class FrameScorerConfig:
    """Everything that a score depends on, besides the frames."""

    goal: str
    """A folder with init/ and goal/, or ``text:START -> GOAL``."""
    embedder: str = "efficientnet-lite0"
    features: Features = "delta"
    similarity: Similarity = "cos"
    precision: Precision = "auto"
    goal_share: float = 1.0
    """Share of the goals that are used: those that the episodes end nearest to."""

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        check_goal_share(self.goal_share)


@dataclass(frozen=True)
class _Shared:
    """What the jobs have in common: with the paths of all episodes, it is sent to a worker once and not with each."""

    frames: Frames
    embedder: str
    precision: Precision
    device: str
    fingerprint: str
    """Of the embedder."""


@dataclass(frozen=True)
class _Job:
    """One episode to embed."""

    episode: int
    n_steps: int


def _embed_episode(shared: _Shared, job: _Job) -> dict[str, NDArray[np.generic]]:
    embedder = shared_embedder(shared.embedder, shared.precision, shared.device)
    check_same_embedder(embedder, shared.fingerprint)
    steps = islice(shared.frames.read(job.episode), job.n_steps + 2)  # one more than may be shows that it is wrong
    parts = []
    with one_thread():
        while batch := list(islice(steps, STEPS_PER_BATCH)):
            vectors = embedder.embed_images([frame for views in batch for frame in views])
            parts.append(vectors.reshape(len(batch), -1, embedder.dim))
    n_frames = sum(map(len, parts))
    if n_frames not in (job.n_steps, job.n_steps + 1):
        found = f"more than {job.n_steps + 1}" if n_frames > job.n_steps else str(n_frames)
        raise BadInput(
            f"episode {job.episode} has {job.n_steps} actions, so it needs {job.n_steps + 1} frames (x_0 … x_T), or "
            f"{job.n_steps} without the last; got {found}. Are these the frames of this episode, one for each step?"
        )
    return {"embeddings": np.concatenate(parts)}


class FrameScorer:
    """Scores frames by a goal: φ of `zest_rl.rewards.scores`, averaged over goals and views."""

    def __init__(
        self,
        config: FrameScorerConfig,
        *,
        device: str = "auto",
        n_workers: int | None = None,
        engine: Engine = "local",
    ) -> None:
        """Read and embed the goal.

        Args:
            config: what is scored how.
            device: where the embedder runs.
            n_workers: processes that embed, default one per core.
            engine: processes of this machine, or workers of a Ray cluster.

        Raises:
            BadInput: the goal cannot be read, or the embedder does not read its kind.
        """
        self.config, self.device, self.n_workers, self.engine = config, device, n_workers, engine
        self.goal = read_free_goal(config.goal)
        self.embedder = shared_embedder(config.embedder, config.precision, device)
        self.starts, self.goals = embed_goal_cached(self.goal, self.embedder)
        self.goal_fingerprint = self.goal.fingerprint()
        self.n_embedded = 0
        """Episodes that were not in the cache and had to be read and embedded."""
        self._folder: Path = artifacts.cache_dir() / "frames" / self.embedder.fingerprint[:20]

    def embed(self, source: Source, digests: list[str], on_progress: Callable[[int, int], None] | None = None) -> None:
        """Leave the embeddings of all episodes in the cache; several processes at work on those that are missing.

        Args:
            source: the dataset.
            digests: of its episodes' frames.
            on_progress: called with (episodes embedded, episodes in all).

        Raises:
            BadInput: frames cannot be read, or an episode has neither T nor T+1 of them.
            ZestError: a worker process died; finished episodes are kept.
        """
        config, n_steps = self.config, source.trajectories.n_steps
        shared = _Shared(source.frames, config.embedder, config.precision, self.device, self.embedder.fingerprint)
        jobs = {
            self._name(digest): _Job(i, n_steps[i])
            for i, digest in enumerate(digests)
            if not self._path(digest).exists()
        }
        cached_jobs(
            partial(_embed_episode, shared),
            jobs,
            self._folder,
            n_workers=self.n_workers,
            engine=self.engine,
            device=self.device,
            on_done=counted(on_progress, len(digests), len(digests) - len(jobs)),
        )
        self.n_embedded += len(jobs)

    def embedded(self, source: Source, digests: list[str]) -> Iterator[FloatArray]:
        """Yield what `embed` left, one episode at a time: (T+1, V, D) float32; a missing x_T repeats x_{T-1}.

        Raises:
            BadInput: an episode has neither T nor T+1 frames.
            ZestError: a file of the cache is damaged.
        """
        for i, (digest, n_steps) in enumerate(zip(digests, source.trajectories.n_steps, strict=True)):
            arrays = read_arrays(self._path(digest))
            if arrays is None:
                self._path(digest).unlink(missing_ok=True)
                raise ZestError(f"the embeddings of episode {i} in the cache are damaged; run the same command again")
            frames = arrays["embeddings"]
            if len(frames) not in (n_steps, n_steps + 1):
                raise BadInput(f"episode {i} has {n_steps} actions and {len(frames)} frames")
            yield frames if len(frames) == n_steps + 1 else np.concatenate([frames, frames[-1:]])

    def score(self, embeddings: FloatArray) -> FloatArray:
        """Score the frames of one episode: (T+1, V, D) embeddings, the first of x_0 → (T+1,) float32."""
        return score_views(embeddings, self.starts, self.goals, self.config.features, self.config.similarity)

    def score_episodes(self, source: Source, digests: list[str]) -> tuple[list[FloatArray], int]:
        """Score all episodes, which were embedded before.

        Returns:
            (T+1,) float32 scores per episode; and how many frames after the first had no change in any view.
        """
        scores, n_still = [], 0
        for frames in self.embedded(source, digests):
            scores.append(self.score(frames))
            still = np.all([zero_deltas(frames[:, view]) for view in range(frames.shape[1])], axis=0)
            n_still += int(still[1:].sum())
        return scores, n_still

    def select_goals(self, source: Source, digests: list[str]) -> NDArray[np.intp]:
        """Keep the goals that the episodes end nearest to (`scorer.goals_near`); return their indices."""
        ends = (frames[[0, -1]] for frames in self.embedded(source, digests))
        kept = goals_near(ends, self.starts, self.goals, self.config)
        self.goals = self.goals[kept]
        self.goal = replace(self.goal, goals=tuple(self.goal.goals[k] for k in kept))
        return kept

    def describe(self) -> dict[str, Any]:
        """Config and content hashes, JSON-ready: what provenance records."""
        return {
            "config": asdict(self.config),
            "goal_sha256": self.goal_fingerprint,
            "embedder_sha256": self.embedder.fingerprint,
        }

    def fingerprint(self) -> str:
        """Hash of all that a score depends on besides the frames; names of files and folders are left out."""
        return artifacts.hash_json([*how_scored(self.config), self.goal_fingerprint, self.embedder.fingerprint])

    def _name(self, digest: str) -> str:
        return digest[:32]

    def _path(self, digest: str) -> Path:
        return self._folder / f"{self._name(digest)}.npz"
