"""Simulator states → embeddings of all views, each distinct state rendered and embedded once, cached by content.

The cache is a folder of shards ``keys (n, nq) float64, embeddings (n, V, D) float32``; its name is a hash of
everything that an embedding depends on. Any process may add shards; each is written atomically and never changed.

One state is one batch of V frames on one thread, so that its embedding does not depend on the states embedded with it:
networks are exact only up to about 1e-6 across batch sizes and thread counts.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from zest_rl.embedders import Precision
from zest_rl.errors import ZestError
from zest_rl.kitchen.views import Views, canonical_states, distinct_states
from zest_rl.rewards.embeddings import EmbeddedEpisode, WorkerEmbedder, shared_embedder
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_array, write_arrays
from zest_rl.runtime.parallel import Engine, cached_jobs, chunks, one_thread
from zest_rl.simulation.views import state_keys
from zest_rl.types import FloatArray

STATES_PER_SHARD = 32
SHARDS_IN_MEMORY = 64
"""Of 1.3 MB each with 8 views and the default embedder."""


@dataclass(frozen=True)
class _Job:
    """Some states to embed."""

    views: Views
    embedder: WorkerEmbedder
    states: NDArray[np.float64]


def _embed_states(job: _Job) -> dict[str, NDArray[np.generic]]:
    renderer, embedder = job.views.shared_renderer(), job.embedder.load()
    with one_thread():
        embeddings = [embedder.embed_images(list(renderer.render(state))) for state in job.states]
    return {"keys": job.states, "embeddings": np.stack(embeddings)}


@functools.lru_cache(maxsize=SHARDS_IN_MEMORY)
def _read_shard(path: Path) -> FloatArray | None:
    """Return the embeddings of a shard, which never changes; None when it is missing or damaged."""
    return read_array(path, "embeddings")


class StateEmbedder:
    """Embeds simulator states through a cache on disk."""

    def __init__(
        self,
        views: Views,
        embedder: str,
        precision: Precision = "auto",
        *,
        device: str = "auto",
        n_workers: int | None = None,
        engine: Engine = "local",
    ) -> None:
        """Open the cache (created when something is first written); arguments as in `FrameEmbeddings`."""
        fingerprint = shared_embedder(embedder, precision, device).fingerprint
        self.views, self.embedder = views, WorkerEmbedder(embedder, precision, device, fingerprint)
        self.n_workers, self.engine = n_workers, engine
        self.n_embedded = 0
        """States that were not in the cache."""
        digest = artifacts.hash_json([views.fingerprint(), fingerprint])
        self.folder: Path = artifacts.cache_dir() / "embeddings" / digest[:20]
        self._where: dict[bytes, tuple[Path, int]] = {}
        """State → its shard, and the row in it."""
        self._new: dict[bytes, FloatArray] = {}
        """Results of `embed_now` that are not in a shard yet."""
        self._read: set[Path] = set()
        self._index_shards()

    def _index_shards(self) -> None:
        """Index the states of new shards; a damaged shard is ignored."""
        for path in sorted(self.folder.glob("*.npz")):
            if path not in self._read and (keys := read_array(path, "keys")) is not None:
                self._where.update((key, (path, row)) for row, key in enumerate(state_keys(keys)))
                self._read.add(path)

    def embed(self, qpos: NDArray[np.float64], on_progress: Callable[[int, int], None] | None = None) -> None:
        """Embed the states that are not in the cache, on all cores.

        Args:
            qpos: (N, nq) simulator positions.
            on_progress: called with (shards done, shards in all).
        """
        states = distinct_states(qpos, self.views)  # in the order of the episodes: an episode needs few shards
        missing = states[[key not in self._where for key in state_keys(states)]]
        if len(missing) == 0:
            return
        jobs = {}
        for chunk in chunks(len(missing), STATES_PER_SHARD):
            part = missing[chunk.start : chunk.stop]
            jobs[artifacts.hash_arrays(part)[:20]] = _Job(self.views, self.embedder, part)
        options: dict[str, Any] = {"n_workers": self.n_workers, "engine": self.engine, "device": self.embedder.device}
        for n_done, _ in enumerate(cached_jobs(_embed_states, jobs, self.folder, **options), start=1):
            if on_progress is not None:
                on_progress(n_done, len(jobs))
        self.n_embedded += len(missing)
        self._index_shards()

    def embedded(self, qpos: NDArray[np.float64]) -> EmbeddedEpisode:
        """Read the embeddings of one episode, (T+1, nq) simulator positions; a few shards are in memory at a time.

        Raises:
            ZestError: a file of the cache is damaged.
        """
        states, inverse = np.unique(canonical_states(qpos, self.views), axis=0, return_inverse=True)
        rows = []
        for key in state_keys(states):
            if (row := self._row(key)) is None:
                raise ZestError(f"embeddings in {self.folder} are missing or damaged; run the same command again")
            rows.append(row)
        inverse = np.asarray(inverse).reshape(-1)
        return EmbeddedEpisode(np.stack([rows[inverse[0]], *rows]), 1 + inverse)

    def _row(self, key: bytes) -> FloatArray | None:
        """Return the (V, D) embeddings of a state, or None; a damaged shard is removed and forgotten."""
        if key in self._new:
            return self._new[key]
        if key not in self._where:
            return None
        path, row = self._where[key]
        if (embeddings := _read_shard(path)) is not None:
            return np.asarray(embeddings[row])
        path.unlink(missing_ok=True)
        _read_shard.cache_clear()
        self._read.discard(path)
        self._where = {other: place for other, place in self._where.items() if place[0] != path}
        return None

    def embed_now(self, qpos: NDArray[np.float64]) -> FloatArray:
        """Embed states in this process, for use within a rollout: (N, nq) → (N, V, D). Call `flush` at the end."""
        states = canonical_states(qpos, self.views)
        rows = []
        for state, key in zip(states, state_keys(states), strict=True):
            if (row := self._row(key)) is None:
                job = _Job(self.views, self.embedder, state[None])
                self._new[key] = row = np.asarray(_embed_states(job)["embeddings"][0], np.float32)
                self.n_embedded += 1
            rows.append(row)
        return np.stack(rows)

    def flush(self) -> None:
        """Write the results of `embed_now` to the cache."""
        keys, rows = list(self._new), list(self._new.values())
        for part in chunks(len(keys), STATES_PER_SHARD):
            states = np.stack([np.frombuffer(key) for key in keys[part.start : part.stop]])
            path = self.folder / f"{artifacts.hash_arrays(states)[:20]}.npz"
            write_arrays(path, {"keys": states, "embeddings": np.stack(rows[part.start : part.stop])})
        self._new.clear()
        self._index_shards()


class StateEmbeddings:
    """The `EpisodeEmbeddings` of recorded simulator states."""

    unit: ClassVar[str] = "distinct_states"

    def __init__(self, embedder: StateEmbedder, states: Sequence[NDArray[np.float64]]) -> None:
        """Take the (T+1, nq) simulator positions of every episode."""
        self._embedder, self._states = embedder, states

    @property
    def n_embedded(self) -> int:
        """Distinct states that were not in the cache."""
        return self._embedder.n_embedded

    def identity(self) -> list[Any]:
        """Empty: the states belong to the recorded episodes, and the views to the scorer."""
        return []

    def describe(self) -> dict[str, Any]:
        """Empty: the scorer's record holds the views."""
        return {}

    def embed(self, on_progress: Callable[[int, int], None] | None = None) -> None:
        """Embed the states that are not in the cache."""
        self._embedder.embed(np.concatenate(list(self._states)), on_progress)

    def __iter__(self) -> Iterator[EmbeddedEpisode]:
        return map(self._embedder.embedded, self._states)
