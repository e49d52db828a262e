"""Frames of any source → embeddings of all views, one file in the cache per episode, named by a hash of its frames.

Frames are embedded episode by episode, a few steps at a time: memory does not grow with the dataset, and an interrupted
run resumes at the episode where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from zest_rl.embedders import Backend, Precision, Vectors
from zest_rl.errors import BadInput
from zest_rl.rewards.embeddings import N_CHECKED, EmbeddedEpisode, WorkerEmbedder, check_equal, shared_embedder
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import Layout, read_arrays, write_arrays
from zest_rl.runtime.cache import cache_folder
from zest_rl.runtime.parallel import Engine, cached_jobs, run_jobs
from zest_rl.sources.base import EpisodeFrames, Source
from zest_rl.types import FloatArray, Frame

STEPS_PER_BATCH = 16
CHECKED_STEPS = 16
"""The frames that are embedded again and compared are among the first of an episode: a video is decoded,
and states are rendered, in order."""


@dataclass(frozen=True)
class _Shared:
    """What all jobs share; it holds the paths of all episodes, so it is sent once to a worker and not with each job."""

    frames: EpisodeFrames
    embedder: WorkerEmbedder


@dataclass(frozen=True)
class _Job:
    """One episode to embed."""

    episode: int
    n_steps: int


def _embed_episode(shared: _Shared, job: _Job) -> dict[str, NDArray[Any]]:
    embedder = shared.embedder.load()
    steps = islice(shared.frames.read(job.episode), job.n_steps + 2)  # one more than allowed, to notice too many
    index, parts = list[int](), []

    def changed() -> Iterator[Sequence[Frame]]:
        last = None
        for views in steps:
            index.append(index[-1] + (views is not last) if index else 0)
            if views is not last:
                yield views
            last = views

    changes = changed()
    while batch := list(islice(changes, STEPS_PER_BATCH)):
        vectors = embedder.embed_images([frame for views in batch for frame in views])
        parts.append(vectors.reshape(len(batch), -1, embedder.dim))
    n_frames = len(index)
    if n_frames not in (job.n_steps, job.n_steps + 1):
        number = f"more than {job.n_steps + 1}" if n_frames > job.n_steps else str(n_frames)
        raise BadInput(
            f"episode {job.episode} has {job.n_steps} actions, so it needs {job.n_steps + 1} frames (x_0 … x_T), or "
            f"{job.n_steps} without the last; got {number}. Are these the frames of this episode, one for each step?"
        )
    return {"embeddings": np.concatenate(parts).astype(embedder.vectors, copy=False)[index]}


def _embed_frame(shared: _Shared, place: tuple[int, int]) -> FloatArray:
    """Embed one frame, (episode, step), of all views: (V, D)."""
    episode, step = place
    return shared.embedder.load().embed_images(list(next(islice(shared.frames.read(episode), step, None))))


def _whole(frames: FloatArray, n_steps: int) -> EmbeddedEpisode:
    """Return an episode of T or T + 1 embedded frames; a missing x_T repeats x_{T-1}."""
    if len(frames) == n_steps:
        frames = np.concatenate([frames, frames[-1:]])
    return EmbeddedEpisode(frames, np.arange(n_steps + 1))


class FrameEmbeddings:
    """The `EpisodeEmbeddings` of the frames of a source."""

    unit: ClassVar[str] = "episodes"

    def __init__(
        self,
        source: Source,
        embedder: str,
        precision: Precision = "auto",
        *,
        backend: Backend = "auto",
        vectors: Vectors = "float32",
        device: str = "auto",
        n_workers: int | None = None,
        engine: Engine = "local",
    ) -> None:
        """Hash the frames of a source.

        `embedder` is a URI, `precision`, `backend`, `vectors` and `device` as in `zest_rl.embedders.load_embedder`;
        `n_workers` and `engine` as in `zest_rl.runtime.parallel.run_jobs`.

        Raises:
            BadInput: frames or the embedder cannot be read.
        """
        network = shared_embedder(embedder, precision, device, backend, vectors)
        worker = WorkerEmbedder(embedder, precision, device, backend, vectors, network.cache_key)
        self._shared, dtype = _Shared(source.frames, worker), np.dtype(vectors).type
        self._layout: Layout = {"embeddings": (dtype, (None, len(source.frames.views), network.dim))}
        self._source, self._n_workers, self._engine = source, n_workers, engine
        self._n_steps = source.trajectories.n_steps
        self._digests = [source.frames.digest(episode) for episode in range(len(self._n_steps))]
        self._folder: Path = cache_folder("frames", network.cache_key[:20])
        self.n_embedded = 0
        """Episodes that were not in the cache."""

    def identity(self) -> list[Any]:
        """The original rewards, which a copy keeps, and the frames."""
        rewards = self._source.trajectories.rewards_to_keep()
        return [[None if r is None else artifacts.hash_arrays(r) for r in rewards], self._digests]

    def describe(self) -> dict[str, Any]:
        """Origin of the frames, and their hash."""
        return {"frames": self._source.frames.describe(), "frames_sha256": artifacts.hash_json(self._digests)}

    def embed(self, on_progress: Callable[[int, int], None] | None = None) -> None:
        """Embed the episodes that are not in the cache, after a few frames of those that are, to compare.

        Args:
            on_progress: called with (episodes embedded, episodes in all).

        Raises:
            BadInput: frames cannot be read, or an episode has neither T nor T+1 of them.
            ZestError: a worker process died; finished episodes are kept. Or the cache holds other embeddings.
        """
        options: dict[str, Any] = {
            "engine": self._engine, "device": self._shared.embedder.device, "stage": "reading and embedding frames",
        }  # fmt: skip
        # the arrays themselves are verified when they are read
        cached = [i for i in range(len(self._digests)) if read_arrays(self._path(i), {}) is not None]
        checked = np.random.default_rng().choice(len(cached), min(N_CHECKED, len(cached)), replace=False)
        self._check([cached[k] for k in checked], options)
        missing = set(range(len(self._digests))) - set(cached)
        jobs = {self._path(i).stem: _Job(i, self._n_steps[i]) for i in sorted(missing)}
        work, n_cached = partial(_embed_episode, self._shared), len(self._digests) - len(jobs)
        options |= {"n_workers": self._n_workers, "layout": lambda job: self._layout}
        for n_done, _ in enumerate(cached_jobs(work, jobs, self._folder, **options), start=n_cached + 1):
            if on_progress is not None:
                on_progress(n_done, len(self._digests))
        self.n_embedded += len(jobs)

    def _check(self, episodes: Sequence[int], options: Mapping[str, Any]) -> None:
        """Embed a frame of each of these episodes, which are in the cache, and compare; raises as `check_equal`."""
        rng, cached, places = np.random.default_rng(), {}, {}
        for i in episodes:
            if (vectors := self._read(i)) is not None:
                step = int(rng.integers(min(self._n_steps[i], CHECKED_STEPS)))
                cached[str(i)], places[str(i)] = vectors[step], (i, step)
        again = run_jobs(partial(_embed_frame, self._shared), places, n_workers=1, **options)
        check_equal(self._folder, ((cached[name], vectors) for name, vectors in again))

    def __iter__(self) -> Iterator[EmbeddedEpisode]:
        """Read the cache.

        What turns out to be damaged is embedded again, in this process.

        Raises:
            BadInput: an episode has neither T nor T+1 frames.
        """
        for i, n_steps in enumerate(self._n_steps):
            frames = self._read(i)
            if frames is None:
                arrays = _embed_episode(self._shared, _Job(i, n_steps))
                write_arrays(self._path(i), arrays)
                self.n_embedded += 1
                frames = arrays["embeddings"].astype(np.float32, copy=False)
            yield _whole(frames, n_steps)

    def read(self, episode: int) -> EmbeddedEpisode | None:
        """Read the file of an episode."""
        frames = self._read(episode)
        return None if frames is None else _whole(frames, self._n_steps[episode])

    def _read(self, episode: int) -> FloatArray | None:
        """Return the embeddings of an episode's T or T + 1 frames, (n, V, D); None: not in the cache, or damaged."""
        arrays, n_steps = read_arrays(self._path(episode), self._layout), self._n_steps[episode]
        if not arrays or len(arrays["embeddings"]) not in (n_steps, n_steps + 1):
            return None
        return arrays["embeddings"].astype(np.float32, copy=False)

    def _path(self, episode: int) -> Path:
        return self._folder / f"{self._digests[episode][:32]}.npz"
